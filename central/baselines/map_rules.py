"""The rules on robots' whole maps: exchanged in lockstep, fused once as they are, or left alone."""

from collections.abc import Sequence

from central.attendance import TeamAttendance
from central.baselines.feedback_rule import FeedbackRule
from central.baselines.map_fusion import fused_totally, kalman
from central.config import CentralConfig
from central.fused import fused_message
from central.rule import FusionRule, Inputs, Stream, Tail
from central.submap_set import SubmapSet
from team import translate
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


class ExchangeRule(FusionRule):
    """Rounds in lockstep; the robots absorb what comes back.

    It keeps the submaps that the robots send beside their maps, for their next lives.
    """

    listens = (ch.START, ch.SUBMAP, ch.OWN_MAP)

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        super().__init__(config, digest, robots)
        self._rounds = FeedbackRule(config, digest)
        self._set = SubmapSet()
        self._starts: dict[Stream, m.InitialPose] = {}

    def fuse(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """A round's map from the maps that it names; the rounds follow one another."""
        if tail == "final":
            return self.conclude(inputs.stamp_ns)
        for estimate in inputs.maps:
            self._rounds.take_map(estimate)
        return self.advance(TeamAttendance.of(()))

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """File a map for its round."""
        match message:
            case m.InitialPose():
                self._starts.setdefault((message.robot, message.incarnation), message)
            case m.Submap():
                self._set.admit(message)
            case m.MapEstimate():
                self._rounds.take_map(message)
            case _:
                pass
        return []

    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """Every round that no robot is missing from."""
        out = self._rounds.advance(
            lambda name, _round: attendance.takes_part(name), list(attendance.robots)
        )
        self.landmarks = self._rounds.landmarks
        return out

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last round's map."""
        return self._rounds.conclude(now_ns)

    def kept(self, robot: str) -> Sequence[m.Message]:
        """The start of the robot's latest incarnation and its submaps without a gap."""
        incarnations = [incarnation for name, incarnation in self._set.streams if name == robot]
        submaps = self._set.chain((robot, max(incarnations))) if incarnations else []
        start = self._starts.get((robot, submaps[0].incarnation)) if submaps else None
        return () if start is None else (start, *submaps)


class _OwnMaps(FusionRule):
    """The newest map of every robot."""

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        super().__init__(config, digest, robots)
        self._maps: dict[str, m.MapEstimate] = {}

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Keep a map that is newer than the robot's last one."""
        if isinstance(message, m.MapEstimate):
            last = self._maps.get(message.robot)
            if last is None or _name(last) < _name(message):
                self._maps[message.robot] = message
        return []

    def dealt(self, done: m.Done) -> bool:
        """The robot's last map is here."""
        found = self._maps.get(done.robot)
        last = (done.incarnation, done.last_map)
        return done.last_map < 0 or (found is not None and _name(found) >= last)

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The map of the robots' last maps."""
        return self.fuse(Inputs(maps=self._known(), stamp_ns=now_ns), "final")

    def _known(self) -> list[m.MapEstimate]:
        """The maps by robot."""
        return [self._maps[robot] for robot in sorted(self._maps)]

    def _message(
        self,
        maps: Sequence[m.MapEstimate],
        value: LandmarkGaussian,
        *,
        stamp_ns: int,
        final: bool,
        joint: bool,
        reasons: tuple[str, ...],
    ) -> m.FusedMap:
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            translate.digest_of(self.config_digest, *(_payload(x) for x in maps)),
            value,
            tuple(_member(x) for x in maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=stamp_ns),
            final=final,
            joint=joint,
            reasons=reasons,
        )


class LatestRule(_OwnMaps):
    """The latest whole map of every robot as one, nothing fed back (`kalman` of independent maps).

    Each map rests on its own robot's measurements alone, so the maps are independent and no
    measurement is counted twice: the result is as consistent as the maps are. A robot whose initial
    pose is not known has its map in a frame of its own and is left out.
    """

    listens = (ch.START, ch.OWN_MAP)
    unnamed = ("reasons",)

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str] = ()) -> None:
        super().__init__(config, digest, robots)
        self._placed: dict[Stream, bool] = {}
        self._said: tuple[m.VersionEntry, ...] = ()

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Keep a start, and a map that is newer than the robot's last one."""
        if isinstance(message, m.InitialPose):
            self._placed[message.robot, message.incarnation] = bool(message.pose)
        return super().take(message, now_ns)

    def dealt(self, done: m.Done) -> bool:
        """The robot's last map is here, and the start of its stream."""
        return done.last_map < 0 or (
            super().dealt(done) and (done.robot, done.incarnation) in self._placed
        )

    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """A broadcast, when one is due and there is something new in it."""
        maps = self._known()
        members = tuple(_member(x) for x in maps)
        if not self.is_due(attendance.now_ns) or not members or members == self._said:
            return []
        self.broadcast_ns, self._said = attendance.now_ns, members
        return self.fuse(Inputs(maps=maps), "closed")

    def fuse(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """These maps as one."""
        maps, final = inputs.maps, tail == "final"
        values = {x.robot: _value(x) for x in maps}
        value, refused = fused_totally(kalman, values, self.config.bounds.coordinate_m)
        own = self._maps.values()
        away = sorted(x.robot for x in own if not self._placed.get((x.robot, x.incarnation)))
        reasons = (*(f"{robot}: its start pose is not known" for robot in away), *refused)
        fused = self._message(maps, value, stamp_ns=0, final=final, joint=True, reasons=reasons)
        return [Outgoing(ch.FINAL_MAP if final else ch.FUSED_MAP, "", fused)]

    def _known(self) -> list[m.MapEstimate]:
        """The maps in the team's frame, by robot."""
        return [x for x in super()._known() if self._placed.get((x.robot, x.incarnation))]


class AloneRule(_OwnMaps):
    """No fusion: publishes a final map for single-robot teams only."""

    listens = (ch.OWN_MAP,)

    def advance(self, attendance: TeamAttendance) -> list[Outgoing]:
        """There is nothing to broadcast."""
        return []

    def fuse(self, inputs: Inputs, tail: Tail) -> list[Outgoing]:
        """The map of the one robot; of several robots a map without landmarks that says so."""
        maps, reason = inputs.maps, ""
        if not maps:
            reason = "no fusion, and this estimator makes no map"
        elif len(self.team) != 1:
            reason = "no fusion: each robot has its own map"
        fused = self._message(
            maps,
            NO_LANDMARKS if reason else _value(maps[0]),
            stamp_ns=inputs.stamp_ns,
            final=True,
            joint=not maps or maps[0].joint,
            reasons=(reason,) if reason else (),
        )
        return [Outgoing(ch.FINAL_MAP, "", fused)]


def _name(estimate: m.MapEstimate) -> tuple[int, int]:
    return estimate.incarnation, estimate.sequence


def _member(estimate: m.MapEstimate) -> m.VersionEntry:
    return m.VersionEntry(
        robot=estimate.robot, incarnation=estimate.incarnation, sequence=estimate.sequence
    )


def _payload(estimate: m.MapEstimate) -> bytes:
    return estimate.ids + estimate.means + estimate.covariance


def _value(estimate: m.MapEstimate) -> LandmarkGaussian:
    return LandmarkGaussian(
        *translate.landmarks_of(estimate), translate.landmark_covariance_of(estimate)
    )
