"""The rules on robots' whole maps that no robot absorbs: fused once, or not at all."""

from collections.abc import Iterator, Mapping, Sequence

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.fused import fused_message
from central.intake import Instant, Intake, MapInputs
from central.rule import FusionRule, Tail
from sim.studies.rules.map_fusion import fused_totally, kalman
from team import translate
from team.estimation.contribution import Stream
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.digest import digest_of


class NewestMaps(Intake[MapInputs]):
    """The newest map of every robot, and the initial poses of the streams."""

    listens = (ch.START, ch.OWN_MAP)

    def __init__(self, config: CentralConfig, robots: Sequence[str]) -> None:
        super().__init__(config, robots)
        self._maps: dict[str, m.MapEstimate] = {}
        self._starts: dict[Stream, m.InitialPose] = {}

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """Store an initial pose, or a map that is newer than the robot's last one."""
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

    def inputs(self, closed_ns: float, now_ns: int) -> MapInputs:
        """The maps by robot."""
        maps = [self._maps[robot] for robot in sorted(self._maps)]
        return MapInputs(now_ns=now_ns, maps=maps, starts=self._starts)

    def instants(self, attendance: TeamAttendance) -> Iterator[Instant[MapInputs]]:
        """One instant, now."""
        yield Instant(attendance.now_ns, self.inputs(float("inf"), attendance.now_ns))

    def members(self, until_ns: float) -> Mapping[Stream, int]:
        """The maps in the team's frame."""
        placed = (each for each in self._maps.values() if is_placed(each, self._starts))
        return {(each.robot, each.incarnation): each.sequence for each in placed}

    def dealt(self, done: m.Done) -> bool:
        """True once the robot's last map and the initial pose of its stream have arrived."""
        found = self._maps.get(done.robot)
        last = (done.incarnation, done.last_map)
        return done.last_map < 0 or (
            found is not None
            and _name(found) >= last
            and (done.robot, done.incarnation) in self._starts
        )


def is_placed(estimate: m.MapEstimate, starts: Mapping[Stream, m.InitialPose]) -> bool:
    """Whether a map is in the team's frame: its stream's initial pose is known."""
    start = starts.get((estimate.robot, estimate.incarnation))
    return start is not None and bool(start.pose)


class LatestRule(FusionRule[MapInputs]):
    """The latest whole map of every robot as one, nothing fed back (`kalman` of independent maps).

    Each map rests on its own robot's measurements alone, so the maps are independent and no
    measurement is counted twice: the result is as consistent as the maps are. A robot whose initial
    pose is not known has its map in a frame of its own and is left out.
    """

    intake = NewestMaps
    unnamed = ("reasons",)

    def fuse(self, inputs: MapInputs, tail: Tail) -> list[Outgoing]:
        """The fusion of these maps."""
        maps = [each for each in inputs.maps if is_placed(each, inputs.starts)]
        values = {x.robot: _value(x) for x in maps}
        value, refused = fused_totally(kalman, values, self.config.bounds.coordinate_m)
        away = sorted({x.robot for x in inputs.maps} - {x.robot for x in maps})
        reasons = (*(f"{robot}: its start pose is not known" for robot in away), *refused)
        self.landmarks = len(value.ids)
        final = tail == "final"
        fused = fused_message(
            self.config,
            _digest(self.config_digest, maps),
            value,
            _members(maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=0),
            final=final,
            reasons=reasons,
        )
        return [Outgoing(ch.FINAL_MAP if final else ch.FUSED_MAP, "", fused)]


class AloneRule(FusionRule[MapInputs]):
    """No fusion: publishes a final map for single-robot teams only."""

    intake = NewestMaps

    def fuse(self, inputs: MapInputs, tail: Tail) -> list[Outgoing]:
        """The map of the one robot; of several robots a map without landmarks, with the reason."""
        if tail != "final":
            return []
        maps, reason = inputs.maps, ""
        if not maps:
            reason = "no fusion, and this estimator makes no map"
        elif len(self.team) != 1:
            reason = "no fusion: each robot has its own map"
        value = NO_LANDMARKS if reason else _value(maps[0])
        self.landmarks = len(value.ids)
        fused = fused_message(
            self.config,
            _digest(self.config_digest, maps),
            value,
            _members(maps),
            stamp_ns=max((x.stamp_ns for x in maps), default=inputs.now_ns),
            final=True,
            joint=not maps or maps[0].joint,
            reasons=(reason,) if reason else (),
        )
        return [Outgoing(ch.FINAL_MAP, "", fused)]


def _name(estimate: m.MapEstimate) -> tuple[int, int]:
    return estimate.incarnation, estimate.sequence


def _members(maps: Sequence[m.MapEstimate]) -> tuple[m.VersionEntry, ...]:
    return tuple(
        m.VersionEntry(robot=x.robot, incarnation=x.incarnation, sequence=x.sequence) for x in maps
    )


def _digest(settings: bytes, maps: Sequence[m.MapEstimate]) -> bytes:
    return digest_of(settings, *(x.ids + x.means + x.covariance for x in maps))


def _value(estimate: m.MapEstimate) -> LandmarkGaussian:
    return LandmarkGaussian(
        *translate.landmarks_of(estimate), translate.landmark_covariance_of(estimate)
    )
