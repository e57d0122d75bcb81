"""Chains of poses from a log's raw measurements, for the batch optimiser."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from msgspec import structs

from teamslam.central.config import TeamConfig
from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.team import core, translate
from teamslam.team.config import RobotConfig, Sensor
from teamslam.team.estimation.gaussian import Matrix, start_of_sensor
from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting, PoseGrid
from teamslam.team.estimation.models import Increment, Own, noise, segmenter_of, unclaimed
from teamslam.team.estimation.se2 import Pose, between, compose, inverse
from teamslam.team.shapes import Float, Int64, UInt32
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.channels import channel_of

_TAKEN = frozenset(
    channel.name for channel in (ch.START, ch.ODOMETRY, ch.OBSERVATIONS, ch.SIGHTINGS)
)
_ENDLESS_S = 1e9


JITTER_NS = 1_000_000  # gap [ns] beyond which an odometry interval is missing


class BatchReferenceError(RuntimeError):
    """The batch reference cannot be computed."""


class Scan(NamedTuple):
    """Accepted, calibrated ranges [m] and bearings [rad]; own: covariances."""

    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own = unclaimed(0)

    def noise(self, k: int, sensor: Sensor, distance: float) -> Matrix:
        """Covariance of (range, bearing) k at this predicted range; a point's own."""
        if not self.own.size:
            return np.diag(noise(sensor, distance))
        rr, rb, bb = self.own[k, :3]
        return np.array([[rr, rb], [rb, bb]])


@dataclass(frozen=True, kw_only=True)
class Chain:
    """One incarnation: N + 1 poses of the sensor, the first at the initial pose.

    The base is at pose ∘ mount⁻¹. increments[i] leads from pose i to pose i + 1, scans[i] is from
    pose i + 1. start: None: unknown; start_covariance: None: exact. sightings: from the base's
    poses at grid times.
    """

    config: RobotConfig
    incarnation: int
    start: Pose | None
    start_covariance: Matrix | None
    stamps_ns: Int64[np.ndarray, " K"]
    increments: tuple[Increment, ...]
    scans: tuple[Scan, ...]
    sightings: tuple[NodeSighting, ...] = ()

    @property
    def mount(self) -> Pose:
        """Pose of the sensor on the base."""
        return np.array(self.config.sensor.mount)

    def of_sensor(self, base: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
        """The sensor's poses."""
        return np.array([compose(pose, self.mount) for pose in base]).reshape(-1, 3)

    def of_base(self, poses: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
        """The base's poses."""
        away = inverse(self.mount)
        return np.array([compose(pose, away) for pose in poses]).reshape(-1, 3)

    @property
    def dead_reckoned(self) -> Float[np.ndarray, "K 3"]:
        """Poses by odometry, in the first one's frame."""
        poses = [np.zeros(3)]
        for increment in self.increments:
            poses.append(compose(poses[-1], increment.mean))
        return np.array(poses)


def chains_of(
    samples: Iterable[Sample], scenario: TeamConfig, *, sightings: bool = False
) -> list[Chain]:
    """Chains by (robot, incarnation), each measurement once and in order.

    sightings: with a pose at each grid time (`front_end.node_s`). Raises WireError.
    """
    streams: dict[tuple[str, int], dict[int, m.Measurement]] = {}
    for sample in samples:
        found = channel_of(sample.key)
        if found is not None and found[0].name in _TAKEN:
            message = opened(sample)[2]
            if isinstance(message, m.Measurement):
                stream = streams.setdefault((message.robot, message.incarnation), {})
                stream[message.number] = message
    configs = {robot.id: robot for robot in scenario.robots}
    chains = [
        _chain(
            configs[robot], incarnation, [measurements[i] for i in sorted(measurements)], sightings
        )
        for (robot, incarnation), measurements in sorted(streams.items())
        if robot in configs
    ]
    return [chain for chain in chains if chain is not None]


def _chain(
    config: RobotConfig, incarnation: int, measurements: Sequence[m.Measurement], sightings: bool
) -> Chain | None:
    odometry = [
        translate.interval_of(measurement, config)
        for measurement in measurements
        if isinstance(measurement, m.AnyOdometry)
    ]
    if not odometry:
        return None
    for before, after in pairwise(odometry):
        if abs(after.end_ns - after.duration_ns - before.end_ns) > JITTER_NS:
            raise BatchReferenceError(
                f"{config.id}: no odometry from {1e-9 * before.end_ns:.3f} to "
                f"{1e-9 * (after.end_ns - after.duration_ns):.3f} s, so nothing links its poses: "
                "`teamslam log cut LOG --from S --to S -o PART.mcap` makes a log of a part without "
                "that"
            )
    first_ns, last_ns = odometry[0].end_ns - odometry[0].duration_ns, odometry[-1].end_ns
    segmenter = segmenter_of(config.motion, config.sensor, config.front_end.keyframe_s)
    segmenter.begin(first_ns)
    grid = _grid(config, segmenter, first_ns) if sightings else None
    start: tuple[Pose | None, Matrix | None] = (None, None)
    keyframes: list[core.Keyframe] = []
    for measurement in measurements:
        match measurement:
            case m.InitialPose():
                pose, covariance = translate.pose_of(measurement)
                if pose is not None:
                    start = start_of_sensor(pose, covariance, np.array(config.sensor.mount))
            case m.Observations() | m.Points():
                segmenter.observe(measurement.stamp_ns, translate.scan_of(measurement))
            case m.Sightings() if grid is not None:
                grid.observe(
                    measurement.stamp_ns, measurement.number, translate.detections_of(measurement)
                )
            case m.Odometry() | m.Increment() | m.Steering():
                segmenter.integrate(translate.interval_of(measurement, config), is_measured=True)
                if grid is not None:
                    grid.pass_stops()
                keyframes += segmenter.take_keyframes()
    rest = segmenter.cut(last_ns)
    keyframes += segmenter.take_keyframes()
    if any(part.any() for part in rest.motion):
        keyframes.append(rest)
    return Chain(
        config=config,
        incarnation=incarnation,
        start=start[0],
        start_covariance=start[1],
        stamps_ns=np.array([first_ns, *(e.stamp_ns for e in keyframes)]),
        increments=tuple(Increment(*e.motion) for e in keyframes),
        scans=tuple(
            Scan(e.scan.ids, e.scan.ranges, e.scan.bearings, e.scan.own) for e in keyframes
        ),
        sightings=() if grid is None else grid.sightings(),
    )


def _grid(config: RobotConfig, segmenter: core.Segmenter, begin_ns: int) -> PoseGrid | None:
    if not config.front_end.node_s:
        return None
    front = structs.replace(config.front_end, window_s=_ENDLESS_S)
    grid = PoseGrid(segmenter, config.sensor, front)
    grid.begin(begin_ns)
    return grid


def place_chains(
    chains: Sequence[Chain], run: Evaluation
) -> tuple[list[Chain], list[Path], tuple[str, ...]]:
    """Chains with a place in the team's frame, the joined poses of each, and the others."""
    known, anchors, left_out = [], [], []
    for chain in chains:
        robot = chain.config.id
        path = run.robots[robot].smoothed_path
        own = (path.stamps_ns > chain.stamps_ns[0]) & (path.stamps_ns <= chain.stamps_ns[-1])
        if not own.any():
            left_out.append(f"{robot}: it is not in the joined map")
            continue
        stamps, poses = path.stamps_ns[own], chain.of_sensor(path.poses[own])
        if chain.start is not None:
            stamps = np.concatenate((chain.stamps_ns[:1], stamps))
            poses = np.concatenate((chain.start[np.newaxis], poses))
        known.append(chain)
        anchors.append(Path(stamps, poses))
    return known, anchors, tuple(left_out)


def anchor_chain(chain: Chain, anchors: Path) -> list[Float[np.ndarray, "K 3"]]:
    """Interpolate poses between known ones by odometry: forward, backward, and the mean of both,
    weighted by the time to each.

    Odometry up to a known pose counts to the last pose not after it.
    """
    odometry = chain.dead_reckoned
    at = np.searchsorted(chain.stamps_ns, anchors.stamps_ns, side="right") - 1
    carried = [
        np.array([compose(anchor, between(odometry[i], pose)) for pose in odometry])
        for anchor, i in zip(anchors.poses, at, strict=True)
    ]
    before = np.searchsorted(anchors.stamps_ns, chain.stamps_ns, side="right") - 1
    after = np.searchsorted(anchors.stamps_ns, chain.stamps_ns, side="left")
    before, after = np.maximum(before, 0), np.minimum(after, len(at) - 1)
    onward = np.array([carried[k][i] for i, k in enumerate(before)])
    back = np.array([carried[k][i] for i, k in enumerate(after)])
    span = anchors.stamps_ns[after] - anchors.stamps_ns[before]
    share = np.clip((chain.stamps_ns - anchors.stamps_ns[before]) / np.maximum(span, 1), 0.0, 1.0)
    step = back - onward
    step[:, 2] = on_circle(step[:, 2])
    mean = onward + share[:, np.newaxis] * step
    return [onward, back, mean]
