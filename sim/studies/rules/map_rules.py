"""Rules on whole maps that no robot absorbs: fused once, or not at all."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.fused_map import fused_message
from teamslam.sim.studies.rules.centre import ComparisonCentre, recorded_maps
from teamslam.sim.studies.rules.map_fusion import fuse_maps, kalman
from teamslam.team import translate
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.digest import digest_of

if TYPE_CHECKING:
    from teamslam.central.desk.verification.recorded import Recorded

Maps = Sequence[m.MapEstimate]
Starts = Mapping[Stream, m.InitialPose]


class NewestMapsCentre(ComparisonCentre):
    """Newest map of every robot, and initial poses.

    names_inputs: a map follows from its named maps alone.
    """

    inputs = (ch.START, ch.OWN_MAP)
    names_inputs = True

    def __init__(
        self, config: CentralConfig, robots: Sequence[str], *, admit: bool = False
    ) -> None:
        super().__init__(config, robots, admit=admit)
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
                own, final = recorded_maps(log, each), channel is ch.FINAL_MAP
                fused = self.fuse(own, starts, each.stamp_ns, final=final)
                if not self.names_inputs:
                    fused = msgspec.structs.replace(fused, reasons=each.reasons)
                yield Outgoing(channel, "", fused)


class LatestCentre(NewestMapsCentre):
    """Latest map of every robot as one, without feedback, for known initial poses."""

    names_inputs = False

    def __init__(
        self, config: CentralConfig, robots: Sequence[str], *, admit: bool = False
    ) -> None:
        super().__init__(config, robots, admit=admit)
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
        named = {(x.robot, x.incarnation): x.sequence for x in maps if is_placed(x, self._starts)}
        if all(self._published.get(stream, -1) >= last for stream, last in named.items()):
            return []
        self._published, self._published_ns = named, self.attendance.now_ns
        fused = self.fuse(maps, self._starts, self.attendance.now_ns, final=False)
        return [Outgoing(ch.FUSED_MAP, "", fused)]

    def fuse(self, maps: Maps, starts: Starts, now_ns: int, *, final: bool) -> m.FusedMap:
        """Fuse the maps in the team's frame."""
        placed = [each for each in maps if is_placed(each, starts)]
        values = {x.robot: value_of(x) for x in placed}
        value, refused = fuse_maps(kalman, values, self.config.bounds.coordinate_m)
        away = sorted({x.robot for x in maps} - {x.robot for x in placed})
        reasons = (*(f"{robot}: its start pose is not known" for robot in away), *refused)
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            _digest(self.config_digest, placed),
            value,
            members_of(placed),
            stamp_ns=max((x.stamp_ns for x in placed), default=0),
            final=final,
            reasons=reasons,
        )


class AloneCentre(NewestMapsCentre):
    """No fusion: a final map for single-robot teams only."""

    def fuse(self, maps: Maps, starts: Starts, now_ns: int, *, final: bool) -> m.FusedMap:
        """The map of a single robot; for several an empty map, with the reason."""
        reason = ""
        if not maps:
            reason = "no fusion, and this estimator makes no map"
        elif len(self.robots) != 1:
            reason = "no fusion: each robot has its own map"
        value = NO_LANDMARKS if reason else value_of(maps[0])
        self.landmarks = len(value.ids)
        return fused_message(
            self.config,
            _digest(self.config_digest, maps),
            value,
            members_of(maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=now_ns),
            final=True,
            joint=not maps or maps[0].joint,
            reasons=(reason,) if reason else (),
        )


def is_placed(estimate: m.MapEstimate, starts: Mapping[Stream, m.InitialPose]) -> bool:
    """Whether the initial pose of a map's stream is known."""
    start = starts.get((estimate.robot, estimate.incarnation))
    return start is not None and bool(start.pose)


def _name(estimate: m.MapEstimate) -> tuple[int, int]:
    return estimate.incarnation, estimate.sequence


def members_of(maps: Sequence[m.MapEstimate]) -> tuple[m.VersionEntry, ...]:
    """Names of these maps."""
    return tuple(
        m.VersionEntry(robot=x.robot, incarnation=x.incarnation, sequence=x.sequence) for x in maps
    )


def _digest(settings: bytes, maps: Sequence[m.MapEstimate]) -> bytes:
    return digest_of(settings, *(x.ids + x.means + x.covariance for x in maps))


def value_of(estimate: m.MapEstimate) -> LandmarkGaussian:
    """The landmarks of a robot's own map."""
    return LandmarkGaussian(
        *translate.landmarks_of(estimate), translate.landmark_covariance_of(estimate)
    )
