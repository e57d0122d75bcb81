"""A robot's messages: submaps and inter-robot factors, the inputs of fusion; its own estimates, for
viewers and rules on whole maps; the end of its work.
"""

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.config import GNSS, MAP, UNNAMED
from teamslam.team.core import (
    check_ascending,
    check_derivatives,
    check_finite,
    check_packed_covariance,
    check_pose_covariance,
)
from teamslam.team.wire.arrays import Floats, Ids, Stamps, floats, ids, stamps
from teamslam.team.wire.messages.base import (
    Author,
    Bias,
    Count,
    Digest,
    Message,
    Name,
    Real,
    Robot,
    StampNs,
    Text,
    check_classes,
    check_counts,
    check_landmarks,
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


class MapEstimate(Message, frozen=True, kw_only=True, tag="map/1"):
    """A robot's running map in the team's frame.

    exchange: number of map exchanges under a rule with feedback (lockstep); 0 under `join`. means:
    L × 2 floats. covariance: packed upper triangle of the 2L × 2L joint if `joint`, else L packed 2
    × 2 blocks.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    exchange: Count
    joint: bool
    ids: Ids
    means: Floats
    covariance: Floats

    def check(self) -> None:
        check_landmarks(self.ids, self.means, self.covariance, joint=self.joint)


class PoseEstimate(Message, frozen=True, kw_only=True, tag="pose/1"):
    """A robot's pose at stamp_ns, with its 3 × 3 covariance, in `frame`.

    map_digest: the fused map that it uses (8 zero bytes: none). sequence: the submap in progress.
    frame: as `FusedMap.frame`; empty in older logs. in_team_frame: frame is the team's; on
    team/pose that of the named map, on own/pose if the initial pose is known. A pose on team/pose
    outside the team's frame is the own pose and withdraws the poses before it.
    """

    robot: Robot
    incarnation: Count
    sequence: Count
    map_digest: Digest
    pose: Floats
    covariance: Floats
    frame: Text = ""
    in_team_frame: bool = True

    def check(self) -> None:
        check_finite(self.pose, "pose", 3)
        check_pose_covariance(self.covariance, "covariance")


class ParticleCloud(Message, frozen=True, kw_only=True, tag="particles/1"):
    """A thinned particle cloud for viewers: P × 3 poses and P weights, in the frame of own/pose."""

    robot: Name
    poses: Floats
    weights: Floats

    def check(self) -> None:
        check_finite(self.poses, "poses", 3 * len(floats(self.weights, "weights")))
        check_finite(self.weights, "weights")


class Innovation(Message, frozen=True, kw_only=True, tag="innovation/1"):
    """NIS of a window's measurements, Σ νᵀ S⁻¹ ν; χ²(dof) if the models are right.

    dof: two for each measurement of a mapped landmark. sequence: the window's submap; an estimator
    over the whole stream publishes the NIS since its last message.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    squared: Annotated[float, Meta(ge=0.0, le=1e300)]
    dof: Count


class Rendezvous(Message, frozen=True, kw_only=True, tag="rendezvous/1"):
    """Release of `submaps` buffered submaps; the oldest was buffered for `waited_s` seconds.

    teammates: the observed robots, which release theirs, too; empty if the robot was observed
    itself, or its stream has ended.
    """

    robot: Name
    incarnation: Count
    teammates: tuple[Name, ...]
    submaps: Count
    waited_s: Annotated[float, Meta(ge=0.0, le=1e12)]


class Disposition(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Number of a robot's measurements with one disposition, such as "submap" or a rejection."""

    disposition: Text
    measurements: Count


class Done(Message, frozen=True, kw_only=True, tag="done/1"):
    """End of a robot's work: all measurements are consumed, and the last submap is sent.

    last_map: sequence of the last own map, if the rule consumes own maps; else −1.
    """

    robot: Name
    incarnation: Count
    measurements: Count
    steps: Count
    submaps: Count
    ledger: tuple[Disposition, ...]
    last_map: int = -1
