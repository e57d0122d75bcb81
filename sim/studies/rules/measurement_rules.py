"""The common part of rules on raw measurements: the team's keyframes in, poses and the map out."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.fused import START_POSES, fused_message
from central.intake import Inputs, Instant, Intake
from central.rule import FusionRule, Tail
from sim.studies.estimators.robot_step import RobotStep
from sim.studies.rules.team_keyframes import RobotKeyframe, TeamKeyframes
from team import translate
from team.config import RobotConfig
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.geometry import Pose, inverse
from team.estimation.mount import moved_by
from team.estimation.plausible import start_beyond
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing
from team.wire.digest import NO_MAP, digest_of


@dataclass(frozen=True)
class MapContent:
    """The contents of a map: the landmarks and, where the rule has one, the joint cost.

    before: messages that go out before it.
    """

    landmarks: LandmarkGaussian = NO_LANDMARKS
    chi2: float = 0.0
    dof: int = 0
    before: tuple[Outgoing, ...] = ()


@dataclass(frozen=True, kw_only=True)
class MeasurementInputs(Inputs):
    """The team's keyframes, those of one team time as one step; they grow.

    starts: the models and the initial pose of each robot, once all are here. broken: robots whose
    stream began anew.
    """

    starts: Mapping[str, tuple[RobotConfig, m.InitialPose]] = field(default_factory=dict)
    steps: Sequence[Sequence[RobotKeyframe]] = ()
    broken: Sequence[str] = ()


class MeasurementIntake(Intake[MeasurementInputs]):
    """Collects raw measurements and the models that the robots announce; the keyframes are the
    clock.
    """

    listens = (*ch.SENSORS, ch.ROBOT_CONFIG)
    due = "period"

    def __init__(self, config: CentralConfig, robots: Sequence[str]) -> None:
        super().__init__(config, robots)
        self._keyframes = TeamKeyframes(robots)
        self._starts: Mapping[str, tuple[RobotConfig, m.InitialPose]] = {}
        self._steps: list[Sequence[RobotKeyframe]] = []

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """File a measurement, a robot's models or the last counters."""
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
    def complete(self) -> bool:
        """True once every measurement of every stream has been used."""
        return self._keyframes.complete

    def inputs(self, closed_ns: float, now_ns: int) -> MeasurementInputs:
        """All steps that are complete."""
        return MeasurementInputs(
            now_ns=now_ns,
            starts=self._starts,
            steps=self._steps,
            broken=self._keyframes.broken,
        )

    def instants(self, attendance: TeamAttendance) -> Iterator[Instant[MeasurementInputs]]:
        """An instant before every complete step, when a map may be due, and one after the last."""
        self._starts = self._starts or self._keyframes.starts or {}
        if not self._starts:
            return
        for step in self._keyframes.steps():
            now_ns = step[0].stamp_ns
            since_ns = self._steps[0][0].stamp_ns if self._steps else now_ns
            yield Instant(now_ns, self.inputs(now_ns, now_ns), since_ns)
            self._steps.append(step)
            yield Instant(now_ns, self.inputs(now_ns, now_ns), since_ns)

    def requests(self, now_ns: int) -> list[m.MeasurementsRequest]:
        """Requests for measurements that the link has lost."""
        return self._keyframes.requests(now_ns)


class MeasurementRule(FusionRule[MeasurementInputs]):
    """An estimate over all robots' raw measurements at the centre.

    The keyframes of one team time are one step. The robots announce their models. A robot with an
    unknown initial pose is left out; where no initial pose is known the first robot's is the frame.
    A map's members name each robot's last measurement in it.
    """

    intake = MeasurementIntake

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str]) -> None:
        super().__init__(config, digest, robots)
        self._taken = 0
        self.models: dict[str, RobotConfig] = {}
        self.members: dict[str, m.VersionEntry] = {}
        self._pose_ns: dict[str, int] = {}
        self._reasons: list[str] = []
        self._frame = START_POSES
        self.now_ns = 0

    @abstractmethod
    def _start(self, starts: Mapping[str, tuple[Pose, Matrix | None]]) -> None:
        """Begin with the robots' initial poses; covariances in (x, y, θ), None: exactly known."""

    @abstractmethod
    def _take(self, step: Sequence[RobotKeyframe], turns: Sequence[RobotStep]) -> list[Outgoing]:
        """Process one step of the team, which the members already name; returns the poses to
        publish.
        """

    @abstractmethod
    def _content(self, *, final: bool) -> MapContent:
        """The map of all steps so far."""

    def fuse(self, inputs: MeasurementInputs, tail: Tail) -> list[Outgoing]:
        """The map of all steps, after their poses."""
        return [*self.take(inputs), *self._map_messages(inputs.broken, final=tail == "final")]

    def take(self, inputs: MeasurementInputs) -> list[Outgoing]:
        """Process the new steps; returns the poses to publish."""
        if not self.models and inputs.starts:
            self._begin(inputs.starts)
        out: list[Outgoing] = []
        for step in inputs.steps[self._taken :]:
            self._taken += 1
            out += self._take_step([each for each in step if each.robot in self.models])
        return out

    def _begin(self, starts: Mapping[str, tuple[RobotConfig, m.InitialPose]]) -> None:
        """Place the robots' initial poses in one frame."""
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
                name: self._sensors_start(name, np.zeros(3) if pose is None else pose, covariance)
                for name, (pose, covariance) in known.items()
            }
        )

    def _sensors_start(
        self, robot: str, pose: Pose, covariance: Matrix | None
    ) -> tuple[Pose, Matrix | None]:
        """The initial pose of the robot's sensor, of which the keyframes are."""
        sensor = self.models[robot].sensor
        if not sensor.is_mounted:
            return pose, covariance
        uncertain = np.zeros((3, 3)) if covariance is None else covariance
        start = moved_by(PoseGaussian(pose, uncertain), np.array(sensor.mount))
        return start.mean, None if covariance is None else start.covariance

    def _is_placed(self, start: m.InitialPose) -> bool:
        """Whether the initial pose is known, and within the bounds."""
        value = translate.start_of(start)
        return value is not None and start_beyond(value, self.config.bounds) is None

    def _take_step(self, step: Sequence[RobotKeyframe]) -> list[Outgoing]:
        if not step:
            return []
        turns = [
            RobotStep(
                each.robot,
                each.keyframe.increment,
                self.models[each.robot].sensor,
                each.keyframe.ids,
                each.keyframe.ranges,
                each.keyframe.bearings,
                each.keyframe.own,
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
        """Whether the robot's `pose_s` have passed since its last pose."""
        last_ns = self._pose_ns.get(each.robot)
        pose_ns = self.models[each.robot].pose_s * 1e9
        return last_ns is None or each.stamp_ns - last_ns >= pose_ns

    def pose(self, each: RobotKeyframe, pose: PoseGaussian) -> Outgoing:
        """The pose at the end of a keyframe."""
        self._pose_ns[each.robot] = each.stamp_ns
        sensor = self.models[each.robot].sensor
        if sensor.is_mounted:
            pose = moved_by(pose, inverse(np.array(sensor.mount)))
        incarnation = self.members[each.robot].incarnation
        message = translate.pose_message(
            each.stamp_ns,
            each.robot,
            incarnation,
            each.number,
            NO_MAP,
            *pose,
            frame=self._frame,
            in_team_frame=True,
        )
        return Outgoing(ch.CENTRAL_POSE, each.robot, message)

    @property
    def digest(self) -> bytes:
        """The name of the set of measurements so far."""
        members = (self.members[robot] for robot in sorted(self.members))
        named = b"".join(f"{x.robot}/{x.incarnation}/{x.sequence} ".encode() for x in members)
        return digest_of(self.config_digest, named)

    def _map_messages(self, broken: Sequence[str], *, final: bool) -> list[Outgoing]:
        content = self._content(final=final) if self.models else MapContent()
        self.landmarks = len(content.landmarks.ids)
        lost = [f"{robot}: its stream began anew" for robot in broken]
        fused = fused_message(
            self.config,
            self.digest,
            content.landmarks,
            tuple(self.members[robot] for robot in sorted(self.members)),
            stamp_ns=self.now_ns,
            final=final,
            frame=self._frame,
            cost=(content.chi2, content.dof),
            reasons=(*self._reasons, *lost, *self.findings) if final else (),
        )
        return [*content.before, Outgoing(ch.FINAL_MAP if final else ch.FUSED_MAP, "", fused)]
