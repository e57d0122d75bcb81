"""Rules that fuse whole maps which the robots absorb, in lockstep.

Under `kalman` and `kalman-per-axis` measurements are counted repeatedly, and the covariance has no
meaning.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from teamslam.central.fused_map import fused_message
from teamslam.central.node import CentralNode
from teamslam.sim.studies.rules.map_fusion import (
    covariance_intersection,
    fuse_maps,
    kalman,
    kalman_per_axis,
)
from teamslam.team import translate
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.digest import digest_of

if TYPE_CHECKING:
    from teamslam.central.desk.verification.recorded import Recorded


class ComparisonCentre(CentralNode):
    """A centre that neither acknowledges nor awaits submaps.

    landmarks: number in its newest map.
    """

    landmarks = 0

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures for viewers."""
        return {}

    @property
    def findings(self) -> tuple[str, ...]:
        """Warnings for readers of the map."""
        return ()

    def publish_newest(self) -> list[Outgoing]:
        """Do nothing: maps follow the method's clock."""
        return []

    def has_received(self, done: m.Done) -> bool:
        """True: no submap is awaited."""
        return True

    def lacking(self) -> list[m.SubmapsRequest]:
        """No requests: no submap is awaited."""
        return []

    def recomputed(
        self, log: "Recorded", maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
    ) -> Iterator[Outgoing]:
        """Recompute recorded maps from their named inputs."""
        raise NotImplementedError


def _recorded_maps(log: "Recorded", fused: m.FusedMap) -> list[m.MapEstimate]:
    own = log.of(m.MapEstimate, ch.OWN_MAP)
    by_name = {(x.robot, x.incarnation, x.sequence, x.exchange): x for x in own}
    names = ((x.robot, x.incarnation, x.sequence, fused.exchange) for x in fused.members)
    return [by_name[name] for name in names if name in by_name]


Maps = Sequence[m.MapEstimate]
Starts = Mapping[Stream, m.InitialPose]


class NewestMapsCentre(ComparisonCentre):
    """Newest map of every robot, and initial poses.

    names_inputs: a map follows from its named maps.
    """

    inputs = (ch.START, ch.OWN_MAP)
    names_inputs = True

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._maps: dict[str, m.MapEstimate] = {}
        self._starts: dict[Stream, m.InitialPose] = {}

    def file(self, message: m.Message) -> list[Outgoing]:
        """Store an initial pose, or a newer map."""
        match message:
            case m.InitialPose():
                self._starts[message.robot, message.incarnation] = message
            case m.MapEstimate():
                last = self._maps.get(message.robot)
                if last is None or _name(last) < _name(message):
                    self._maps[message.robot] = message
            case _:
                pass
        return []

    def has_received(self, done: m.Done) -> bool:
        """Whether the robot's last map and initial pose have arrived."""
        found = self._maps.get(done.robot)
        last = (done.incarnation, done.last_map)
        return done.last_map < 0 or (
            found is not None
            and _name(found) >= last
            and (done.robot, done.incarnation) in self._starts
        )

    def publish_due(self) -> list[Outgoing]:
        """No running map."""
        return []

    def publish_final(self) -> list[Outgoing]:
        """The fused map of the robots' newest maps."""
        maps = [self._maps[robot] for robot in sorted(self._maps)]
        final = self.fuse(maps, self._starts, self.attendance.now_ns, final=True)
        return [Outgoing(ch.FINAL_MAP, "", final)]

    def fuse(self, maps: Maps, starts: Starts, now_ns: int, *, final: bool) -> m.FusedMap:
        """Fuse these maps."""
        raise NotImplementedError

    def recomputed(
        self, log: "Recorded", maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
    ) -> Iterator[Outgoing]:
        """Recompute each map from its named recorded maps."""
        firsts = {stream: measurements.get(0) for stream, measurements in log.measurements.items()}
        starts = {s: start for s, start in firsts.items() if isinstance(start, m.InitialPose)}
        for channel, recorded in ((ch.FUSED_MAP, maps), (ch.FINAL_MAP, finals)):
            for each in recorded:
                own, final = _recorded_maps(log, each), channel is ch.FINAL_MAP
                fused = self.fuse(own, starts, each.stamp_ns, final=final)
                if not self.names_inputs:
                    fused = msgspec.structs.replace(fused, reasons=each.reasons)
                yield Outgoing(channel, "", fused)


class LatestCentre(NewestMapsCentre):
    """Latest map of every robot, for known initial poses."""

    names_inputs = False

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._published: Mapping[Stream, int] = {}
        self._published_ns: int | None = None

    def publish_due(self) -> list[Outgoing]:
        """A map every broadcast_s of team time, if a robot has a newer one."""
        last_ns, now_ns = self._published_ns, self.attendance.now_ns
        if last_ns is not None and now_ns - last_ns < self.config.broadcast_s * 1e9:
            return []
        return self.publish_newest()

    def publish_newest(self) -> list[Outgoing]:
        """A map at once, if a robot has a newer one."""
        maps = [self._maps[robot] for robot in sorted(self._maps)]
        named = {(x.robot, x.incarnation): x.sequence for x in maps if _is_placed(x, self._starts)}
        if all(self._published.get(stream, -1) >= last for stream, last in named.items()):
            return []
        self._published, self._published_ns = named, self.attendance.now_ns
        fused = self.fuse(maps, self._starts, self.attendance.now_ns, final=False)
        return [Outgoing(ch.FUSED_MAP, "", fused)]

    def fuse(self, maps: Maps, starts: Starts, now_ns: int, *, final: bool) -> m.FusedMap:
        """Fuse the maps in the team's frame."""
        placed = [each for each in maps if _is_placed(each, starts)]
        values = {x.robot: _value_of(x) for x in placed}
        value, refused = fuse_maps(kalman, values, self.config.bounds.coordinate_m)
        away = sorted({x.robot for x in maps} - {x.robot for x in placed})
        reasons = (*(f"{robot}: its start pose is not known" for robot in away), *refused)
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            _digest(self.config_digest, placed),
            value,
            _members_of(placed),
            stamp_ns=max((x.stamp_ns for x in placed), default=0),
            final=final,
            reasons=reasons,
        )


class AloneCentre(NewestMapsCentre):
    """No fusion: a final map for single-robot teams only."""

    def fuse(self, maps: Maps, starts: Starts, now_ns: int, *, final: bool) -> m.FusedMap:
        """Map of a single robot; for several empty, with the reason."""
        reason = ""
        if not maps:
            reason = "no fusion, and this estimator makes no map"
        elif len(self.robots) != 1:
            reason = "no fusion: each robot has its own map"
        value = NO_LANDMARKS if reason else _value_of(maps[0])
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            _digest(self.config_digest, maps),
            value,
            _members_of(maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=now_ns),
            final=True,
            joint=not maps or maps[0].joint,
            reasons=(reason,) if reason else (),
        )


def _is_placed(estimate: m.MapEstimate, starts: Mapping[Stream, m.InitialPose]) -> bool:
    start = starts.get((estimate.robot, estimate.incarnation))
    return start is not None and bool(start.pose)


def _name(estimate: m.MapEstimate) -> tuple[int, int]:
    return estimate.incarnation, estimate.sequence


def _members_of(maps: Sequence[m.MapEstimate]) -> tuple[m.VersionEntry, ...]:
    return tuple(
        m.VersionEntry(robot=x.robot, incarnation=x.incarnation, sequence=x.sequence) for x in maps
    )


def _digest(settings: bytes, maps: Sequence[m.MapEstimate]) -> bytes:
    return digest_of(settings, *(x.ids + x.means + x.covariance for x in maps))


def _value_of(estimate: m.MapEstimate) -> LandmarkGaussian:
    return LandmarkGaussian(
        *translate.landmarks_of(estimate), translate.landmark_covariance_of(estimate)
    )


RULES: Mapping[str, Callable[[Sequence[LandmarkGaussian]], LandmarkGaussian]] = {
    "kalman": kalman,
    "kalman-per-axis": kalman_per_axis,
    "covariance-intersection": covariance_intersection,
}
_NOT_VALID = "this rule counts measurements more than once: its covariance is not valid"


class RoundsCentre(ComparisonCentre):
    """Fusion of each round's maps in order of names; stores submaps for restarted robots."""

    inputs = (ch.START, ch.SUBMAP, ch.OWN_MAP)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._rounds: dict[int, dict[str, m.MapEstimate]] = {}
        self._next = 1
        self._fused: m.FusedMap | None = None

    def file(self, message: m.Message) -> list[Outgoing]:
        """File a map under its round."""
        if isinstance(message, m.MapEstimate):
            if message.exchange >= self._next:
                self._rounds.setdefault(message.exchange, {})[message.robot] = message
        elif isinstance(message, m.InitialPose | m.Submap):
            self.store.add(message)
        return []

    def publish_due(self) -> list[Outgoing]:
        """Make the map of every complete round."""
        later = min(self._rounds, default=self._next)
        if self._is_complete(later):
            self._next = later
        out = []
        while self._is_complete(self._next):
            maps = self._rounds.pop(self._next)
            out.append(self._fuse(self._next, [maps[robot] for robot in sorted(maps)]))
            self._next += 1
        return out

    def publish_final(self) -> list[Outgoing]:
        """The last round's map as the final one."""
        return [Outgoing(ch.FINAL_MAP, "", self._final(self.attendance.now_ns))]

    def recomputed(
        self, log: "Recorded", maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
    ) -> Iterator[Outgoing]:
        """Recompute the rounds in order from their recorded maps."""
        for fused in sorted(maps, key=lambda each: each.exchange):
            yield self._fuse(fused.exchange, _recorded_maps(log, fused))
        for fused in finals:
            yield Outgoing(ch.FINAL_MAP, "", self._final(fused.stamp_ns))

    def _is_complete(self, number: int) -> bool:
        maps = self._rounds.get(number, {})
        # A robot, even a lost one, may still send its map until it is done or given up.
        return bool(maps) and all(
            name in maps or robot.done is not None or robot.given_up
            for name, robot in self.attendance.robots.items()
        )

    def _final(self, now_ns: int) -> m.FusedMap:
        last = self._fused
        if last is None:
            last = self._message(0, now_ns, (), NO_LANDMARKS, b"")
        counted_often = self.config.fusion != "covariance-intersection"
        reasons = (*last.reasons, *([_NOT_VALID] if counted_often else []))
        return msgspec.structs.replace(last, final=True, reasons=reasons)

    def _fuse(self, number: int, maps: Sequence[m.MapEstimate]) -> Outgoing:
        values = {x.robot: _value_of(x) for x in maps}
        value, refused = fuse_maps(
            RULES[self.config.fusion], values, self.config.bounds.coordinate_m
        )
        payload = b"".join(x.ids + x.means + x.covariance for x in maps)
        previous = b"" if self._fused is None else self._fused.digest
        stamp_ns = max(x.stamp_ns for x in maps)
        self._fused = self._message(
            number, stamp_ns, _members_of(maps), value, payload + previous, refused
        )
        return Outgoing(ch.FUSED_MAP, "", self._fused)

    def _message(
        self,
        number: int,
        stamp_ns: int,
        members: tuple[m.VersionEntry, ...],
        value: LandmarkGaussian,
        inputs: bytes,
        reasons: tuple[str, ...] = (),
    ) -> m.FusedMap:
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            digest_of(self.config_digest, number.to_bytes(8, "little"), inputs),
            value,
            members,
            stamp_ns=stamp_ns,
            joint=self.config.fusion != "kalman-per-axis",
            exchange=number,
            reasons=reasons,
        )
