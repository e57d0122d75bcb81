"""The rules on robots' whole maps: exchanged in lockstep, fused once as they are, or left alone."""

from collections.abc import Mapping, Sequence

from central.baselines.feedback_rule import FeedbackRule
from central.baselines.map_fusion import fused_totally, kalman
from central.config import CentralConfig
from central.fused import fused_message
from central.roll import Roll
from central.submap_set import SubmapSet
from team import translate
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


class _MapRule:
    """What the rules on whole maps have in common: nothing is acknowledged, nothing asked for."""

    listens: tuple[ch.Channel, ...] = (ch.START, ch.OWN_MAP)
    submaps = 0
    findings: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self.figures: Mapping[str, float] = {}

    def complete(self, end: m.End) -> bool:
        """Only robots are waited for."""
        return True

    def kept(self, robot: str) -> Sequence[m.Message]:
        """It keeps no submaps: a robot that was started again takes its stream from the start."""
        return ()

    def wanted(self, now_ns: int) -> list[m.ReadingsWanted]:
        """It takes no readings."""
        return []


class ExchangeRule(_MapRule):
    """Rounds in lockstep; the robots absorb what comes back.

    It keeps the submaps that the robots send beside their maps, for their next lives.
    """

    listens = (ch.START, ch.SUBMAP, ch.OWN_MAP)

    def __init__(self, config: CentralConfig, digest: bytes) -> None:
        super().__init__()
        self._rule = FeedbackRule(config, digest)
        self._set = SubmapSet()
        self._starts: dict[tuple[str, int], m.Start] = {}

    @property
    def landmarks(self) -> int:
        """In the newest map."""
        return self._rule.landmarks

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """File a map for its round."""
        match message:
            case m.Start():
                self._starts.setdefault((message.robot, message.epoch), message)
            case m.Submap():
                self._set.admit(message)
            case m.MapEstimate():
                self._rule.take_map(message)
            case _:
                pass
        return []

    def dealt(self, done: m.Done) -> bool:
        """A robot's last map closes a round by itself."""
        return True

    def advance(self, roll: Roll) -> list[Outgoing]:
        """Every round that no robot is missing from."""
        return self._rule.advance(lambda name, _round: roll.takes_part(name), list(roll.robots))

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The last round's map."""
        return self._rule.conclude(now_ns)

    def kept(self, robot: str) -> Sequence[m.Message]:
        """The start of the robot's latest epoch and its submaps without a gap."""
        epochs = [epoch for name, epoch in self._set.streams if name == robot]
        submaps = self._set.chain((robot, max(epochs))) if epochs else []
        start = self._starts.get((robot, submaps[0].epoch)) if submaps else None
        return () if start is None else (start, *submaps)


class LatestRule(_MapRule):
    """The latest whole map of every robot as one, nothing fed back (`kalman` of independent maps).

    Each map rests on its own robot's readings alone, so the maps are independent and no reading is
    counted twice: the result is as honest as the maps are. A robot whose start pose is not known
    has its map in a frame of its own and is left out.
    """

    def __init__(self, config: CentralConfig, digest: bytes) -> None:
        super().__init__()
        self._config = config
        self._config_digest = digest
        self._maps: dict[str, m.MapEstimate] = {}
        self._placed: dict[tuple[str, int], bool] = {}
        self._broadcast_ns: int | None = None
        self._said: tuple[m.Member, ...] = ()
        self.landmarks = 0

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Keep a start, and a map that is newer than the robot's last one."""
        match message:
            case m.Start():
                self._placed[message.robot, message.epoch] = bool(message.pose)
            case m.MapEstimate():
                last = self._maps.get(message.robot)
                if last is None or _name(last) < _name(message):
                    self._maps[message.robot] = message
            case _:
                pass
        return []

    def dealt(self, done: m.Done) -> bool:
        """The robot's last map is here, and the start of its stream."""
        if done.last_map < 0:
            return True
        found = self._maps.get(done.robot)
        last = (done.epoch, done.last_map)
        here = found is not None and _name(found) >= last
        return here and (done.robot, done.epoch) in self._placed

    def advance(self, roll: Roll) -> list[Outgoing]:
        """A broadcast, when one is due and there is something new in it."""
        since = None if self._broadcast_ns is None else roll.now_ns - self._broadcast_ns
        if since is not None and since < self._config.broadcast_s * 1e9:
            return []
        members = tuple(_member(x) for x in self._known())
        if not members or members == self._said:
            return []
        self._broadcast_ns, self._said = roll.now_ns, members
        return [Outgoing(ch.FUSED_MAP, "", self._fused(self._known(), final=False))]

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The fusion of the last maps."""
        return [Outgoing(ch.FINAL_MAP, "", self._fused(self._known(), final=True))]

    def retold(self, maps: Sequence[m.MapEstimate], *, final: bool) -> list[Outgoing]:
        """What a fused map of these maps says."""
        channel = ch.FINAL_MAP if final else ch.FUSED_MAP
        return [Outgoing(channel, "", self._fused(maps, final=final))]

    def _known(self) -> list[m.MapEstimate]:
        """The maps in the team's frame, by robot."""
        found = (self._maps[robot] for robot in sorted(self._maps))
        return [x for x in found if self._placed.get((x.robot, x.epoch))]

    def _fused(self, maps: Sequence[m.MapEstimate], *, final: bool) -> m.FusedMap:
        values = {x.robot: _value(x) for x in maps}
        fused, refused = fused_totally(kalman, values, self._config.bounds.coordinate_m)
        self.landmarks = len(fused.ids)
        away = sorted(
            x.robot for x in self._maps.values() if not self._placed.get((x.robot, x.epoch))
        )
        return fused_message(
            self._config,
            translate.digest_of(self._config_digest, *(_payload(x) for x in maps)),
            fused,
            tuple(_member(x) for x in maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=0),
            final=final,
            reasons=(*(f"{robot}: its start pose is not known" for robot in away), *refused),
        )


class AloneRule(_MapRule):
    """No fusion. Of a team of one, the final map is its robot's; of more, each has its own."""

    listens = (ch.OWN_MAP,)

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str]) -> None:
        super().__init__()
        self._config = config
        self._config_digest = digest
        self._one = len(robots) == 1
        self._maps: dict[str, m.MapEstimate] = {}
        self.landmarks = 0

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
        last = (done.epoch, done.last_map)
        return done.last_map < 0 or (found is not None and _name(found) >= last)

    def advance(self, roll: Roll) -> list[Outgoing]:
        """There is nothing to broadcast."""
        return []

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The map of the one robot; of several robots a map without landmarks that says so."""
        return self.retold([self._maps[robot] for robot in sorted(self._maps)], now_ns)

    def retold(self, maps: Sequence[m.MapEstimate], now_ns: int) -> list[Outgoing]:
        """The final map after these maps."""
        reason = ""
        if not maps:
            reason = "no fusion, and this estimator makes no map"
        elif not self._one:
            reason = "no fusion: each robot has its own map"
        value = NO_LANDMARKS if reason else _value(maps[0])
        self.landmarks = len(value.ids)
        fused = fused_message(
            self._config,
            translate.digest_of(self._config_digest, *(_payload(x) for x in maps)),
            value,
            tuple(_member(x) for x in maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=now_ns),
            final=True,
            joint=not maps or maps[0].joint,
            reasons=(reason,) if reason else (),
        )
        return [Outgoing(ch.FINAL_MAP, "", fused)]


def _name(estimate: m.MapEstimate) -> tuple[int, int]:
    return estimate.epoch, estimate.sequence


def _member(estimate: m.MapEstimate) -> m.Member:
    return m.Member(estimate.robot, estimate.epoch, estimate.sequence)


def _payload(estimate: m.MapEstimate) -> bytes:
    return estimate.ids + estimate.means + estimate.covariance


def _value(estimate: m.MapEstimate) -> LandmarkGaussian:
    return LandmarkGaussian(
        *translate.landmarks_of(estimate), translate.landmark_covariance_of(estimate)
    )
