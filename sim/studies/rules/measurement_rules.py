"""Centres on raw measurements, among them `joint-fastslam` (Ma & Ma, section IV-D)."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from teamslam.central.fused_map import START_POSES, fused_message
from teamslam.sim.studies.estimators import joint_fastslam
from teamslam.sim.studies.estimators.joint_fastslam import JointFastSlam
from teamslam.sim.studies.estimators.robot_step import POSE_FLOOR, RobotStep, uncertain_start
from teamslam.sim.studies.rules.map_rules import ComparisonCentre
from teamslam.sim.studies.rules.team_keyframes import RobotKeyframe, TeamKeyframes
from teamslam.team import core, translate
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.gaussian import (
    NO_LANDMARKS,
    LandmarkGaussian,
    Matrix,
    NotACovarianceError,
    PoseGaussian,
    start_of_sensor,
)
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.estimation.plausibility import start_beyond
from teamslam.team.estimation.se2 import Pose, inverse
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.digest import NO_MAP, digest_of

if TYPE_CHECKING:
    from teamslam.central.desk.verification.recorded import Recorded


@dataclass(frozen=True)
class MapContent:
    """Landmarks of a map and the joint cost, if any. before: messages that precede it."""

    landmarks: LandmarkGaussian = NO_LANDMARKS
    chi2: float = 0.0
    dof: int = 0
    before: tuple[Outgoing, ...] = ()


class MeasurementCentre(ComparisonCentre):
    """Estimate over all raw measurements at the centre.

    The keyframes of one team time are one step, the clock of the maps. Robots with an unknown
    initial pose are left out; if none is known the first robot's is the frame. Members name the
    robots' last measurements.
    """

    inputs = (*ch.SENSORS, ch.ROBOT_CONFIG)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._keyframes = TeamKeyframes(self.robots)
        self._map_ns: int | None = None
        self.models: dict[str, RobotConfig] = {}
        self.members: dict[str, m.VersionEntry] = {}
        self._pose_ns: dict[str, int] = {}
        self._reasons: list[str] = []
        self._frame = START_POSES
        self.now_ns = 0

    @abstractmethod
    def _start(self, starts: Mapping[str, tuple[Pose, Matrix | None]]) -> None:
        """Begin with initial poses; covariances in (x, y, θ), None: exact."""

    @abstractmethod
    def _take(self, step: Sequence[RobotKeyframe], turns: Sequence[RobotStep]) -> list[Outgoing]:
        pass

    @abstractmethod
    def _content(self, *, final: bool) -> MapContent:
        pass

    def file(self, message: m.Message) -> list[Outgoing]:
        """File a measurement, models or the last counters."""
        match message:
            case m.Measurement():
                self._keyframes.put(message)
            case m.Configuration() if message.node.startswith("robot/"):
                self._configure(message)
            case m.End():
                self._keyframes.end(message)
            case _:
                pass
        return []

    def _configure(self, message: m.Configuration) -> None:
        try:
            config = msgspec.json.decode(message.configuration, type=RobotConfig)
        except msgspec.DecodeError as error:
            self.warnings.append(f"{message.node} runs another version: {error}")
        else:
            self._keyframes.configure(config.id, config)

    @property
    def has_all_measurements(self) -> bool:
        """Whether all measurements have been used."""
        return self._keyframes.complete

    def requests(self) -> list[m.MeasurementsRequest]:
        """Requests for lost measurements."""
        return [] if self.finished else self._keyframes.requests(self.attendance.now_ns)

    def publish_due(self) -> list[Outgoing]:
        """Process complete steps, with a map every broadcast_s."""
        if not self.models and not self._begin():
            return []
        out: list[Outgoing] = []
        for step in self._keyframes.steps():
            step_ns = step[0].stamp_ns
            self._map_ns = step_ns if self._map_ns is None else self._map_ns
            if step_ns - self._map_ns >= self.config.broadcast_s * 1e9:
                out += self._publish_map(final=False)
                self._map_ns = step_ns
            out += self._take_step([each for each in step if each.robot in self.models])
        return out

    def publish_final(self) -> list[Outgoing]:
        """The map of all steps, after their poses."""
        return self._publish_map(final=True)

    def recomputed(
        self, log: "Recorded", maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
    ) -> Iterator[Outgoing]:
        """Recompute the whole stream, since each map changes the next."""
        for message in _inputs_in_order(log):
            self.file(message)
        yield from self.publish_due()
        if log.published:
            yield from self.publish_final()

    def _begin(self) -> bool:
        starts = self._keyframes.starts
        if not starts:
            return False
        placed = {name: start for name, (_, start) in starts.items() if self._is_placed(start)}
        if not placed:
            name = min(starts)
            placed = {name: starts[name][1]}
            self._frame = f"{name}/{placed[name].incarnation}"
        self.models = {name: starts[name][0] for name in sorted(placed)}
        away = sorted(starts.keys() - placed.keys())
        self._reasons += [f"{name}: its start pose is not known" for name in away]
        known = {
            name: translate.pose_of(placed[name]) if self._is_placed(placed[name]) else (None, None)
            for name in self.models
        }
        self.members = {
            n: m.VersionEntry(robot=n, incarnation=placed[n].incarnation, sequence=0)
            for n in self.models
        }
        self._start(
            {
                name: start_of_sensor(
                    np.zeros(3) if pose is None else pose,
                    covariance,
                    np.array(self.models[name].sensor.mount),
                )
                for name, (pose, covariance) in known.items()
            }
        )
        return True

    def _is_placed(self, start: m.InitialPose) -> bool:
        value = translate.start_of(start)
        return value is not None and start_beyond(value, self.config.bounds) is None

    def _take_step(self, step: Sequence[RobotKeyframe]) -> list[Outgoing]:
        if not step:
            return []
        turns = [
            RobotStep(
                each.robot,
                each.increment,
                self.models[each.robot].sensor,
                each.scan.ids,
                each.scan.ranges,
                each.scan.bearings,
                each.scan.own,
            )
            for each in step
        ]
        self.now_ns = step[-1].stamp_ns
        for each in step:
            incarnation = self.members[each.robot].incarnation
            self.members[each.robot] = m.VersionEntry(
                robot=each.robot, incarnation=incarnation, sequence=each.number
            )
        return self._take(step, turns)

    def pose_is_due(self, each: RobotKeyframe) -> bool:
        """Whether a pose is due, by the robot's `pose_s`."""
        last_ns = self._pose_ns.get(each.robot)
        pose_ns = self.models[each.robot].pose_s * 1e9
        return last_ns is None or each.stamp_ns - last_ns >= pose_ns

    def pose(self, each: RobotKeyframe, pose: PoseGaussian) -> Outgoing:
        """The pose at the end of a keyframe."""
        self._pose_ns[each.robot] = each.stamp_ns
        sensor = self.models[each.robot].sensor
        if sensor.is_mounted:
            pose = pose.moved_by(inverse(np.array(sensor.mount)))
        incarnation = self.members[each.robot].incarnation
        mean, covariance = core.pose_bytes(*pose)
        message = m.PoseEstimate(
            stamp_ns=each.stamp_ns,
            robot=each.robot,
            incarnation=incarnation,
            sequence=each.number,
            map_digest=NO_MAP,
            pose=mean,
            covariance=covariance,
            frame=self._frame,
        )
        return Outgoing(ch.CENTRAL_POSE, each.robot, message)

    @property
    def set_digest(self) -> bytes:
        """Digest of the set of measurements so far."""
        members = (self.members[robot] for robot in sorted(self.members))
        named = b"".join(f"{x.robot}/{x.incarnation}/{x.sequence} ".encode() for x in members)
        return digest_of(self.config_digest, named)

    def _publish_map(self, *, final: bool) -> list[Outgoing]:
        content = self._content(final=final) if self.models else MapContent()
        self.landmarks = len(content.landmarks.ids)
        lost = [f"{robot}: its stream began anew" for robot in self._keyframes.broken]
        fused = fused_message(
            self.config,
            self.set_digest,
            content.landmarks,
            tuple(self.members[robot] for robot in sorted(self.members)),
            stamp_ns=self.now_ns,
            final=final,
            frame=self._frame,
            cost=(content.chi2, content.dof),
            reasons=(*self._reasons, *lost, *self.findings) if final else (),
        )
        return [*content.before, Outgoing(ch.FINAL_MAP if final else ch.FUSED_MAP, "", fused)]


def _inputs_in_order(log: "Recorded") -> Iterator[m.Message]:
    for node in sorted(log.configured):
        if node.startswith("robot/"):
            yield log.configured[node]
    for stream in sorted(log.measurements):
        measurements = log.measurements[stream]
        yield from (measurements[counter] for counter in sorted(measurements))
    ends = tuple(
        m.StreamEnd(robot=robot, incarnation=incarnation, measurements=count)
        for (robot, incarnation), count in log.published.items()
    )
    if ends:
        yield m.End(stamp_ns=0, streams=ends)


RESAMPLE_BELOW = 1.0  # resamples at every step, as algorithm 1 does


class JointFastSlamCentre(MeasurementCentre):
    """One particle filter over all paths and one map, by FastSLAM 1.0."""

    _state: JointFastSlam

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._generator = generator(0, "team", 0, 0)

    @property
    def figures(self) -> Mapping[str, float]:
        """The number of particles."""
        return {"particles": float(self.config.particles)}

    def _start(self, starts: Mapping[str, tuple[Pose, Matrix | None]]) -> None:
        first = self.models[min(self.models)]
        self._generator = generator(first.seed, "team", 0, 0)
        poses = {name: pose for name, (pose, _) in starts.items()}
        particles = self.config.particles
        self._state = joint_fastslam.initial_state(poses, particles, "fastslam1", RESAMPLE_BELOW)
        turns = [
            RobotStep(name, uncertain_start(pose, covariance), self.models[name].sensor)
            for name, (pose, covariance) in starts.items()
            if covariance is not None
        ]
        if turns:
            self._state = joint_fastslam.filter_step(self._state, turns, self._generator)

    def _take(self, step: Sequence[RobotKeyframe], turns: Sequence[RobotStep]) -> list[Outgoing]:
        blind = [turn.blind for turn in turns]
        for some in (turns, blind):  # if both fail the particles stay unchanged
            with suppress(NotACovarianceError, np.linalg.LinAlgError), np.errstate(all="ignore"):
                after = joint_fastslam.filter_step(self._state, some, self._generator)
                if np.isfinite(after.poses).all() and np.isfinite(after.newest.log_weights).all():
                    self._state = after
                    break
            self.warnings.append("a step is refused: with it the particles have no weights")
        return [
            self.pose(each, self._pose_gaussian(each.robot))
            for each in step
            if self.pose_is_due(each)
        ]

    def _pose_gaussian(self, robot: str) -> PoseGaussian:
        mean, covariance = joint_fastslam.pose_gaussian(self._state, robot)
        return PoseGaussian(mean, covariance + POSE_FLOOR)

    def _content(self, *, final: bool) -> MapContent:
        return MapContent(joint_fastslam.landmark_gaussian(self._state))
