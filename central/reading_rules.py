"""The rule on raw readings: multi-robot FastSLAM at the centre (Ma & Ma, section IV-D)."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from central.config import CentralConfig
from central.fused import START_POSES, fused_message
from central.roll import Roll
from central.rules import NOTHING, MapEstimate
from central.team_epochs import RobotEpoch, TeamEpochs
from team import translate
from team.config import RobotConfig
from team.estimation import joint_fastslam
from team.estimation.gaussian import Matrix
from team.estimation.geometry import Pose
from team.estimation.joint_fastslam import JointFastSlam, Turn
from team.estimation.models import Increment
from team.estimation.randomness import generator
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing

RESAMPLE_BELOW = 1.0
"""Algorithm 1 resamples at every step."""
POSE_FLOOR = np.diag([1e-6, 1e-6, 1e-8])
"""Added to a pose's covariance [m², m², rad²]: fewer than four particles may differ."""


class JointFastSlamRule:
    """One particle filter over all robots' paths and one map, on their raw readings.

    The particles are those of FastSLAM 1.0, `particles` of them; the epochs of one team time are
    one step. The robots' models come with what they announce. A robot whose start pose is not known
    is left out; where no start is known the first robot's is the frame. A map's members name each
    robot's last reading in it.
    """

    listens = (*ch.SENSORS, ch.ROBOT_CONFIG)
    submaps = 0
    findings: tuple[str, ...] = ()

    def __init__(self, config: CentralConfig, digest: bytes, robots: Sequence[str]) -> None:
        self._config = config
        self._config_digest = digest
        self._epochs = TeamEpochs(robots)
        self._state: JointFastSlam | None = None
        self._robots: dict[str, RobotConfig] = {}
        self._members: dict[str, m.Member] = {}
        self._pose_ns: dict[str, int] = {}
        self._reasons: list[str] = []
        self._frame = START_POSES
        self._generator = generator(0, "team", 0, 0)
        self._broadcast_ns: int | None = None
        self._now_ns = 0
        self.landmarks = 0
        self.warnings: list[str] = []

    @property
    def figures(self) -> Mapping[str, float]:
        """The particles."""
        return {"particles": float(self._config.particles)}

    def take(self, message: m.Message, now_ns: int) -> list[Outgoing]:
        """File a reading, a robot's models or the last counters."""
        match message:
            case m.Reading():
                self._epochs.put(message)
            case m.Configured() if message.node.startswith("robot/"):
                self._configure(message)
            case m.End():
                self._epochs.end(message)
            case _:
                pass
        return []

    def _configure(self, message: m.Configured) -> None:
        try:
            config = msgspec.json.decode(message.configuration, type=RobotConfig)
        except msgspec.DecodeError as error:
            self.warnings.append(f"{message.node} runs another version: {error}")
        else:
            self._epochs.configure(config.id, config)

    def dealt(self, done: m.Done) -> bool:
        """Nothing that the robot itself has sent is needed."""
        return True

    def complete(self, end: m.End) -> bool:
        """Every reading of every stream has been used."""
        return self._epochs.complete

    def advance(self, roll: Roll) -> list[Outgoing]:
        """Every step whose turn has come: the poses, and the map at broadcasts."""
        if self._state is None and not self._begin():
            return []
        out: list[Outgoing] = []
        for step in self._epochs.steps():
            out += self._broadcast(step[0].stamp_ns)
            out += self._take_step(step)
        return out

    def conclude(self, now_ns: int) -> list[Outgoing]:
        """The map after the last step."""
        return [Outgoing(ch.FINAL_MAP, "", self._fused(final=True))]

    def chain(self, robot: str) -> tuple[m.Start, Sequence[m.Submap]] | None:
        """It keeps no submaps: a robot that was started again takes its stream from the start."""
        return None

    def wanted(self, now_ns: int) -> list[m.ReadingsWanted]:
        """Readings that the link has lost."""
        return self._epochs.wanted(now_ns)

    def _begin(self) -> bool:
        """The particles at the start poses, when all of them are here."""
        starts = self._epochs.starts
        if not starts:
            return False
        placed = {name: start for name, (_, start) in starts.items() if start.pose}
        if not placed:
            name = min(starts)
            placed = {name: starts[name][1]}
            self._frame = f"{name}/{placed[name].epoch}"
        self._robots = {name: starts[name][0] for name in sorted(placed)}
        away = sorted(starts.keys() - placed.keys())
        self._reasons += [f"{name}: its start pose is not known" for name in away]
        first = self._robots[min(self._robots)]
        self._generator = generator(first.seed, "team", 0, 0)
        known = {name: translate.pose_of(placed[name]) for name in self._robots}
        poses = {n: np.zeros(3) if pose is None else pose for n, (pose, _) in known.items()}
        particles = self._config.particles
        self._state = joint_fastslam.begun(poses, particles, "fastslam1", RESAMPLE_BELOW)
        turns = [
            _uncertain(name, poses[name], covariance, self._robots[name])
            for name, (_, covariance) in known.items()
            if covariance is not None
        ]
        if turns:
            self._state = joint_fastslam.stepped(self._state, turns, self._generator)
        self._members = {n: m.Member(n, placed[n].epoch, 0) for n in self._robots}
        return True

    def _take_step(self, step: Sequence[RobotEpoch]) -> list[Outgoing]:
        step = [each for each in step if each.robot in self._robots]
        if not step or self._state is None:
            return []
        turns = [
            Turn(
                each.robot,
                each.epoch.increment,
                self._robots[each.robot].sensor,
                each.epoch.ids,
                each.epoch.ranges,
                each.epoch.bearings,
            )
            for each in step
        ]
        self._state = joint_fastslam.stepped(self._state, turns, self._generator)
        self._now_ns = step[-1].stamp_ns
        out = []
        for each in step:
            member = self._members[each.robot]
            self._members[each.robot] = m.Member(each.robot, member.epoch, each.reading)
            out += self._pose(self._state, each)
        return out

    def _pose(self, state: JointFastSlam, each: RobotEpoch) -> list[Outgoing]:
        last_ns, robot = self._pose_ns.get(each.robot), each.robot
        if last_ns is not None and each.stamp_ns - last_ns < self._robots[robot].pose_s * 1e9:
            return []
        self._pose_ns[robot] = each.stamp_ns
        mean, covariance = joint_fastslam.pose_gaussian(state, robot)
        message = translate.pose_message(
            each.stamp_ns,
            robot,
            self._members[robot].epoch,
            each.reading,
            translate.NO_MAP,
            mean,
            covariance + POSE_FLOOR,
        )
        return [Outgoing(ch.CENTRAL_POSE, robot, message)]

    def _broadcast(self, stamp_ns: int) -> list[Outgoing]:
        """The map before the first step of each broadcast_s of team time."""
        if self._broadcast_ns is None:
            self._broadcast_ns = stamp_ns
        if stamp_ns - self._broadcast_ns < self._config.broadcast_s * 1e9:
            return []
        self._broadcast_ns = stamp_ns
        return [Outgoing(ch.FUSED_MAP, "", self._fused(final=False))]

    def _fused(self, *, final: bool) -> m.FusedMap:
        members = tuple(self._members[robot] for robot in sorted(self._members))
        value = NOTHING
        if self._state is not None:
            value = MapEstimate(*joint_fastslam.landmark_gaussian(self._state))
        self.landmarks = len(value.ids)
        lost = [f"{robot}: its stream began anew" for robot in self._epochs.broken]
        named = b"".join(f"{x.robot}/{x.epoch}/{x.sequence} ".encode() for x in members)
        return fused_message(
            self._config,
            translate.digest_of(self._config_digest, named),
            value,
            members,
            stamp_ns=self._now_ns,
            final=final,
            frame=self._frame,
            reasons=(*self._reasons, *lost) if final else (),
        )


def _uncertain(robot: str, pose: Pose, covariance: Matrix, config: RobotConfig) -> Turn:
    """A start with this covariance in (x, y, θ): a motion by nothing with its noise."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    own = G.T @ covariance @ G
    nothing = np.empty(0)
    start = Increment(np.zeros(3), 0.5 * (own + own.T))
    return Turn(robot, start, config.sensor, np.empty(0, np.uint32), nothing, nothing)
