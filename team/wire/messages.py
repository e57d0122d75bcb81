"""The messages: frozen, versioned, positional.

On the wire a message is a MessagePack array `[tag, field, field, …]` in the order below; `tag` is
"name/version". A later version of the program may append fields (with defaults) without a new
version; readers ignore what follows the fields that they know. A new meaning, unit or frame is a
new version. Arrays travel as `bin`: little-endian, C order, of the type that the field's name in
`Floats`, `Ids` or `Stamps` says. SI units, radians, bearings in (−π, π].

Every message has `stamp_ns`, its team time: the time of the measurement that it is about.
`check` raises `ValueError` with the reason when the numbers can not be what the message says.
"""

from itertools import pairwise
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from team.config import UNNAMED
from team.wire.arrays import (
    Floats,
    Ids,
    Stamps,
    check_angles,
    check_ascending,
    check_blocks,
    check_covariance,
    check_finite,
    check_packed_covariance,
    check_semidefinite,
    floats,
    ids,
    stamps,
)

Name = Annotated[str, Meta(pattern="^[a-z][a-z0-9_]{0,31}$")]
Text = Annotated[str, Meta(max_length=20_000)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
StampNs = Annotated[int, Meta(ge=-(2**62), lt=2**62)]
Digest = Annotated[bytes, Meta(min_length=8, max_length=8)]
Bias = Literal["bearing", "forward_scale", "range_offset", "range_scale"]
Real = Annotated[float, Meta(ge=-1e300, le=1e300)]
"""A finite number: the bounds reject NaN and the infinities."""


class Message(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """What every message has: the team time that it is about."""

    stamp_ns: StampNs

    def check(self) -> None:
        """Raise ValueError where the arrays do not fit together; nothing to check here."""


class Measurement(Message, frozen=True, kw_only=True, array_like=True, gc=False):
    """What every measurement of a sensor stream has: robot, incarnation and the robot's measurement
    counter.
    """

    robot: Name
    incarnation: Count
    number: Count


class InitialPose(Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="start/1"):
    """Measurement 0 of an incarnation: the start pose in the team's frame, if it is known.

    pose: 3 floats (x, y, theta), or empty when unknown. covariance: 3 × 3 floats, row by row; empty
    for a pose that is exactly known.
    """

    pose: Floats
    covariance: Floats

    def check(self) -> None:  # noqa: D102 - the base class says what a check is
        if len(floats(self.pose, "pose")) not in (0, 3):
            raise ValueError("wrong length: pose has neither 0 nor 3 numbers")
        check_finite(self.pose, "pose")
        if self.covariance:
            check_covariance(self.covariance, 3, "covariance")


class Odometry(Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="odometry/1"):
    """One odometry interval that ends at stamp_ns: mean forward speed and yaw rate over it."""

    duration_ns: Annotated[int, Meta(ge=0, lt=2**62)]
    forward: Real
    yaw_rate: Real


class Increment(
    Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="increment/1"
):
    """One odometry interval that ends at stamp_ns, as the motion over it.

    increment: 3 floats (forward [m], left [m], turn [rad]), the pose of its end in the frame of its
    start. covariance: 3 × 3 floats, row by row, of an error in the frame of its end (pose ∘
    Exp(error)), of any rank; empty where the source claims none.
    """

    duration_ns: Annotated[int, Meta(ge=0, lt=2**62)]
    increment: Floats
    covariance: Floats = b""

    def check(self) -> None:  # noqa: D102
        check_finite(self.increment, "increment", 3)
        if not abs(float(floats(self.increment, "increment")[2])) <= np.pi:
            raise ValueError("out of bounds: increment turns outside (−π, π]")
        if self.covariance:
            check_semidefinite(self.covariance, 3, "covariance")


class Steering(Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="steering/1"):
    """One odometry interval of a car that ends at stamp_ns, as its encoders read it.

    wheel_speed [m/s]: of the rear wheel that carries the encoder. steering [rad]: the angle of the
    front wheels, left is positive. What the two mean is the robot's motion model's to say.
    """

    duration_ns: Annotated[int, Meta(ge=0, lt=2**62)]
    wheel_speed: Real
    steering: Real

    def check(self) -> None:  # noqa: D102
        if not abs(self.steering) < 0.5 * np.pi:
            raise ValueError("out of bounds: steering is not within a quarter turn")


class Observations(
    Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="observations/1"
):
    """Range [m] and bearing [rad] of landmarks with known identities, seen at stamp_ns.

    covariances: of each its own, 3 floats (range-range, range-bearing, bearing-bearing); empty
    where they have the sensor's.
    """

    ids: Ids
    ranges: Floats
    bearings: Floats
    covariances: Floats = b""

    def check(self) -> None:  # noqa: D102
        n = len(ids(self.ids, "ids"))
        check_finite(self.ranges, "ranges", n)
        if n and floats(self.ranges, "ranges").min() < 0.0:
            raise ValueError("out of bounds: a range is negative")
        check_angles(self.bearings, "bearings", n)
        if self.covariances:
            check_blocks(self.covariances, n, "covariances")


class Points(Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="points/1"):
    """Places of landmarks with known identities in the sensor's frame, seen at stamp_ns.

    positions: L × 2 floats (ahead [m], left [m]). covariances: of each its own, 3 floats (xx, xy,
    yy); empty where they have the sensor's noise of range and bearing.
    """

    ids: Ids
    positions: Floats
    covariances: Floats = b""

    def check(self) -> None:  # noqa: D102
        n = len(ids(self.ids, "ids"))
        check_finite(self.positions, "positions", 2 * n)
        if self.covariances:
            check_blocks(self.covariances, n, "covariances")


AnyOdometry = Odometry | Increment | Steering
"""What tells of one odometry interval."""
AnyScan = Observations | Points
"""What tells of landmarks with known identities."""


class Detections(
    Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="detections/1"
):
    """Range [m] and bearing [rad] of L landmarks without identities, seen at stamp_ns in one scan.

    Some may be clutter, that is no landmark at all. Two of one scan are never the same landmark.
    covariances: L × 3 floats, packed 2 × 2 of (range, bearing), or empty: the sensor's own.
    signatures: L floats that look alike for the same landmark, such as a trunk's diameter [m], or
    empty.
    """

    ranges: Floats
    bearings: Floats
    covariances: Floats = b""
    signatures: Floats = b""

    def check(self) -> None:  # noqa: D102
        n = len(floats(self.ranges, "ranges"))
        check_finite(self.ranges, "ranges")
        if n and floats(self.ranges, "ranges").min() < 0.0:
            raise ValueError("out of bounds: a range is negative")
        check_angles(self.bearings, "bearings", n)
        if self.covariances:
            check_blocks(self.covariances, n, "covariances")
        if self.signatures:
            check_finite(self.signatures, "signatures", n)


class Sightings(
    Measurement, frozen=True, kw_only=True, array_like=True, gc=False, tag="sightings/1"
):
    """Range [m] and bearing [rad] of teammates, seen at stamp_ns."""

    teammates: tuple[Name, ...]
    ranges: Floats
    bearings: Floats

    def check(self) -> None:  # noqa: D102
        check_finite(self.ranges, "ranges", len(self.teammates))
        if self.teammates and floats(self.ranges, "ranges").min() < 0.0:
            raise ValueError("out of bounds: a range is negative")
        check_angles(self.bearings, "bearings", len(self.teammates))


class Truth(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="truth/1"):
    """True poses of a robot, for the evaluator only: T stamps and T × 3 floats (x, y, theta)."""

    robot: Name
    stamps: Stamps
    poses: Floats

    def check(self) -> None:  # noqa: D102
        check_finite(self.poses, "poses", 3 * len(stamps(self.stamps, "stamps")))


class TruthLandmarks(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="truth_landmarks/1"
):
    """True landmark positions, for the evaluator only: L ids and L × 2 floats."""

    ids: Ids
    positions: Floats

    def check(self) -> None:  # noqa: D102
        check_ascending(self.ids, "ids")
        check_finite(self.positions, "positions", 2 * len(ids(self.ids, "ids")))


class TruthLabels(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="truth_labels/1"
):
    """Which landmarks a robot's detections are of, for the evaluator only.

    stamps: of M scans of detections; counts: the detections of each; labels: by detection, the
    landmark's number or NO_LABEL where it is clutter, or nobody knows.
    """

    robot: Name
    stamps: Stamps
    counts: Ids
    labels: Ids

    def check(self) -> None:  # noqa: D102
        check_counts(self.counts, len(stamps(self.stamps, "stamps")), len(self.labels) // 4)
        ids(self.labels, "labels")


NO_LABEL = 2**32 - 1
"""The label of a detection that is clutter, or of which nobody knows the landmark."""


class TruthPositions(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="truth_positions/1"
):
    """Where another sensor, such as a GPS, says that a robot was, for the evaluator only.

    T stamps and T × 2 floats (x, y) in a frame of its own; some may be wrong by metres.
    """

    robot: Name
    stamps: Stamps
    positions: Floats

    def check(self) -> None:  # noqa: D102
        check_finite(self.positions, "positions", 2 * len(stamps(self.stamps, "stamps")))


class KnownMap(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="known_map/1"):
    """Prior map for localisation-only robots: L ids, L × 2 floats in the team's frame."""

    ids: Ids
    positions: Floats

    def check(self) -> None:  # noqa: D102
        check_ascending(self.ids, "ids")
        check_finite(self.positions, "positions", 2 * len(ids(self.ids, "ids")))


class Configuration(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="configured/1"
):
    """A node's configuration (JSON), announced once; `digest` is its 8-byte name elsewhere."""

    node: Text
    incarnation: Count
    digest: Digest
    configuration: Text


class Submap(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="submap/1"):
    """One window's Gaussian, the only input of the rule `join`; stamp_ns is its end pose's stamp.

    It names its inputs: the measurements first_measurement … last_measurement of (robot,
    incarnation), and the configuration by digest (the seed is in it). ids: L, ascending. mean: 3 +
    3K + 2L floats (end pose, pose nodes, landmarks) in the frame of the start pose. covariance:
    packed upper triangle, row by row. nodes: K stamps in (start_ns, stamp_ns], ascending.
    sightings: how many SightingFactor messages belong to it. biases: errors that the robot's
    submaps share, B of them, ascending; sensitivity: B × n floats, the mean's derivative by each:
    given the error b of the bearings [rad], of the scale of the ranges or of the speed, the mean is
    mean + b · sensitivity. gated: so many of its landmark measurements no others of the window
    confirmed; they are not in it.

    ids from 2³¹ on are landmarks without a name, which the window associated itself: 2³¹ + a local
    index. counts: of each of these, ascending, by how many measurements. keyframes: the window's
    keyframes with detections; seen: a row of ⌈keyframes/8⌉ bytes of each unnamed landmark, bit k of
    it (the least of byte k // 8 first) says that keyframe k saw it: two that one keyframe saw are
    two landmarks.
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
    sensitivity: Floats = b""
    gated: Count = 0
    counts: Ids = b""
    seen: bytes = b""
    keyframes: Count = 0

    def check(self) -> None:  # noqa: D102
        check_ascending(self.ids, "ids")
        times = stamps(self.nodes, "nodes")
        n = 3 + 3 * len(times) + 2 * len(ids(self.ids, "ids"))
        check_finite(self.mean, "mean", n)
        check_packed_covariance(self.covariance, n, "covariance")
        check_finite(self.sensitivity, "sensitivity", n * len(self.biases))
        if any(a >= b for a, b in pairwise(self.biases)):
            raise ValueError("not ascending: biases")
        if not (times[1:] > times[:-1]).all():
            raise ValueError("not ascending: nodes")
        if len(times) and not self.start_ns < times[0] <= times[-1] <= self.stamp_ns:
            raise ValueError("out of bounds: a node is not in the submap's time")
        if self.last_measurement < self.first_measurement or self.stamp_ns < self.start_ns:
            raise ValueError("out of bounds: the interval of measurements or of time is empty")
        self._check_unnamed()

    def _check_unnamed(self) -> None:
        numbers, counts = ids(self.ids, "ids"), ids(self.counts, "counts")
        unnamed = int((numbers >= UNNAMED).sum())
        if len(counts) != unnamed:
            raise ValueError(f"wrong length: counts has {len(counts)} numbers, {unnamed} expected")
        rows = -(-self.keyframes // 8) * unnamed
        if len(self.seen) != rows:
            raise ValueError(f"wrong length: seen has {len(self.seen)} bytes, {rows} expected")
        if unnamed and not counts.min():
            raise ValueError("out of bounds: a landmark of no measurement, by counts")


class Association(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="association/1"
):
    """What became of each detection without identity of a submap's window.

    stamps: of M scans of detections; counts: the detections of each that came through the door;
    rows: their places in the scan's message; landmarks: the submap's number of the landmark of each
    (2³¹ + local), UNCONFIRMED or CLUTTER of what is in no submap.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    stamps: Stamps
    counts: Ids
    rows: Ids
    landmarks: Ids

    def check(self) -> None:  # noqa: D102
        detections = len(ids(self.landmarks, "landmarks"))
        check_counts(self.counts, len(stamps(self.stamps, "stamps")), detections)
        if len(ids(self.rows, "rows")) != detections:
            raise ValueError("wrong length: rows are not one for each of landmarks")


UNCONFIRMED, CLUTTER = 0, 1
"""In `Association.landmarks`: too rarely seen for a landmark, and so rarely that it is none."""


class SightingFactor(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="sighting_factor/1"
):
    """A teammate seen from a pose node of submap (robot, incarnation, sequence); stamp_ns is the
    node's.

    range [m] and bearing [rad] of the teammate's pose node at the same stamp; covariance: packed
    2 × 2 (range, bearing). measurements: the counters of the sightings that went into it,
    ascending; with the submap's odometry and configuration they are its inputs.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    config: Digest
    teammate: Name
    range: Real
    bearing: Real
    covariance: Floats
    measurements: tuple[Count, ...]

    def check(self) -> None:  # noqa: D102
        check_packed_covariance(self.covariance, 2, "covariance")
        if self.range <= 0.0 or abs(self.bearing) > np.pi:
            raise ValueError("out of bounds: the range is not positive or the bearing not an angle")
        if not self.measurements or any(a >= b for a, b in pairwise(self.measurements)):
            raise ValueError("not ascending: measurements, or none")
        if self.teammate == self.robot:
            raise ValueError("out of bounds: a robot sees itself")


class Withdrawal(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="withdrawal/1"):
    """The team goes on without a robot: the map is that of the set without its submaps, and without
    the sightings by it or of it. A member of the set like a submap: there is no way back.

    by: who ordered it, "operator" or "central". reason: in words.
    """

    robot: Name
    by: Text
    reason: Text


class WithdrawalHeard(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="withdrawal_heard/1"
):
    """A robot has heard that the team goes on without `withdrawn`, and keeps the order for a centre
    that is started again. Hearsay, which a centre weighs (`central.hearsay`).

    robot: who says so. by, reason: as the order had them.
    """

    robot: Name
    withdrawn: Name
    by: Text
    reason: Text


class LocalLandmark(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """An unnamed landmark of submap (robot, incarnation, sequence): its number is 2³¹ + `local`."""

    robot: Name
    incarnation: Count
    sequence: Count
    local: Annotated[int, Meta(ge=0, lt=2**31)]


class Judgement(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """That two local landmarks are one landmark, or are two."""

    first: LocalLandmark
    second: LocalLandmark
    same: bool


class Verdict(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="verdict/1"):
    """An operator says of two local landmarks that they are one, or two. A member of the set like a
    submap; of a pair of which both were said they are two.

    robot: that of the first landmark. by: who says so. reason: in words.
    """

    robot: Name
    judgement: Judgement
    by: Text
    reason: Text

    def check(self) -> None:  # noqa: D102
        if self.judgement.first == self.judgement.second:
            raise ValueError("out of bounds: a verdict on one landmark and itself")
        if self.robot != self.judgement.first.robot:
            raise ValueError("out of bounds: a verdict in the name of another robot")


class GivenUp(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="given_up/1"):
    """Nobody waits for a node any more: what has come of a robot is in the map, what has not is
    missing, and the final map names it as lost.

    by: "operator", "launch" or "central". reason: in words.
    """

    node: Text
    by: Text
    reason: Text


class MapEstimate(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="map/1"):
    """A robot's own running map in the team's frame: landmark means and covariances.

    exchange: counts the maps that a rule with feedback exchanged (lockstep), 0 under `join`.
    means: L × 2 floats. covariance: packed upper triangle of the 2L × 2L joint if `joint`, else the
    L packed 2 × 2 blocks (3 floats each).
    """

    robot: Name
    incarnation: Count
    sequence: Count
    exchange: Count
    joint: bool
    ids: Ids
    means: Floats
    covariance: Floats

    def check(self) -> None:  # noqa: D102
        check_landmarks(self.ids, self.means, self.covariance, joint=self.joint)


class PoseEstimate(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="pose/1"):
    """A robot's pose in the team's frame at stamp_ns, with its 3 × 3 covariance.

    `map_digest` names the fused map that went into it (8 zero bytes: none), `sequence` the submap
    in progress.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    map_digest: Digest
    pose: Floats
    covariance: Floats

    def check(self) -> None:  # noqa: D102
        check_finite(self.pose, "pose", 3)
        check_covariance(self.covariance, 3, "covariance")


class ParticleCloud(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="particles/1"
):
    """A thinned particle cloud in the team's frame, for viewers: P × 3 poses and P weights."""

    robot: Name
    poses: Floats
    weights: Floats

    def check(self) -> None:  # noqa: D102
        check_finite(self.poses, "poses", 3 * len(floats(self.weights, "weights")))
        check_finite(self.weights, "weights")


class Innovation(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="innovation/1"):
    """Σ νᵀ S⁻¹ ν of a window's measurements against their prediction; χ² where the models are
    right.

    dof: its degrees of freedom, two for each measurement of a landmark that the window knew
    already. (robot, incarnation, sequence) and stamp_ns are those of the window's submap; an
    estimator over the whole stream says it of the measurements since the last of these, named by
    its incarnations so far.
    """

    robot: Name
    incarnation: Count
    sequence: Count
    squared: Annotated[float, Meta(ge=0.0, le=1e300)]
    dof: Count


class VersionEntry(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """One entry of a version vector: all submaps of (robot, incarnation) up to `sequence` are in.

    Of a rule on whole maps it is the robot's map of that sequence, of one on raw measurements the
    robot's measurements up to that counter.
    """

    robot: Name
    incarnation: Count
    sequence: int


class BiasEstimate(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """What the map says of an error that the submaps of (robot, incarnation) share, ± one sigma."""

    robot: Name
    incarnation: Count
    bias: Bias
    value: Real
    sigma: Real


class Membership(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Of which landmark of the map each unnamed landmark of (robot, incarnation) is: M of them.

    sequences, locals: of the submap, and its number less 2³¹; identities: as in the map. steps: M
    bytes, why it went into another set than its own: 0 it has not, 1 track, 2 near, 3 sweep, 4
    closure, 5 merge of robots, 6 verdict. figures: M × 3 floats: the log-likelihood ratio of one
    landmark against two, that of the best rival, the standard deviation of the difference [m].
    """

    robot: Name
    incarnation: Count
    sequences: Ids
    locals: Ids
    identities: Ids
    steps: bytes
    figures: Floats


class AssociationDecision(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """A closure or a merge of robots: accepted, undone, or waiting, with its figures.

    kind: "closure", "merge", "undone" or "waits"; stamp_ns: the end of the last submap that it
    rests on. about: between whom. pairs, llr: landmarks that are one, and the sum of their
    log-likelihood ratios; rival_pairs, rival_llr: of the best other alignment. share: of the
    landmarks there, of the side that has fewer. sd: the largest standard deviation of a pair [m].
    why: the test that failed.
    """

    stamp_ns: StampNs
    kind: Text
    about: Text
    pairs: Count
    llr: Real
    rival_pairs: Count
    rival_llr: Real
    share: Real
    sd: Real
    why: Text


class FusedMap(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="fused_map/1"):
    """The team's map: landmark means and covariances, its set and its frame.

    members: the version vector of its set, ordered; missing: submaps known to be in a gap of it, as
    (robot, incarnation, sequence). digest: 8-byte name of the set (and of the rule and its
    settings). frame: "robot/incarnation" whose start fixes it. provisional: some members lie ahead
    of the watermark. covariance: as in MapEstimate. chi2, dof: the joint cost; 0, 0 where the rule
    has none. exchange: of the lockstep round, 0 under `join`. reasons: why robots are not joined,
    what speaks for another minimum of the final map, and that models do not fit the data. biases:
    by robot, incarnation and name, where submaps have sensitivities. joined: how robots with an
    unknown start were joined, and how sure that is. withdrawn: the robots that the team goes on
    without, ascending. covariance_scale: how many times the submaps' covariances ought to be taken,
    by how well they agree; 1 is right, 0: not known. lost: of a final map, the robots whose streams
    are not wholly in it, since nobody waited for them any more, ascending; such a map is
    provisional. heard: how many submaps and orders to withdraw a robot the centre had, in the map
    or not: of two maps that with more is the newer one, and of equals that with more members.
    memberships: by robot and incarnation, where landmarks have no names: a landmark with members of
    one submap is tentative. decisions: the newest closures and merges of robots, then what waits.
    verdicts: an operator's that the map rests on.
    """

    rule: Text
    digest: Digest
    frame: Text
    final: bool
    provisional: bool
    exchange: Count
    members: tuple[VersionEntry, ...]
    missing: tuple[VersionEntry, ...]
    joint: bool
    ids: Ids
    means: Floats
    covariance: Floats
    chi2: Annotated[float, Meta(ge=0.0, le=1e300)]
    dof: int
    reasons: tuple[Text, ...] = ()
    biases: tuple[BiasEstimate, ...] = ()
    joined: tuple[Text, ...] = ()
    withdrawn: tuple[Name, ...] = ()
    covariance_scale: Annotated[float, Meta(ge=0.0, le=1e300)] = 0.0
    lost: tuple[Name, ...] = ()
    heard: Count = 0
    memberships: tuple[Membership, ...] = ()
    decisions: tuple[AssociationDecision, ...] = ()
    verdicts: tuple[Judgement, ...] = ()

    def check(self) -> None:  # noqa: D102
        for each in self.memberships:
            n = len(ids(each.identities, "identities"))
            if not len(ids(each.sequences, "sequences")) == len(ids(each.locals, "locals")) == n:
                raise ValueError("wrong length: a membership's numbers")
            if len(each.steps) != n:
                raise ValueError(f"wrong length: {len(each.steps)} steps of {n} members")
            check_finite(each.figures, "figures", 3 * n)
        for name, robots in (("withdrawn", self.withdrawn), ("lost", self.lost)):
            if any(a >= b for a, b in pairwise(robots)):
                raise ValueError(f"not ascending: {name}")
        check_landmarks(self.ids, self.means, self.covariance, joint=self.joint)


class Prior(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="prior/1"):
    """For one robot: the joint marginal of its last fused end pose and the landmarks.

    The set is named by digest; `sequence` is the robot's last submap in it (−1: none; the pose is
    the start pose). mean: 3 + 2L floats; covariance: packed upper triangle. The robot is to take
    its submaps that are not in the set as the centre takes them: their covariances times
    covariance_factor, their means moved by the errors that the robot's submaps share (biases).
    members, heard: as in FusedMap; by them a receiver knows the newer one of two.
    """

    robot: Name
    incarnation: Count
    sequence: int
    digest: Digest
    ids: Ids
    mean: Floats
    covariance: Floats
    covariance_factor: Annotated[float, Meta(ge=1.0, le=1e9)] = 1.0
    biases: tuple[BiasEstimate, ...] = ()
    members: tuple[VersionEntry, ...] = ()
    heard: Count = 0

    def check(self) -> None:  # noqa: D102
        check_ascending(self.ids, "ids")
        n = 3 + 2 * len(ids(self.ids, "ids"))
        check_finite(self.mean, "mean", n)
        check_packed_covariance(self.covariance, n, "covariance")


class Trajectory(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="trajectory/1"):
    """A robot's smoothed poses in the final map: K stamps, K × 3 poses, K × 9 floats.

    Under `join` those of its submaps' ends, under `batch` those of its keyframes. start,
    start_covariance: where the first submap begins, 3 and 9 floats; crosses: K × 9 floats, the
    covariance of each pose with the one before it, of the first with the start, row by row. These
    three are empty under `batch`.
    """

    robot: Name
    incarnation: Count
    digest: Digest
    stamps: Stamps
    poses: Floats
    covariances: Floats
    start: Floats = b""
    start_covariance: Floats = b""
    crosses: Floats = b""

    def check(self) -> None:  # noqa: D102
        k = len(stamps(self.stamps, "stamps"))
        if self.start or self.start_covariance or self.crosses:
            check_finite(self.start, "start", 3)
            check_finite(self.start_covariance, "start_covariance", 9)
            check_finite(self.crosses, "crosses", 9 * k)
        check_finite(self.poses, "poses", 3 * k)
        check_finite(self.covariances, "covariances", 9 * k)
        for i in range(k):
            check_covariance(self.covariances[72 * i : 72 * (i + 1)], 3, "covariances")


class Progress(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="progress/1"):
    """How far a node is: per (robot, incarnation) the count of measurements it is done with, and of
    submaps.

    A robot reports itself: measurements consumed (while it waits for an exchange of maps:
    received), and stamp_ns is the team time before which it sends no submap any more. The centre
    reports submaps that are in its set; the recorder reports measurements that it has taken.
    """

    node: Text
    robot: Name
    incarnation: Count
    measurements: Count
    submaps: Count


class Rendezvous(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="rendezvous/1"):
    """Announces that `submaps` buffered submaps are released; the oldest waited `waited_s` seconds.

    teammates: the robots that it sees, which release theirs on this message; empty where the robot
    itself was seen, or its stream has ended.
    """

    robot: Name
    incarnation: Count
    teammates: tuple[Name, ...]
    submaps: Count
    waited_s: Annotated[float, Meta(ge=0.0, le=1e12)]


class Disposition(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """How many measurements of a robot ended in one way: in a submap, rejected for a reason,
    lost…
    """

    disposition: Text
    measurements: Count


class Done(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="done/1"):
    """A robot has consumed every measurement of its stream and sent its last submap.

    last_map: the sequence of its last own map, where the rule consumes own maps; −1: none.
    """

    robot: Name
    incarnation: Count
    measurements: Count
    steps: Count
    submaps: Count
    ledger: tuple[Disposition, ...]
    last_map: int = -1


class StreamEnd(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """The last counters of one robot's stream: its measurements are numbered 0 … measurements −
    1.
    """

    robot: Name
    incarnation: Count
    measurements: Count


class End(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="end/1"):
    """The world has published everything; its last counters."""

    streams: tuple[StreamEnd, ...]
    notes: tuple[Text, ...] = ()


class StreamHead(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="stream_head/1"
):
    """How far a robot's own source is: it has numbered 0 … measurements − 1; stamp_ns is the last
    one's.

    state: "open" while more is measured; "left" when the driver has stopped and may come back;
    "ended" when this incarnation has no more.
    """

    robot: Name
    incarnation: Count
    measurements: Count
    state: Literal["open", "left", "ended"]


class TeamEnd(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="team_end/1"):
    """An operator's order to a live team: whoever measures ends now.

    by: who ordered it. reason: in words.
    """

    by: Text
    reason: Text


class Status(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="status/1"):
    """What a node is doing, for people: a state word, figures by name, warnings in words."""

    node: Text
    state: Text
    figures: dict[str, Real]
    warnings: tuple[Text, ...] = ()


class Fault(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="fault/1"):
    """A node could not handle a message and set it aside; stamp_ns is the message's.

    origin: its key, the query's for a reply, the duty's name if there was no message. count: its
    publisher's count of the key; -1: none. message: its tag; empty where it raised before it was
    one. error, text: the exception's class and words. place: module:function:line. digest: 8 bytes,
    the payload's BLAKE2b.
    """

    node: Text
    origin: Text
    count: Annotated[int, Meta(ge=-1, le=2**63 - 1)]
    message: Text
    error: Text
    text: Text
    place: Text
    digest: Digest


class Liveliness(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="liveliness/1"):
    """A node's liveliness token appeared or went; a recorded input of whoever reacted to it."""

    node: Text
    alive: bool


class Tally(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="tally/1"):
    """What a process has published of each key, said at its end: what is not in a log is missing.

    since_ns: its wall clock at the beginning [ns since 1970]; what it published is not older.
    """

    node: Text
    since_ns: StampNs
    keys: tuple[Text, ...]
    counts: tuple[Count, ...]

    def check(self) -> None:  # noqa: D102
        if len(self.keys) != len(self.counts):
            raise ValueError(f"{len(self.counts)} counts of {len(self.keys)} keys")


class MeasurementsRequest(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="readings_wanted/1"
):
    """A query to a source: measurements first … last of (robot, incarnation); last −1: all there
    are.

    only: the source gives what it has, and does not begin the stream anew for what it has not.
    """

    robot: Name
    incarnation: Count
    first: Count
    last: int
    only: bool = False


class SubmapsRequest(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="submaps_wanted/1"
):
    """A query for the submaps of one robot: to the centre for those in its set, or to the robot.

    incarnation: whose alone; 0: of every incarnation. first: of that incarnation, those from this
    sequence on.
    """

    robot: Name
    incarnation: Count = 0
    first: Count = 0


class FinalMapRequest(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="final_wanted/1"
):
    """A query to the router: the team's final map, if there is one already. node: who asks."""

    node: Text = ""


class FinalMapReply(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="final_kept/1"
):
    """The router's answer: the payload of the newest final map, and how long ago it came [ns].

    missed: a process of the node that asks was in that run and went without a last word.
    """

    age_ns: Count
    final: bytes
    missed: bool = False


class OrdersRequest(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="orders_wanted/1"
):
    """A query to the router: the orders that hold in this run, from operators who have left."""


class Holding(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """What a node has of one stream: whether its initial pose, and which submaps, each with all
    inter-robot measurements from it.

    sequences: first, last, first, last, … of closed intervals, ascending, with gaps between them.
    digest: of what is there, whatever the order in which it came. newest_ns: the end of the newest.
    """

    robot: Name
    incarnation: Count
    start: bool
    sequences: tuple[Count, ...]
    digest: Digest
    newest_ns: StampNs = 0


class Statements(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """How many orders and last words about a robot a node has, and their digest."""

    robot: Name
    count: Count
    digest: Digest


class SetSummary(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="set_summary/1"
):
    """What a peer has of the team's set, so that others can ask for what they lack.

    serial: counts the summaries of this process. digest: of all of it; equal digests are equal
    sets. holdings: by robot and incarnation, statements: by robot, both ascending.
    """

    node: Text
    serial: Count
    digest: Digest
    holdings: tuple[Holding, ...]
    statements: tuple[Statements, ...]

    def check(self) -> None:  # noqa: D102
        for holding in self.holdings:
            ends = holding.sequences
            if len(ends) % 2 or any(a > b for a, b in zip(ends[::2], ends[1::2], strict=True)):
                raise ValueError("out of bounds: sequences are no intervals")
            if any(a + 1 >= b for a, b in zip(ends[1::2], ends[2::2], strict=False)):
                raise ValueError("not ascending: sequences")


class Wanted(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Of one stream: its initial pose if `start`, and submaps first … last (none: last < first)."""

    robot: Name
    incarnation: Count
    start: bool
    first: Count
    last: int


class MembersRequest(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="members_wanted/1"
):
    """A query to a peer for members of the set. node: who asks.

    statements: the robots of whom all orders and last words are wanted.
    """

    node: Text
    wanted: tuple[Wanted, ...]
    statements: tuple[Name, ...] = ()


class Members(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="members/1"):
    """Members of the set as `node` has them: the key and the very bytes of who first said each.

    signatures: of each, by who said it; empty where the team has no keys.
    """

    node: Text
    keys: tuple[Text, ...]
    payloads: tuple[bytes, ...]
    signatures: tuple[bytes, ...]

    def check(self) -> None:  # noqa: D102
        if not len(self.keys) == len(self.payloads) == len(self.signatures):
            raise ValueError("wrong length: keys, payloads and signatures")


class RadioPlan(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="radio/1"):
    """Of a simulated radio: who reaches whom, by seconds of team time from stamp_ns on.

    pairs: a row of bits for each second, of the robots two by two in their order, padded to bytes.
    ends_ns: when each robot's stream ends.
    """

    robots: tuple[Name, ...]
    ends_ns: tuple[StampNs, ...]
    pairs: bytes

    def check(self) -> None:  # noqa: D102
        n = len(self.robots)
        width = max((n * (n - 1) // 2 + 7) // 8, 1)
        if len(self.ends_ns) != n or not self.pairs or len(self.pairs) % width:
            raise ValueError("wrong length: ends_ns or pairs")


class Certificate(
    Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="certificate/1"
):
    """A robot's certificate (DER), by which its signatures can be checked: a member of the set."""

    robot: Name
    certificate: Annotated[bytes, Meta(min_length=1, max_length=8192)]


class Signature(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="signature/1"):
    """A robot's signature of a member that it has said, for whoever carries it.

    member: 32 bytes, the BLAKE2b of the key's length (2 bytes, little-endian), key and payload.
    """

    robot: Name
    member: Annotated[bytes, Meta(min_length=32, max_length=32)]
    signature: Annotated[bytes, Meta(min_length=1, max_length=256)]


class Concluded(Message, frozen=True, kw_only=True, array_like=True, gc=False, tag="concluded/1"):
    """A peer has the final map of its own fold. digest: its set's. sha256: of the map's payload.

    submaps: in its set. serial: counts the peer's final maps: one of a set that has grown since
    is another one. A member of the set, on which no map rests.
    """

    robot: Name
    serial: Count
    digest: Digest
    sha256: Annotated[bytes, Meta(min_length=32, max_length=32)]
    submaps: Count


def check_landmarks(id_bytes: bytes, means: bytes, covariance: bytes, *, joint: bool) -> None:
    """Raise ValueError unless ids ascend and means and covariance fit them (joint or blocks)."""
    check_ascending(id_bytes, "ids")
    n = len(ids(id_bytes, "ids"))
    check_finite(means, "means", 2 * n)
    if joint:
        check_packed_covariance(covariance, 2 * n, "covariance")
        return
    check_blocks(covariance, n, "covariance")


def check_counts(count_bytes: bytes, groups: int, total: int) -> None:
    """Raise ValueError unless there is a count for each group and they sum to the total."""
    counts = ids(count_bytes, "counts")
    if len(counts) != groups or int(counts.sum(dtype=np.int64)) != total:
        raise ValueError(f"wrong length: counts, {groups} groups of together {total} expected")


def tag_of(message: type[Message]) -> str:
    """A message's tag, "name/version"."""
    return str(message.__struct_config__.tag)


def _by_tag(base: type[Message]) -> dict[str, type[Message]]:
    found: dict[str, type[Message]] = {}
    for message in base.__subclasses__():
        tag = message.__struct_config__.tag
        if isinstance(tag, str):
            found[tag] = message
        found |= _by_tag(message)
    return found


BY_TAG = _by_tag(Message)
"""Every message class by its tag."""
