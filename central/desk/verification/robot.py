"""One robot's messages again: its node over its recorded measurements."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import takewhile

import numpy as np

from central.desk.verification.recorded import Identity, Recorded, identity
from team.config import UNNAMED, RobotConfig
from team.containment import Boundary
from team.pairs import FEEDBACK
from team.rejection import Rejection
from team.robot.front_end import FrontEnd
from team.robot.hybrid import HybridEstimator
from team.robot.node import RobotNode
from team.robot.poses import RunningPoses
from team.robot.statements import MessageWriter
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import ids, stamps
from team.wire.bus import Outgoing

PriorsNamed = Mapping[tuple[int, int], Sequence[m.Prior | None]]
"""By (incarnation, stamp): the priors that the recorded poses name; None: none of them."""


class RecordedPoses(RunningPoses):
    """Poses at the stamps of the log, each given the prior that it names.

    Which prior a running pose found depends on what had arrived, so the pose names it.
    """

    def __init__(self, config: RobotConfig, recorded: PriorsNamed) -> None:
        super().__init__(config, [])
        self._recorded = recorded

    def at(self, stamp_ns: int, front: FrontEnd, writer: MessageWriter) -> list[Outgoing]:
        """The poses of this stamp, by every prior that one of them names."""
        out: list[Outgoing] = []
        for prior in self._recorded.get((writer.incarnation, stamp_ns), ()):
            here = prior if prior is not None and prior.incarnation == writer.incarnation else None
            out += self.posed(stamp_ns, here, front, writer)
        return out


class RecomputedRobot:
    """A robot's node over recorded messages, its poses those of the log.

    The configuration keeps the digest under which it was announced.
    """

    def __init__(self, config: RobotConfig, digest: bytes, recorded: PriorsNamed) -> None:
        self.node = RobotNode(config, announced=digest, poses=RecordedPoses(config, recorded))
        self._boundary = Boundary(ch.robot_node(config.id))
        self._associated: m.Association | None = None

    def given(self, message: m.Message) -> list[Outgoing]:
        """Handle a message as the shell did: one that raises is set aside."""
        out = self._boundary.give(self.node, message)
        for each in out:
            if isinstance(each.message, m.Association):
                self._associated = each.message
        return out

    def silent(self) -> dict[int, str]:
        """By stamp, the scans of the last window none of whose detections is in its submap."""
        said: dict[int, str] = {}
        if self._associated is None:
            return said
        landmarks = ids(self._associated.landmarks, "landmarks")
        bounds = np.cumsum([0, *ids(self._associated.counts, "counts").tolist()])
        for k, stamp in enumerate(stamps(self._associated.stamps, "stamps").tolist()):
            of_scan = landmarks[bounds[k] : bounds[k + 1]]
            if (of_scan < UNNAMED).all():
                clutter = (of_scan == m.CLUTTER).all()
                reason = Rejection.CLUTTER if clutter else Rejection.UNCONFIRMED
                said[stamp] = reason.disposition
        return said

    def took(self, message: m.Message) -> Counter[str]:
        """Take a measurement or the end; the dispositions that it gave, how many of each."""
        begins = isinstance(message, m.InitialPose)
        before = Counter[str]() if begins else Counter(self.node.ledger.counts)
        self.given(message)
        return self.node.ledger.counts - before


NewRobot = Callable[[], RecomputedRobot]


def recomputed_robot(log: Recorded, robot: str) -> dict[Identity, m.Message]:
    """Every message that the robot's measurements give, under the names of its inputs."""
    config, digest = log.robot_config(robot)
    named = _priors_named(log, robot)

    def new() -> RecomputedRobot:
        robot = RecomputedRobot(config, digest, named)
        if log.known_map is not None:
            robot.given(log.known_map)
        return robot

    lives = _in_lockstep if config.fusion in FEEDBACK else _alone
    found: dict[Identity, m.Message] = {}
    for out in lives(log, robot, new):
        found.setdefault(identity(out.key, out.message), out.message)
    return found


def _priors_named(log: Recorded, robot: str) -> PriorsNamed:
    heard = (*log.of(ch.PRIOR), *log.of(ch.TEAM_PRIOR))
    priors = {p.digest: p for p in heard if isinstance(p, m.Prior) and p.robot == robot}
    said: dict[tuple[int, int], list[m.Prior | None]] = {}
    for channel in (ch.TEAM_POSE, ch.OWN_POSE):
        for pose in log.of(channel):
            if not isinstance(pose, m.PoseEstimate) or pose.robot != robot:
                continue
            wanted = said.setdefault((pose.incarnation, pose.stamp_ns), [])
            prior = priors.get(pose.map_digest)
            if prior not in wanted if prior is not None else not wanted:
                wanted.append(prior)
    return said


def _alone(log: Recorded, robot: str, new: NewRobot) -> Iterator[Outgoing]:
    """Without feedback nothing from outside matters: each incarnation by itself, each life that
    ended.

    A `Done` names the life that it closes: up to which measurement, over how many steps. A life
    that began after a submap is computed from there, as a resumed robot does. Where a measurement
    is not in the log, the computation goes on behind the next recorded submap.
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
    said = (d for d in log.of(ch.ROBOT_DONE) if isinstance(d, m.Done))
    return [d for d in said if (d.robot, d.incarnation) == (robot, incarnation)]


def _chain(log: Recorded, robot: str, incarnation: int) -> list[m.Submap]:
    found = log.submaps().get((robot, incarnation), {})
    return [found[k] for k in takewhile(found.__contains__, range(len(found)))]


def _first_of(
    done: m.Done, chain: Sequence[m.Submap], measurements: Mapping[int, m.Measurement]
) -> int:
    """The first measurement of the life that ended so, by its steps."""
    steps = 0
    begins = {0, *(submap.last_measurement + 1 for submap in chain)}
    for counter in range(min(done.measurements, max(measurements) + 1), -1, -1):
        steps += counter < done.measurements and isinstance(
            measurements.get(counter), m.AnyOdometry
        )
        if counter in begins and steps == done.steps:
            return counter
    return 0


def _life(
    new: NewRobot,
    measurements: Mapping[int, m.Measurement],
    chain: Sequence[m.Submap],
    first: int,
    until: int | None,
) -> Iterator[Outgoing]:
    """The messages of a life from measurement `first` on; it ends before measurement `until`, if it
    did.
    """
    start = measurements.get(0)
    if not isinstance(start, m.InitialPose):
        return
    last = max(measurements) + 1 if until is None else until
    while True:
        node = new()
        if first:
            node.node.resume(start, [s for s in chain if s.last_measurement < first])
        counter = first
        while counter < last and counter in measurements:
            yield from node.given(measurements[counter])
            counter += 1
        if counter == last and until is not None:
            end = m.StreamEnd(robot=start.robot, incarnation=start.incarnation, measurements=until)
            yield from node.given(m.End(stamp_ns=0, streams=(end,)))
        behind = (s.last_measurement + 1 for s in chain if counter <= s.last_measurement < last)
        following = next((b for b in behind if b in measurements), None)
        if counter >= last or following is None:
            return
        first = following


def _in_lockstep(log: Recorded, robot: str, new: NewRobot) -> Iterator[Outgoing]:
    """Under a rule with feedback a robot waits for each round's map: it is the recorded one.

    A round that has no map in the log had no centre: the robot went on without it.
    """
    fused = {f.exchange: f for f in log.of(ch.FUSED_MAP) if isinstance(f, m.FusedMap)}
    node = new()
    incarnations = log.incarnations(robot)
    inputs: list[m.Message] = [
        log.measurements[(robot, incarnation)][counter]
        for incarnation in incarnations
        for counter in sorted(log.measurements[(robot, incarnation)])
    ]
    if any(isinstance(d, m.Done) and d.robot == robot for d in log.of(ch.ROBOT_DONE)):
        end = m.StreamEnd(
            robot=robot,
            incarnation=incarnations[-1],
            measurements=len(log.measurements[(robot, incarnations[-1])]),
        )
        inputs.append(m.End(stamp_ns=0, streams=(end,)))
    inputs.reverse()
    while inputs:
        out = node.given(inputs.pop())
        yield from out
        for each in out:
            if isinstance(each.message, m.MapEstimate):
                centre = m.Liveliness(
                    stamp_ns=0, node="central", alive=each.message.exchange in fused
                )
                inputs += [fused[each.message.exchange], centre] if centre.alive else [centre]


SILENT = {Rejection.UNCONFIRMED.disposition, Rejection.CLUTTER.disposition}
"""What becomes of scans without identities of which nothing is in the submap."""


def _silent(
    node: RecomputedRobot, scans: Iterable[int], measurements: Mapping[int, m.Measurement]
) -> dict[int, str]:
    """What the last window has found out about these scans."""
    said = node.silent()
    detected = [n for n in scans if isinstance(measurements[n], m.Detections)]
    return {n: said[measurements[n].stamp_ns] for n in detected if measurements[n].stamp_ns in said}


def dispositions(log: Recorded, robot: str, incarnation: int) -> dict[int, str]:
    """What the robot's node does with each measurement of an incarnation that it consumed, in its
    own words.

    Without a centre nothing holds it up. Scans that no odometry covers and inter-robot measurements
    whose pose node did not come are known at the end only.
    """
    config, digest = log.robot_config(robot)
    node = RecomputedRobot(config, digest, {})
    if log.known_map is not None:
        node.given(log.known_map)
    node.given(m.Liveliness(stamp_ns=0, node="central", alive=False))
    measurements = log.measurements.get((robot, incarnation), {})
    done = max((d.measurements for d in _dones(log, robot, incarnation)), default=None)
    said: dict[int, str] = {}
    for counter in takewhile(
        measurements.__contains__, range(len(measurements) if done is None else done)
    ):
        took, late = node.took(measurements[counter]), Rejection.LATE.disposition
        scans = [n for n in said if isinstance(measurements[n], m.AnyScan | m.Detections)]
        scans = [n for n in scans if not said[n].startswith("rejected")]
        silent = SILENT & set(took)
        if late in took:  # an odometry interval that ends a window, and scans that it leaves behind
            said |= dict.fromkeys(scans[-took.pop(late) :], late)
            said[counter] = HybridEstimator.used
        if silent:  # … and scans that it has found nothing in
            said |= _silent(node, scans, measurements)
            said[counter] = HybridEstimator.used
        said.setdefault(counter, next(iter(took), "lost"))
    if said and done is not None:
        end = m.StreamEnd(robot=robot, incarnation=incarnation, measurements=len(said))
        took = node.took(m.End(stamp_ns=0, streams=(end,)))
        if SILENT & set(took):
            said |= _silent(node, list(said), measurements)
        for reason, count in took.items():
            if reason in SILENT:
                continue
            sighted = reason == Rejection.NO_NODE.disposition
            kinds = (m.Sightings,) if sighted else (m.Observations, m.Points, m.Detections)
            taken = [n for n in said if isinstance(measurements[n], kinds)]
            taken = [n for n in taken if not said[n].startswith("rejected")]
            said |= dict.fromkeys(taken[-count:], reason)
    return said
