"""The measurements of a robot's sensors, the end of its stream, and a world's truth and plans."""

import math
from typing import Annotated, Literal, TypeGuard

import msgspec
from msgspec import Meta

from teamslam.team.core import (
    check_angles,
    check_ascending,
    check_blocks,
    check_finite,
    check_named,
    check_pose_covariance,
    check_ranges,
)
from teamslam.team.wire.arrays import Floats, Ids, Stamps, check_semidefinite, floats, ids, stamps
from teamslam.team.wire.messages.base import (
    Count,
    Message,
    Name,
    Real,
    Robot,
    StampNs,
    Text,
    check_classes,
    check_counts,
)


class Measurement(Message, frozen=True, kw_only=True):
    """A measurement of a sensor stream; `number` is the robot's measurement counter."""

    robot: Robot
    incarnation: Count
    number: Count


class InitialPose(Measurement, frozen=True, kw_only=True, tag="start/1"):
    """Measurement 0 of an incarnation: the start pose in the team's frame.

    pose: 3 floats (x, y, theta); empty: unknown. covariance: 3 × 3 floats, row-major; empty: exact.
    """

    pose: Floats
    covariance: Floats

    def check(self) -> None:
        if len(floats(self.pose, "pose")) not in (0, 3):
            raise ValueError("wrong length: pose has neither 0 nor 3 numbers")
        check_finite(self.pose, "pose")
        if self.covariance:
            check_pose_covariance(self.covariance, "covariance")


class Odometry(Measurement, frozen=True, kw_only=True, tag="odometry/1"):
    """Mean forward speed [m/s] and yaw rate [rad/s] over an odometry interval that ends at
    stamp_ns.
    """

    duration_ns: Annotated[int, Meta(ge=0, lt=2**62)]
    forward: Real
    yaw_rate: Real


class Increment(Measurement, frozen=True, kw_only=True, tag="increment/1"):
    """Motion over an odometry interval that ends at stamp_ns.

    increment: 3 floats (forward [m], left [m], turn [rad]), the pose of its end in the frame of its
    start. covariance: 3 × 3 floats, row-major, of an error in the frame of its end (pose ∘
    Exp(error)), of any rank; empty: none is stated.
    """

    duration_ns: Annotated[int, Meta(ge=0, lt=2**62)]
    increment: Floats
    covariance: Floats = b""

    def check(self) -> None:
        check_finite(self.increment, "increment", 3)
        if not abs(float(floats(self.increment, "increment")[2])) <= math.pi:
            raise ValueError("out of bounds: increment turns outside (−π, π]")
        if self.covariance:
            check_semidefinite(self.covariance, 3, "covariance")


class Steering(Measurement, frozen=True, kw_only=True, tag="steering/1"):
    """Encoders of a car over an odometry interval that ends at stamp_ns.

    wheel_speed [m/s]: of the rear wheel that carries the encoder. steering [rad]: angle of the
    front wheels, positive to the left. The robot's motion model converts both to a motion.
    """

    duration_ns: Annotated[int, Meta(ge=0, lt=2**62)]
    wheel_speed: Real
    steering: Real

    def check(self) -> None:
        if not abs(self.steering) < 0.5 * math.pi:
            raise ValueError("out of bounds: steering is not within a quarter turn")


class Observations(Measurement, frozen=True, kw_only=True, tag="observations/1"):
    """Range [m] and bearing [rad] of landmarks with identities, at stamp_ns.

    covariances: 3 floats of each (range-range, range-bearing, bearing-bearing); empty: the sensor's
    noise.
    """

    ids: Ids
    ranges: Floats
    bearings: Floats
    covariances: Floats = b""

    def check(self) -> None:
        check_named(self.ids, "ids")
        n = len(self.ids) // 4
        check_ranges(self.ranges, "ranges", n)
        check_angles(self.bearings, "bearings", n)
        if self.covariances:
            check_blocks(self.covariances, n, "covariances")


class Points(Measurement, frozen=True, kw_only=True, tag="points/1"):
    """Positions of landmarks with identities in the sensor's frame, at stamp_ns.

    positions: L × 2 floats (ahead [m], left [m]). covariances: 3 floats of each (xx, xy, yy);
    empty: the sensor's noise of range and bearing.
    """

    ids: Ids
    positions: Floats
    covariances: Floats = b""

    def check(self) -> None:
        check_named(self.ids, "ids")
        n = len(self.ids) // 4
        check_finite(self.positions, "positions", 2 * n)
        if self.covariances:
            check_blocks(self.covariances, n, "covariances")


AnyOdometry = Odometry | Increment | Steering
AnyScan = Observations | Points


class Detections(Measurement, frozen=True, kw_only=True, tag="detections/1"):
    """Range [m] and bearing [rad] of L landmarks without identities, one scan at stamp_ns.

    Some may be clutter. Two of one scan are different landmarks. covariances: L × 3 floats, packed
    2 × 2 of (range, bearing), or empty: the sensor's noise. signatures: L floats that are similar
    for one landmark, such as a trunk's diameter [m], or empty. classes: C floats of each, the
    column ln P(its reported class | class c) of the detector's confusion matrix, or empty.
    """

    ranges: Floats
    bearings: Floats
    covariances: Floats = b""
    signatures: Floats = b""
    classes: Floats = b""

    def check(self) -> None:
        n = len(floats(self.ranges, "ranges"))
        check_ranges(self.ranges, "ranges")
        check_angles(self.bearings, "bearings", n)
        if self.covariances:
            check_blocks(self.covariances, n, "covariances")
        if self.signatures:
            check_finite(self.signatures, "signatures", n)
        check_classes(self.classes, n)


class Sightings(Measurement, frozen=True, kw_only=True, tag="sightings/1"):
    """Range [m] and bearing [rad] of teammates at stamp_ns."""

    teammates: tuple[Name, ...]
    ranges: Floats
    bearings: Floats

    def check(self) -> None:
        check_ranges(self.ranges, "ranges", len(self.teammates))
        check_angles(self.bearings, "bearings", len(self.teammates))


class Fix(Measurement, frozen=True, kw_only=True, tag="fix/1"):
    """Position of the robot's antenna at stamp_ns in the frame of the survey, as by GNSS.

    position: 2 floats (x, y) [m]. covariance: 3 floats (xx, xy, yy); empty: `gnss.sigma_m`.
    """

    position: Floats
    covariance: Floats = b""

    def check(self) -> None:
        check_finite(self.position, "position", 2)
        if self.covariance:
            check_blocks(self.covariance, 1, "covariance")


_CLASSES = frozenset(Measurement.__subclasses__())
ODOMETRY = frozenset({Odometry, Increment, Steering})


def is_measurement(message: Message) -> TypeGuard[Measurement]:
    """Return whether a message is a measurement, in a tenth of the time of `isinstance`."""
    return type(message) in _CLASSES


def is_odometry(message: Message) -> TypeGuard[AnyOdometry]:
    """Return whether a message is an odometry interval, as fast as `is_measurement`."""
    return type(message) in ODOMETRY


class StreamEnd(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """End of a robot's stream: its measurements are numbered 0 … measurements − 1."""

    robot: Name
    incarnation: Count
    measurements: Count


class End(Message, frozen=True, kw_only=True, tag="end/1"):
    """End of all streams of a world, with their last counters."""

    streams: tuple[StreamEnd, ...]
    notes: tuple[Text, ...] = ()


class StreamHead(Message, frozen=True, kw_only=True, tag="stream_head/1"):
    """Progress of a robot's source: it has numbered 0 … measurements − 1, the last at stamp_ns.

    state: "open": measurements follow; "left": the driver stopped and may return; "ended": the
    incarnation is complete.
    """

    robot: Name
    incarnation: Count
    measurements: Count
    state: Literal["open", "left", "ended"]


class MeasurementsRequest(Message, frozen=True, kw_only=True, tag="readings_wanted/1"):
    """Query to a source for measurements first … last of a stream; last −1: all.

    only: reply with stored measurements and do not begin a new incarnation for missing ones.
    """

    robot: Name
    incarnation: Count
    first: Count
    last: int
    only: bool = False


class Truth(Message, frozen=True, kw_only=True, tag="truth/1"):
    """True poses of a robot, for the evaluation only: T stamps and T × 3 floats (x, y, theta)."""

    robot: Name
    stamps: Stamps
    poses: Floats

    def check(self) -> None:
        check_finite(self.poses, "poses", 3 * len(stamps(self.stamps, "stamps")))


class LandmarkPositions(Message, frozen=True, kw_only=True):
    """Positions of landmarks with identities: L ids, ascending, and L × 2 floats."""

    ids: Ids
    positions: Floats

    def check(self) -> None:
        check_ascending(self.ids, "ids")
        check_named(self.ids, "ids")
        check_finite(self.positions, "positions", 2 * len(ids(self.ids, "ids")))


class TruthLandmarks(LandmarkPositions, frozen=True, kw_only=True, tag="truth_landmarks/1"):
    """True landmark positions, for the evaluation only."""


class TruthLabels(Message, frozen=True, kw_only=True, tag="truth_labels/1"):
    """True landmarks of a robot's detections, for the evaluation only.

    stamps: of M scans; counts: detections of each; labels: of each detection the landmark's number,
    or NO_LABEL.
    """

    robot: Name
    stamps: Stamps
    counts: Ids
    labels: Ids

    def check(self) -> None:
        check_counts(self.counts, len(stamps(self.stamps, "stamps")), len(self.labels) // 4)
        ids(self.labels, "labels")


NO_LABEL = 2**32 - 1
"""The label of clutter, and of detections of an unknown landmark."""


class TruthPositions(Message, frozen=True, kw_only=True, tag="truth_positions/1"):
    """Positions of a robot by another sensor, such as a GPS, for the evaluation only.

    T stamps and T × 2 floats (x, y) in a frame of its own; some may be metres off.
    """

    robot: Name
    stamps: Stamps
    positions: Floats

    def check(self) -> None:
        check_finite(self.positions, "positions", 2 * len(stamps(self.stamps, "stamps")))


class KnownMap(LandmarkPositions, frozen=True, kw_only=True, tag="known_map/1"):
    """Prior map for localisation-only robots, in the team's frame."""


class RadioPlan(Message, frozen=True, kw_only=True, tag="radio/1"):
    """Links of a simulated radio in each second of team time from stamp_ns on.

    pairs: for each second a row of bits of the pairs of robots in their order, padded to bytes.
    ends_ns: when each robot's stream ends.
    """

    robots: tuple[Name, ...]
    ends_ns: tuple[StampNs, ...]
    pairs: bytes

    def check(self) -> None:
        n = len(self.robots)
        width = max((n * (n - 1) // 2 + 7) // 8, 1)
        if len(self.ends_ns) != n or not self.pairs or len(self.pairs) % width:
            raise ValueError("wrong length: ends_ns or pairs")
