"""Calibration data: measurements with reference poses and landmarks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.sim.publisher.source import Source
from teamslam.sim.world.streams import Detections, Intervals, RobotStream, WorldStreams
from teamslam.team.config import MotionModel, RobotConfig
from teamslam.team.estimation.models import steered
from teamslam.team.estimation.se2 import logarithm
from teamslam.team.shapes import Bool, Float, Int64
from teamslam.team.wire import messages as m

LARGEST_TURN_RAD = 0.35
FASTEST_TURN_RAD_S = 3.0  # turn rate above which a path has an interpolation fault near heading ±π


@dataclass(frozen=True, kw_only=True)
class Reference:
    """One robot's measurements, with reference poses and landmarks.

    name: world label and robot id. gap_ns: longest interpolated gap of `path`. turns_first: the
    path turns, then drives straight.
    """

    name: str
    intervals: Intervals
    seen: Detections
    path: Path
    gap_ns: int
    landmarks: Mapping[int, Float[np.ndarray, "2"]]
    sighted: Detections
    names: tuple[str, ...]
    teammates: Mapping[str, Path]
    turns_first: bool = False
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def robot(self) -> str:
        """Robot id from the name."""
        return self.name.rpartition(" ")[2]

    def between(self, begin_ns: int, end_ns: int) -> "Reference":
        """Restrict odometry and measurements to [begin_ns, end_ns)."""
        chosen = (self.intervals.end_ns >= begin_ns) & (self.intervals.end_ns < end_ns)
        seen, sighted = (each.within(begin_ns, end_ns - 1) for each in (self.seen, self.sighted))
        return replace(self, intervals=self.intervals.where(chosen), seen=seen, sighted=sighted)


def by_robot(data: Sequence[Reference]) -> dict[str, list[Reference]]:
    """References by robot, in the order of their first one."""
    robots: dict[str, list[Reference]] = {}
    for each in data:
        robots.setdefault(each.robot, []).append(each)
    return robots


def sensor_poses(
    data: Reference, stamps_ns: Int64[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Sensor poses, and a mask of known ones."""
    poses, known = poses_at(data.path, stamps_ns, data.gap_ns, turns_first=data.turns_first)
    if not any(data.mount):
        return poses, known
    x, y, heading = data.mount
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    moved_on = np.column_stack([c * x - s * y, s * x + c * y, np.full(len(poses), heading)])
    return poses + moved_on, known


class _SeenLandmarks(NamedTuple):
    """Detections of known landmarks from known poses; chosen: mask of all."""

    chosen: Bool[np.ndarray, " N"]
    stamps_ns: Int64[np.ndarray, " n"]
    poses: Float[np.ndarray, "n 3"]
    landmarks: Float[np.ndarray, "n 2"]


def seen_landmarks(data: Reference, usable: Bool[np.ndarray, " N"] | None = None) -> _SeenLandmarks:
    """Known landmarks among the detections."""
    seen = data.seen
    stamps = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
    poses, chosen = sensor_poses(data, stamps)
    chosen &= np.isin(seen.ids, np.array(sorted(data.landmarks), dtype=np.int64))
    chosen &= True if usable is None else usable
    landmarks = np.array([data.landmarks[i] for i in seen.ids[chosen].tolist()]).reshape(-1, 2)
    return _SeenLandmarks(chosen, stamps[chosen], poses[chosen], landmarks)


def _as_speeds(intervals: Intervals, motion: MotionModel) -> Intervals:
    speeds = np.column_stack([intervals.forward, intervals.yaw_rate])
    if intervals.steered:
        speeds = np.array([steered(motion, *pair) for pair in speeds.tolist()]).reshape(-1, 2)
    if intervals.increments is not None:
        moving = intervals.as_motions
        twists = [logarithm(each) for each in intervals.increments[moving]]
        rates = np.array(twists).reshape(-1, 3) / (intervals.duration_ns[moving, np.newaxis] * 1e-9)
        speeds[moving] = rates[:, [0, 2]]
    return replace(intervals, forward=speeds[:, 0], yaw_rate=speeds[:, 1], steered=False)


def messages_of(stream: RobotStream) -> Iterator[m.Measurement]:
    """Measurements as a robot receives them, without the initial pose."""
    source = Source(replace(stream, clock_offset_ns=0))
    return (source.message(counter) for counter in range(1, len(stream)))


def poses_at(
    path: Path, stamps_ns: Int64[np.ndarray, " n"], gap_ns: int, *, turns_first: bool = False
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Path poses at these times, and a mask of known ones.

    At a share s of the arc from (p, θ) to (p', θ + φ) the pose is
        (p + s sinc(sφ/2)/sinc(φ/2) R((s − 1)φ/2) (p' − p), θ + sφ);
    with turns_first a chord with the final heading. Unknown: outside the path, in a gap, or beside
    a heading jump.
    """
    if len(path.stamps_ns) < 2:
        return np.zeros((len(stamps_ns), 3)), np.zeros(len(stamps_ns), dtype=np.bool_)
    after = np.clip(np.searchsorted(path.stamps_ns, stamps_ns), 1, len(path.stamps_ns) - 1)
    begin, end = path.stamps_ns[after - 1], path.stamps_ns[after]
    step = path.poses[after] - path.poses[after - 1]
    step[:, 2] = on_circle(step[:, 2])
    share = (stamps_ns - begin) / np.maximum(end - begin, 1)
    largest = np.maximum(LARGEST_TURN_RAD, FASTEST_TURN_RAD_S * 1e-9 * (end - begin))
    known = (end - begin <= gap_ns) & (np.abs(step[:, 2]) <= largest)
    known &= (stamps_ns >= path.stamps_ns[0]) & (stamps_ns <= path.stamps_ns[-1])
    if turns_first:
        heading = np.where(share > 0.0, step[:, 2], 0.0)
        gone = share[:, np.newaxis] * step[:, :2]
    else:
        heading = share * step[:, 2]
        length = share * sinc(0.5 * heading) / sinc(0.5 * step[:, 2])
        c, s = (f(0.5 * (heading - step[:, 2])) for f in (np.cos, np.sin))
        x, y = length * step[:, :2].T
        gone = np.stack([c * x - s * y, s * x + c * y], axis=1)
    return path.poses[after - 1] + np.column_stack([gone, heading]), known


def sinc(angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """sin(angle)/angle, 1 at 0."""
    return np.asarray(np.sinc(angle / np.pi))


def references(
    world: WorldStreams,
    paths: Mapping[str, Path],
    landmarks: Mapping[int, Float[np.ndarray, "2"]],
    gap_ns: int,
    label: str,
    turning_first: frozenset[str] = frozenset(),
    models: RobotConfig | None = None,
) -> list[Reference]:
    """References of the robots with a path and odometry."""
    robot = models or RobotConfig("any")
    return [
        Reference(
            name=f"{label} {stream.robot}",
            intervals=_as_speeds(stream.intervals, robot.motion),
            seen=stream.landmark_detections,
            path=paths[stream.robot],
            gap_ns=gap_ns,
            landmarks=landmarks,
            sighted=stream.teammate_detections,
            names=stream.teammates,
            teammates=paths,
            turns_first=stream.robot in turning_first,
            mount=robot.sensor.mount,
        )
        for stream in world.streams
        if stream.robot in paths and len(stream.intervals.end_ns)
    ]


def true_paths(streams: Sequence[RobotStream]) -> dict[str, Path]:
    """True paths by robot."""
    return {
        stream.robot: Path(stream.truth_ns, stream.truth)
        for stream in streams
        if stream.truth is not None and stream.truth_ns is not None and len(stream.truth) > 1
    }


SPAN_S = 10.0  # stretch length [s]: errors of one command are correlated for seconds
LEAST_SPANS = 30  # least number of moving stretches of all robots together
LEAST_WAY_M = 0.05  # least logged path [m] of a moving stretch


def too_short(stretches: int) -> str:
    """Error text for too few moving stretches."""
    return (
        f"calibrate needs {LEAST_SPANS} stretches of {SPAN_S:.0f} s with motion, of all robots "
        f"together, and these data have {stretches}: give several data sets at once, record "
        f"{SPAN_S * (LEAST_SPANS - stretches) / 60.0:.1f} minutes more, or write known figures "
        "into a scenario (docs/your_data.md, Noise)."
    )


def moving_stretches(streams: Iterable[RobotStream]) -> int:
    """Number of stretches of SPAN_S with motion."""
    return sum(_count_moving(stream.intervals) for stream in streams)


def _count_moving(driven: Intervals) -> int:
    if not len(driven.end_ns):
        return 0
    begin_ns = int(driven.end_ns[0] - driven.duration_ns[0])
    ways = np.abs(driven.forward) * driven.duration_ns * 1e-9
    if driven.increments is not None:
        lengths = np.hypot(driven.increments[:, 0], driven.increments[:, 1])
        ways = np.where(driven.as_motions, lengths, ways)
    seconds = np.append(0.0, (driven.end_ns - begin_ns) * 1e-9)
    edges = SPAN_S * np.arange(int(seconds[-1] / SPAN_S) + 1)
    logged = np.diff(np.interp(edges, seconds, np.append(0.0, np.cumsum(ways))))
    return int(np.count_nonzero(logged > LEAST_WAY_M))
