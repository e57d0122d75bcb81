"""Recompute one robot's messages: its node over its recorded measurements."""

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import takewhile
from typing import Any

from teamslam.central.desk.verification.recorded import (
    Identity,
    Recorded,
    RecordedMeasurements,
    RecordedWindow,
    RunAlone,
    identity,
)
from teamslam.team.config import RobotConfig
from teamslam.team.containment import Boundary
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.estimation.hybrid_slam.window_path import window_path
from teamslam.team.pairs import FEEDBACK
from teamslam.team.registry import load
from teamslam.team.robot.node import robot_node
from teamslam.team.robot.poses import PoseEstimator, RunningPoses, outside_team_frame
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing

LOCKSTEP = "teamslam.sim.studies.robots.node:in_lockstep"
"""Recomputes a robot under a rule with feedback."""
PriorsNamed = Mapping[tuple[int, int], Sequence[m.Prior | None]]
"""Priors of the recorded poses, by (incarnation, stamp); None: a pose without prior."""
WithdrawnAt = Collection[tuple[int, int]]
"""Own poses that were also published on team/pose, by (incarnation, stamp)."""


class _RecordedPoses(RunningPoses):
    """Poses at the log's stamps, each with the prior that it names.

    Priors depend on arrival times, which a log does not have.
    """

    def __init__(
        self, config: RobotConfig, recorded: PriorsNamed, withdrawn: WithdrawnAt = ()
    ) -> None:
        super().__init__(config, deque(maxlen=0))
        self._recorded = recorded
        self._withdrawn = withdrawn

    def publish(self, stamp_ns: int, estimator: PoseEstimator) -> list[Outgoing]:
        out: list[Outgoing] = []
        incarnation = estimator.writer.incarnation
        for prior in self._recorded.get((incarnation, stamp_ns), ()):
            here = prior if prior is not None and prior.incarnation == incarnation else None
            out += self.estimate(stamp_ns, here, estimator)
        if out and (incarnation, stamp_ns) in self._withdrawn:
            out.append(outside_team_frame(out[0]))
        return out


class _RecomputedRobot:
    def __init__(
        self,
        config: RobotConfig,
        digest: bytes,
        recorded: PriorsNamed,
        withdrawn: WithdrawnAt = (),
        **options: Any,
    ) -> None:
        poses = _RecordedPoses(config, recorded, withdrawn)
        self.node = robot_node(config, announced=digest, poses=poses, **options)
        self._boundary = Boundary(ch.robot_node(config.id))

    def given(self, message: m.Message) -> list[Outgoing]:
        return self._boundary.hand(self.node, message)

    def take_known_map(self, log: Recorded) -> None:
        if log.known_map is not None and ch.KNOWN_MAP in self.node.listens:
            self.given(log.known_map)


NewRobot = Callable[[], _RecomputedRobot]


def recompute_robot(log: Recorded, robot: str) -> dict[Identity, m.Message]:
    """Recompute the messages that follow from a robot's measurements."""
    config, digest = log.robot_config(robot)
    named, withdrawn = _priors_named(log, robot), _withdrawn_at(log, robot)

    def new() -> _RecomputedRobot:
        robot = _RecomputedRobot(config, digest, named, withdrawn)
        robot.take_known_map(log)
        return robot

    lives = _run_incarnations
    if config.fusion in FEEDBACK:
        lives = load(LOCKSTEP, f"the fusion rule {config.fusion}")
    found: dict[Identity, m.Message] = {}
    for out in lives(log, robot, new):
        found.setdefault(identity(out.key, out.message), out.message)
    return found


def _priors_named(log: Recorded, robot: str) -> PriorsNamed:
    received = log.of(m.Prior, ch.PRIOR, ch.TEAM_PRIOR)
    priors = {prior.digest: prior for prior in received if prior.robot == robot}
    used: dict[tuple[int, int], list[m.Prior | None]] = {}
    for pose in log.of(m.PoseEstimate, ch.TEAM_POSE, ch.OWN_POSE):
        if pose.robot != robot:
            continue
        names = used.setdefault((pose.incarnation, pose.stamp_ns), [])
        prior = priors.get(pose.map_digest)
        if prior not in names if prior is not None else not names:
            names.append(prior)
    return used


def _withdrawn_at(log: Recorded, robot: str) -> WithdrawnAt:
    own = (pose for pose in log.of(m.PoseEstimate, ch.TEAM_POSE) if pose.robot == robot)
    return {(p.incarnation, p.stamp_ns) for p in own if not p.in_team_frame}


def _run_incarnations(log: Recorded, robot: str, new: NewRobot) -> Iterator[Outgoing]:
    """Each incarnation and each ended process is independent; a `Done` names the process.

    A process that resumed after a submap is computed from there, as is the rest after a missing
    measurement.
    """
    for incarnation in log.incarnations(robot):
        measurements = log.measurements[(robot, incarnation)]
        chain = _chain(log, robot, incarnation)
        dones = _dones(log, robot, incarnation)
        lives = [(_first_of(done, chain, measurements), done.measurements) for done in dones]
        if not any(first == 0 for first, _ in lives):
            yield from _life(new, measurements, chain, 0, None)
        for first, until in lives:
            yield from _life(new, measurements, chain, first, until)


def _dones(log: Recorded, robot: str, incarnation: int) -> list[m.Done]:
    dones = log.of(m.Done, ch.ROBOT_DONE)
    return [d for d in dones if (d.robot, d.incarnation) == (robot, incarnation)]


def _chain(log: Recorded, robot: str, incarnation: int) -> list[m.Submap]:
    found = log.submaps().get((robot, incarnation), {})
    return [found[k] for k in takewhile(found.__contains__, range(len(found)))]


def _first_of(done: m.Done, chain: Sequence[m.Submap], measurements: RecordedMeasurements) -> int:
    """Number of a process's first measurement: `done.steps` odometry intervals before its last."""
    last = min(done.measurements, measurements.last + 1)
    odometry = measurements.odometry()
    before_last = bisect_left(odometry, last)
    begins = {0, *(submap.last_measurement + 1 for submap in chain)}
    for counter in sorted((each for each in begins if each <= last), reverse=True):
        if before_last - bisect_left(odometry, counter) == done.steps:
            return counter
    return 0


def _life(
    new: NewRobot,
    measurements: RecordedMeasurements,
    chain: Sequence[m.Submap],
    first: int,
    until: int | None,
) -> Iterator[Outgoing]:
    start = measurements.get(0)
    if not isinstance(start, m.InitialPose):
        return
    last = measurements.last + 1 if until is None else until
    while True:
        node = new()
        if first:
            node.node.resume(start, [s for s in chain if s.last_measurement < first])
        counter = first
        for each in measurements.consecutive(first, last):
            yield from node.given(each)
            counter += 1
        if counter == last and until is not None:
            end = m.StreamEnd(robot=start.robot, incarnation=start.incarnation, measurements=until)
            yield from node.given(m.End(stamp_ns=0, streams=(end,)))
        behind = (s.last_measurement + 1 for s in chain if counter <= s.last_measurement < last)
        following = next((b for b in behind if b in measurements), None)
        if counter >= last or following is None:
            return
        first = following


def run_alone(log: Recorded, robot: str, incarnation: int) -> RunAlone:
    """Run a robot's node, without a centre, over an incarnation; once per log."""
    stream = robot, incarnation
    if stream not in log.alone:
        log.alone[stream] = _run_alone(log, robot, incarnation)
    return log.alone[stream]


def _run_alone(log: Recorded, robot: str, incarnation: int) -> RunAlone:
    disposition_of: dict[int, str] = {}
    windows: dict[int, RecordedWindow] = {}

    def on_window(closed: ClosedWindow) -> None:
        path = None
        if closed.window is not None and closed.keyframes_ns:
            path = window_path(closed.window, closed.keyframes_ns)
        windows[closed.end_ns] = RecordedWindow(closed.start_ns, path)

    config, digest = log.robot_config(robot)
    options: dict[str, Any] = {"on_disposition": disposition_of.__setitem__}
    if config.estimator == "hybrid":
        options["on_window"] = on_window
    node = _RecomputedRobot(config, digest, {}, (), **options)
    node.take_known_map(log)
    node.given(m.Liveliness(stamp_ns=0, node="central", alive=False))
    measurements = log.measurements.get((robot, incarnation), RecordedMeasurements())
    done = max((d.measurements for d in _dones(log, robot, incarnation)), default=None)
    consumed = 0
    for each in measurements.consecutive(0, len(measurements) if done is None else done):
        node.given(each)
        consumed += 1
    if consumed and done is not None:
        end = m.StreamEnd(robot=robot, incarnation=incarnation, measurements=consumed)
        node.given(m.End(stamp_ns=0, streams=(end,)))
    return RunAlone([disposition_of.get(number, "lost") for number in range(consumed)], windows)
