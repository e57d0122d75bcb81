"""Calibration data: a robot's measurements, with reference poses and landmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.sim.world.streams import (
    Detections,
    Intervals,
    ObservationMeasurement,
    OdometryMeasurement,
    RobotStream,
    WorldStreams,
)
from teamslam.team.config import UNNAMED, MotionModel, RobotConfig
from teamslam.team.estimation.odometry import OdometryInterval, moved, steered
from teamslam.team.estimation.scans import Scan, point_scan, polar_scan
from teamslam.team.shapes import Bool, Float, Int64

LARGEST_TURN_RAD = 0.35
FASTEST_TURN_RAD_S = 3.0
"""Turn rate above which a path has an interpolation fault near heading ±π."""


@dataclass(frozen=True, kw_only=True)
class Reference:
    """One robot's odometry and landmark measurements, with reference poses and landmarks.

    name: world label and robot id. gap_ns: longest interpolated gap of `path`. landmarks: in the
    path's frame. mount: sensor pose on the base. turns_first: between poses the robot turns, then
    drives straight (else an arc).
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
        seen, sighted = (_between(each, begin_ns, end_ns) for each in (self.seen, self.sighted))
        return replace(self, intervals=self.intervals.where(chosen), seen=seen, sighted=sighted)


def _between(seen: Detections, begin_ns: int, end_ns: int) -> Detections:
    first, last = (int(at) for at in np.searchsorted(seen.stamps_ns, [begin_ns, end_ns]))
    return seen.only(first, last)


def sensor_poses(
    data: Reference, stamps_ns: Int64[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Sensor poses at these times, and a mask of known ones."""
    poses, known = poses_at(data.path, stamps_ns, data.gap_ns, turns_first=data.turns_first)
    if not any(data.mount):
        return poses, known
    x, y, heading = data.mount
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    moved_on = np.column_stack([c * x - s * y, s * x + c * y, np.full(len(poses), heading)])
    return poses + moved_on, known


def as_speeds(intervals: Intervals, motion: MotionModel) -> Intervals:
    """Convert odometry of any form to mean speeds; increments as arcs."""
    speeds = np.column_stack([intervals.forward, intervals.yaw_rate])
    if intervals.steered:
        speeds = np.array([steered(motion, *pair) for pair in speeds.tolist()]).reshape(-1, 2)
    if intervals.increments is not None:
        moving = intervals.as_motions
        twists = [moved(each, None).twist for each in intervals.increments[moving]]
        rates = np.array(twists).reshape(-1, 3) / (intervals.duration_ns[moving, np.newaxis] * 1e-9)
        speeds[moving] = rates[:, [0, 2]]
    return replace(intervals, forward=speeds[:, 0], yaw_rate=speeds[:, 1], steered=False)


def scan_of(seen: ObservationMeasurement) -> Scan:
    """Scan as received by the front end: detections without identities carry row numbers, not
    labels.
    """
    ids = seen.ids
    if seen.hidden:
        ids = np.arange(UNNAMED, UNNAMED + len(seen.ranges), dtype=np.uint32)
    if seen.points is not None:
        return point_scan(ids, seen.points, seen.covariances)
    return polar_scan(ids, seen.ranges, seen.bearings, seen.covariances)


def interval_of(measurement: OdometryMeasurement, motion: MotionModel) -> OdometryInterval:
    """Odometry interval as received by the front end."""
    if measurement.increment is not None:
        motions = moved(measurement.increment, measurement.covariance)
        rates = motions.twist / (measurement.duration_ns * 1e-9)
        speeds = float(rates[0]), float(rates[2])
        return OdometryInterval(measurement.stamp_ns, measurement.duration_ns, *speeds, motions)
    speeds = measurement.forward, measurement.yaw_rate
    if measurement.steered:
        speeds = steered(motion, *speeds)
    return OdometryInterval(measurement.stamp_ns, measurement.duration_ns, *speeds)


def poses_at(
    path: Path, stamps_ns: Int64[np.ndarray, " n"], gap_ns: int, *, turns_first: bool = False
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Path poses at these times, and a mask of known ones.

    Between two poses the path is their arc; at a share s from (p, θ) the pose is

        (p + s sinc(sφ/2)/sinc(φ/2) R((s − 1)φ/2) (p' − p), θ + sφ).

    With turns_first it is the chord with the final heading. Unknown: outside the path, in a gap
    longer than gap_ns, or beside a heading jump.
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
    """sin(angle)/angle, 1 at 0: chord over arc length, by half the turn."""
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
    """References of the robots with a path and odometry.

    turning_first: robots that turn, then drive straight. models: robots' models, which convert
    odometry to motion.
    """
    robot = models or RobotConfig("any")
    return [
        Reference(
            name=f"{label} {stream.robot}",
            intervals=as_speeds(stream.intervals, robot.motion),
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
    """True paths of the robots that have one."""
    return {
        stream.robot: Path(stream.truth_ns, stream.truth)
        for stream in streams
        if stream.truth is not None and stream.truth_ns is not None and len(stream.truth) > 1
    }
