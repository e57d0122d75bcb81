"""The inputs of fusion: submaps and inter-robot factors."""

import math

from teamslam.team.config import GNSS, MAP, UNNAMED
from teamslam.team.core import (
    check_ascending,
    check_derivatives,
    check_finite,
    check_packed_covariance,
)
from teamslam.team.wire.arrays import Floats, Ids, Stamps, ids, stamps
from teamslam.team.wire.messages.base import (
    Author,
    Bias,
    Count,
    Digest,
    Message,
    Name,
    Real,
    StampNs,
    check_classes,
    check_counts,
    check_sorted,
)


class Submap(Message, frozen=True, kw_only=True, tag="submap/1"):
    """One window's Gaussian, the only input of the rule `join`; stamp_ns is its end pose's stamp.

    Its inputs are the measurements first_measurement … last_measurement of (robot, incarnation) and
    the configuration with the digest `config` (seed included). ids: L, ascending. mean: 3 + 3K + 2L
    floats (end pose, pose nodes, landmarks) in the frame of the start pose. covariance: packed
    upper triangle, row-major. nodes: K stamps in (start_ns, stamp_ns], ascending. sightings: number
    of its SightingFactor messages. gated: number of rejected landmark measurements.

    biases: B errors that the robot's submaps share, ascending; sensitivity: B × n float32 (float64
    in older logs), ∂mean/∂b for the error b of the bearings [rad], of the detections' clock [s], or
    of the scale of the ranges or of the speed: given b the mean is mean + b · sensitivity.
    curvature: n of them, ∂²mean/∂b² by the clock's error, which adds ½ b² · curvature; empty: none.

    ids from 2³¹ on are unnamed landmarks, associated in the window: 2³¹ + a local index. counts:
    number of measurements of each. keyframes: number of the window's keyframes with detections.
    seen: ⌈keyframes/8⌉ bytes of each unnamed landmark; bit k (the least of byte k // 8 first) is
    set if keyframe k contains it. Two landmarks in one keyframe are different. classes: C floats of
    each, ln P(its detections' classes | class c) up to a constant, or empty.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    first_measurement: Count
    last_measurement: Count
    start_ns: StampNs
    config: Digest
    ids: Ids
    mean: Floats
    covariance: Floats
    nodes: Stamps = b""
    sightings: Count = 0
    biases: tuple[Bias, ...] = ()
    sensitivity: bytes = b""
    gated: Count = 0
    counts: Ids = b""
    seen: bytes = b""
    keyframes: Count = 0
    classes: Floats = b""
    curvature: bytes = b""

    def check(self) -> None:
        check_ascending(self.ids, "ids")
        n = 3 + 3 * len(stamps(self.nodes, "nodes")) + 2 * (len(self.ids) // 4)
        check_finite(self.mean, "mean", n)
        check_packed_covariance(self.covariance, n, "covariance")
        check_derivatives(self.sensitivity, n * len(self.biases), "sensitivity")
        if self.curvature:
            check_derivatives(self.curvature, n, "curvature")
            if "clock_offset" not in self.biases:
                raise ValueError("out of bounds: a curvature without the bias clock_offset")
        check_sorted(self.biases, "biases")
        if self.nodes:
            self._check_nodes()
        if self.last_measurement < self.first_measurement or self.stamp_ns < self.start_ns:
            raise ValueError("out of bounds: the interval of measurements or of time is empty")
        self._check_unnamed()

    def _check_nodes(self) -> None:
        times = stamps(self.nodes, "nodes").tolist()
        check_sorted(times, "nodes")
        if not self.start_ns < times[0] <= times[-1] <= self.stamp_ns:
            raise ValueError("out of bounds: a node is not in the submap's time")

    def _check_unnamed(self) -> None:
        numbers, counts = ids(self.ids, "ids"), ids(self.counts, "counts")
        unnamed = int((numbers >= UNNAMED).sum())
        if len(counts) != unnamed:
            raise ValueError(f"wrong length: counts has {len(counts)} numbers, {unnamed} expected")
        rows = -(-self.keyframes // 8) * unnamed
        if len(self.seen) != rows:
            raise ValueError(f"wrong length: seen has {len(self.seen)} bytes, {rows} expected")
        check_classes(self.classes, unnamed)
        if unnamed and not counts.min():
            raise ValueError("out of bounds: a landmark of no measurement, by counts")


class Association(Message, frozen=True, kw_only=True, tag="association/1"):
    """Association of the detections without identity of a submap's window.

    stamps: of M scans; counts: accepted detections of each; rows: their indices in the scan's
    message; landmarks: the landmark of each in the submap (2³¹ + local), or UNCONFIRMED or CLUTTER.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    stamps: Stamps
    counts: Ids
    rows: Ids
    landmarks: Ids

    def check(self) -> None:
        detections = len(ids(self.landmarks, "landmarks"))
        check_counts(self.counts, len(stamps(self.stamps, "stamps")), detections)
        if len(ids(self.rows, "rows")) != detections:
            raise ValueError("wrong length: rows are not one for each of landmarks")


UNCONFIRMED, CLUTTER = 0, 1
"""In `Association.landmarks`: too few detections for a landmark, and so few that it is none."""


class SightingFactor(Message, frozen=True, kw_only=True, tag="sighting_factor/1"):
    """An inter-robot factor from a pose node of a submap; stamp_ns is the node's.

    range [m] and bearing [rad] of the teammate's pose node at the same stamp; covariance: packed 2
    × 2 (range, bearing). measurements: counters of the inter-robot measurements in it, ascending;
    with the submap's odometry and configuration they are its inputs. A fix of the robot's position
    has the teammate `map-gnss`; range and bearing are those of the antenna from the pose (0, −10⁵,
    0) in the survey's frame, and point, 2 floats (empty: the base), is the antenna in the node's.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    config: Digest
    teammate: Author
    range: Real
    bearing: Real
    covariance: Floats
    measurements: tuple[Count, ...]
    point: Floats = b""

    def check(self) -> None:
        check_finite(self.point, "point", 2 if self.point else 0)
        if self.teammate.startswith(MAP) and self.teammate != GNSS:
            raise ValueError("out of bounds: the teammate is a saved map")
        check_packed_covariance(self.covariance, 2, "covariance")
        if self.range <= 0.0 or abs(self.bearing) > math.pi:
            raise ValueError("out of bounds: the range is not positive or the bearing not an angle")
        if not self.measurements:
            raise ValueError("not ascending: measurements, of which there are none")
        check_sorted(self.measurements, "measurements")
        if self.teammate == self.robot:
            raise ValueError("out of bounds: a robot sees itself")


class SubmapsRequest(Message, frozen=True, kw_only=True, tag="submaps_wanted/1"):
    """Query for the submaps of a robot: to the centre for those in its set, or to the robot.

    incarnation: 0: all. first: the first sequence of that incarnation.
    """

    robot: Name
    incarnation: Count = 0
    first: Count = 0
