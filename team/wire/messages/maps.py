"""The team's map, priors, trajectories and saved maps."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from teamslam.team.config import MAP, SURVEY, UNNAMED
from teamslam.team.core import (
    check_ascending,
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
    StampNs,
    Text,
    check_classes,
    check_landmarks,
    check_sorted,
)
from teamslam.team.wire.messages.nodes import Judgement

ChangeState = Literal["unchanged", "moved", "gone", "new"]
MOST_SAVED = 2000
"""Most landmarks of a saved map (joint covariance: 64 MB)."""
MOST_OWN = 500
"""Most errors of single robots in a saved map."""
MOST_SETS = 10_000
"""Most streams in a saved map: five a day for five years."""


class VersionEntry(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Entry of a version vector: the submaps of a stream up to `sequence`.

    Under a rule on whole maps sequence is that of the robot's map, under a rule on raw measurements
    their counter.
    """

    robot: Author
    incarnation: Count
    sequence: int


class BiasEstimate(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Estimate of an error that all submaps of (robot, incarnation) share."""

    robot: Author
    incarnation: Count
    bias: Bias
    value: Real
    sigma: Real


class Membership(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Landmarks of the map to which M unnamed landmarks of (robot, incarnation) belong.

    sequences, locals: submap, and number less 2³¹. identities: as in the map. steps: M bytes, the
    step of association that merged it: 0 none, 1 track, 2 near, 3 sweep, 4 closure, 5 merge of
    robots, 6 verdict. figures: M × 3 floats: log-likelihood ratio of one landmark against two, that
    of the best rival, standard deviation of the difference [m].
    """

    robot: Author
    incarnation: Count
    sequences: Ids
    locals: Ids
    identities: Ids
    steps: bytes
    figures: Floats


class AssociationDecision(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """A closure or a merge of robots, with its figures.

    kind: "closure", "merge", "undone" or "waits". stamp_ns: end of its last submap. about: the two
    sides. pairs, llr: number of pairs, and sum of their log-likelihood ratios; rival_pairs,
    rival_llr: of the best other alignment. share: matched share of the landmarks there, of the side
    that has fewer. sd: largest standard deviation of a pair [m]. why: the failed test. absent:
    landmarks of one side that are missing where the other side looked.
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
    absent: Count = 0


class LandmarkChange(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """State of a landmark against the saved maps of earlier days.

    dx, dy [m]: its displacement in the frame of the map; sigma [m]: of one coordinate of it; chi2:
    two degrees of freedom, that it has not moved; both 0 for a gone or new landmark. dx, dy of a
    gone one: to the map's place for its number, if a submap has that elsewhere. expected: how often
    a gone one should have been observed.
    """

    landmark: Count
    state: ChangeState
    dx: Real = 0.0
    dy: Real = 0.0
    sigma: Real = 0.0
    chi2: Real = 0.0
    expected: Real = 0.0


Cause = Literal[
    "landmark_moved",
    "identity_shared",
    "clock_offset",
    "odometry_scale",
    "bearing_offset",
    "range_offset",
    "mirrored",
    "carried_off",
    "wrong_minimum",
    "noise_underestimated",
    "noise_overestimated",
]

MapPlace = Literal["", "first", "second", "between"]


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """A cause of misfit: of a robot, of a landmark, or of the team (neither).

    value, sigma: (dx, dy) [m] of a landmark's second place from its first; (dx, dy, dtheta) of a
    robot that was carried off, with at_ns 0 of its true from its initial pose; else one number or
    none. evidence: removed cost per degree of
    freedom, or the log-likelihood ratio of a view that changed at once. at_ns: team time of the
    change; 0: none. place: (x, y) [m] of it, if known; of a moved landmark its first place.
    map_has: the place of a moved landmark in this map, "" if it is not evaluated.
    """

    cause: Cause
    robot: Text = ""
    landmark: int | None = None
    value: tuple[Real, ...] = ()
    sigma: tuple[Real, ...] = ()
    evidence: Real = 0.0
    remedy: Text = ""
    at_ns: StampNs = 0
    place: tuple[Real, ...] = ()
    map_has: MapPlace = ""


class FusedMap(Message, frozen=True, kw_only=True, tag="fused_map/1"):
    """The team's map: landmark means and covariances, its set and its frame.

    members: version vector of its set; missing: submaps known to be in a gap of it. digest: of the
    set, the rule and its settings. frame: the stream whose start fixes the frame,
    "robot/incarnation". provisional: some members are ahead of the watermark. covariance: as in
    MapEstimate. chi2, dof: the joint cost; 0, 0 if the rule has none. exchange: number of the
    lockstep round, 0 under `join`. reasons: why robots are not joined, signs of another minimum,
    and of models that do not fit the data. biases: if submaps have sensitivities. joined: how
    robots with an unknown start were joined, with the evidence. withdrawn, lost: ascending; the
    streams of lost robots are incomplete in the final map, which is then provisional.
    covariance_scale: factor by which the submaps' covariances should be multiplied, from their
    agreement; 1 is consistent, 0: unknown. heard: number of submaps and withdrawals received; the
    newer of two maps has more, or as many and more members. memberships: if landmarks have no
    names; a landmark of one submap is tentative, and a running map names the first and last few
    members of each. decisions: the newest closures and merges of robots, then the waiting ones.
    verdicts: the operators'. changes: in a final map with a saved one, the state of each landmark,
    by number. diagnosis: causes of misfit, the best one first. left_out: version vector of the
    withdrawn robots' submaps, which the diagnosis compares with the map.
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
    withdrawn: tuple[Author, ...] = ()
    covariance_scale: Annotated[float, Meta(ge=0.0, le=1e300)] = 0.0
    lost: tuple[Name, ...] = ()
    heard: Count = 0
    memberships: tuple[Membership, ...] = ()
    decisions: tuple[AssociationDecision, ...] = ()
    verdicts: tuple[Judgement, ...] = ()
    changes: tuple[LandmarkChange, ...] = ()
    diagnosis: tuple[Diagnosis, ...] = ()
    left_out: tuple[VersionEntry, ...] = ()

    def check(self) -> None:
        for each in self.memberships:
            n = len(ids(each.identities, "identities"))
            if not len(ids(each.sequences, "sequences")) == len(ids(each.locals, "locals")) == n:
                raise ValueError("wrong length: a membership's numbers")
            if len(each.steps) != n:
                raise ValueError(f"wrong length: {len(each.steps)} steps of {n} members")
            check_finite(each.figures, "figures", 3 * n)
        check_sorted(self.withdrawn, "withdrawn")
        check_sorted(self.lost, "lost")
        check_landmarks(self.ids, self.means, self.covariance, joint=self.joint)


class Prior(Message, frozen=True, kw_only=True, tag="prior/1"):
    """Joint marginal of a robot's last fused end pose and landmarks.

    digest: the set; sequence: the robot's last submap in it (−1: none; the pose is the start pose).
    mean: 3 + 2L floats; covariance: packed upper triangle. The robot uses its further submaps as
    the centre does: covariances times covariance_factor, means moved by `biases`. members, heard:
    as in FusedMap; withdrawn: number of withdrawn robots; they order two priors. frame: of pose and
    landmarks, as in FusedMap; in_team_frame: the robot is in the team's map.

    A prior outside the team's map withdraws those before it. Without landmarks its `frame` is the
    robot's own, and ids, mean and covariance are empty; else `frame` is the team's, and mean (2L
    floats) and covariance are those of landmarks alone, by which the robot estimates its pose.
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
    withdrawn: Count = 0
    frame: Text = ""
    in_team_frame: bool = True

    def check(self) -> None:
        check_ascending(self.ids, "ids")
        n = 2 * len(ids(self.ids, "ids")) + 3 * self.in_team_frame
        if n == 0 and (self.mean or self.covariance):
            raise ValueError("wrong length: a prior that withdraws contains an estimate")
        check_finite(self.mean, "mean", n)
        check_packed_covariance(self.covariance, n, "covariance")


class Trajectory(Message, frozen=True, kw_only=True, tag="trajectory/1"):
    """A robot's smoothed poses in the final map: K stamps, K × 3 poses, K × 9 floats.

    Under `join` they are the ends of its submaps, under `batch` its keyframes. start,
    start_covariance: start of the first submap, 3 and 9 floats; crosses: K × 9 floats, row-major,
    the covariance of each pose with the one before it (of the first with the start). All three are
    empty under `batch`.
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

    def check(self) -> None:
        k = len(stamps(self.stamps, "stamps"))
        if self.start or self.start_covariance or self.crosses:
            check_finite(self.start, "start", 3)
            check_finite(self.start_covariance, "start_covariance", 9)
            check_finite(self.crosses, "crosses", 9 * k)
        check_finite(self.poses, "poses", 3 * k)
        check_finite(self.covariances, "covariances", 9 * k)
        for i in range(k):
            check_pose_covariance(self.covariances[72 * i : 72 * (i + 1)], "covariances")


class RobotBias(msgspec.Struct, frozen=True, kw_only=True, array_like=True, order=True):
    """An error that all submaps of a robot share."""

    robot: Name
    bias: Bias


class SavedMap(Message, frozen=True, kw_only=True, tag="saved_map/1"):
    """The final map of a team as one Gaussian, for a file and for the set of a later team.

    stamp_ns: end of its last submap. Its landmarks are a member `map-<name>` of the set. ids: L,
    ascending; from 2³¹ on landmarks without identity. means: 2L floats [m]. covariance: packed
    upper triangle of their joint covariance, positive definite, given zero `biases`. biases: errors
    that all sensors share on every day, ascending; sensitivity: B × 2L floats: given these errors b
    the means are means + bᵀ sensitivity. counts: number of submaps of each landmark, earlier days
    included. frame: as in FusedMap. sets: digests of the first submap of each robot's stream in it,
    on all days, ascending: two maps with a stream in common cannot be joined. software, core:
    version of the program, digest of the native core. datum: latitude [deg], longitude [deg] and
    height [m] of the frame's origin on WGS84, x east and y north; empty: not stated.

    own: K errors of single robots, ascending. Given zero `biases`, own_means: their K means;
    own_covariance: packed upper triangle of their covariance; own_cross: K × 2L floats, their
    covariance with the means of the landmarks, whose `covariance` contains them. own_sensitivity: B
    × K floats: given b their means are own_means + bᵀ own_sensitivity. likeliest, evidence: B + K
    floats and the packed upper triangle of an information matrix, positive definite: the likelihood
    N(likeliest, evidence⁻¹) of (biases, own) by the measurements in the map, without any prior of
    these errors. classes: as in Submap, of the landmarks without identity.
    """

    name: Name
    ids: Ids
    means: Floats
    covariance: Floats
    biases: tuple[Bias, ...]
    sensitivity: Floats
    counts: Ids
    frame: Text
    sets: Annotated[tuple[Digest, ...], Meta(max_length=MOST_SETS)]
    software: Text
    core: Text
    datum: Floats = b""
    own: Annotated[tuple[RobotBias, ...], Meta(max_length=MOST_OWN)] = ()
    own_means: Floats = b""
    own_covariance: Floats = b""
    own_cross: Floats = b""
    own_sensitivity: Floats = b""
    likeliest: Floats = b""
    evidence: Floats = b""
    classes: Floats = b""

    @property
    def author(self) -> str:
        """Name of its member of the set."""
        return MAP + self.name

    def check(self) -> None:
        n = len(ids(self.ids, "ids"))
        if self.author == SURVEY:
            raise ValueError("wrong field: the name is that of the surveyed landmarks")
        if not 2 <= n <= MOST_SAVED:
            raise ValueError(f"out of bounds: {n} landmarks, 2 to {MOST_SAVED} are possible")
        check_landmarks(self.ids, self.means, self.covariance, joint=True)
        check_finite(self.sensitivity, "sensitivity", 2 * n * len(self.biases))
        counts = ids(self.counts, "counts")
        if len(counts) != n or not counts.min():
            raise ValueError(f"wrong length: counts are not {n} positive numbers")
        check_sorted(self.biases, "biases")
        check_sorted(self.sets, "sets")
        if not self.sets:
            raise ValueError("out of bounds: a map of no set")
        self._check_own(2 * n)
        check_classes(self.classes, int((ids(self.ids, "ids") >= UNNAMED).sum()))
        if self.datum:
            check_finite(self.datum, "datum", 3)
            latitude, longitude, _ = floats(self.datum, "datum")
            if abs(latitude) > 89.0 or abs(longitude) > 180.0:
                raise ValueError(f"out of bounds: datum at {latitude:g}°, {longitude:g}°")

    def _check_own(self, n: int) -> None:
        """Check the errors of single robots, with their joint covariance with the landmarks."""
        K = len(self.own)
        check_sorted(self.own, "own")
        check_finite(self.own_means, "own_means", K)
        check_finite(self.own_cross, "own_cross", K * n)
        check_finite(self.own_sensitivity, "own_sensitivity", K * len(self.biases))
        check_finite(self.own_covariance, "own_covariance", K * (K + 1) // 2)
        E = K + len(self.biases) if K else 0
        check_finite(self.likeliest, "likeliest", E)
        check_finite(self.evidence, "evidence", E * (E + 1) // 2)
        if not K:
            return
        check_packed_covariance(self.evidence, E, "evidence")
        rows, at = [], 0
        for i in range(K):  # rows of the joint upper triangle
            rows += [self.own_covariance[at : at + 8 * (K - i)]]
            rows += [self.own_cross[8 * n * i : 8 * n * (i + 1)]]
            at += 8 * (K - i)
        upper = b"".join([*rows, self.covariance])
        check_packed_covariance(upper, K + n, "own_covariance with covariance")
