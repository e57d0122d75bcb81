"""The team's map, and what goes out with it."""

from itertools import pairwise
from typing import Annotated

import msgspec
from msgspec import Meta

from team.wire.arrays import (
    Floats,
    Ids,
    Stamps,
    check_ascending,
    check_finite,
    check_packed_covariance,
    check_pose_covariance,
    ids,
    stamps,
)
from team.wire.messages.base import (
    Bias,
    Count,
    Digest,
    Message,
    Name,
    Real,
    StampNs,
    Text,
    check_landmarks,
)
from team.wire.messages.orders import Judgement


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
    why: the test that failed. absent: landmarks that one side has where the other looked and has
    none.
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


class FusedMap(Message, frozen=True, kw_only=True, tag="fused_map/1"):
    """The team's map: landmark means and covariances, its set and its frame.

    members: the version vector of its set, ordered; missing: submaps known to be in a gap of it, as
    (robot, incarnation, sequence). digest: 8-byte name of the set (and of the rule and its
    settings). frame: the team's: "robot/incarnation" whose start fixes it. provisional: some
    members lie ahead of the watermark. covariance: as in MapEstimate. chi2, dof: the joint cost; 0,
    0 where the rule has none. exchange: of the lockstep round, 0 under `join`. reasons: why robots
    are not joined, what speaks for another minimum, and that models do not fit the data. biases:
    by robot, incarnation and name, where submaps have sensitivities. joined: how robots with an
    unknown start were joined, and how sure that is. withdrawn: the robots that the team goes on
    without, ascending. covariance_scale: how many times the submaps' covariances ought to be taken,
    by how well they agree; 1 is right, 0: not known. lost: of a final map, the robots whose streams
    are not wholly in it, since nobody waited for them any more, ascending; such a map is
    provisional. heard: how many submaps and orders to withdraw a robot the centre had, in the map
    or not: of two maps that with more is the newer one, and of equals that with more members.
    memberships: by robot and incarnation, where landmarks have no names: a landmark with members of
    one submap is tentative; a running map names the first and the last few members of each.
    decisions: the newest closures and merges of robots, then what waits.
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


class Prior(Message, frozen=True, kw_only=True, tag="prior/1"):
    """For one robot: the joint marginal of its last fused end pose and the landmarks.

    The set is named by digest; `sequence` is the robot's last submap in it (−1: none; the pose is
    the start pose). mean: 3 + 2L floats; covariance: packed upper triangle. The robot is to take
    its submaps that are not in the set as the centre takes them: their covariances times
    covariance_factor, their means moved by the errors that the robot's submaps share (biases).
    members, heard: as in FusedMap, and withdrawn the number of robots that the team goes on
    without; they give the newer one of two. frame: that of the pose and the landmarks, as in
    FusedMap; in_team_frame: it is the team's. One that is not withdraws the priors before it: the
    robot is not in the team's map, `frame` is its own, and ids, mean and covariance are empty.
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

    def check(self) -> None:  # noqa: D102
        if not self.in_team_frame:
            if self.ids or self.mean or self.covariance:
                raise ValueError("a prior that is not in the team's frame contains an estimate")
            return
        check_ascending(self.ids, "ids")
        n = 3 + 2 * len(ids(self.ids, "ids"))
        check_finite(self.mean, "mean", n)
        check_packed_covariance(self.covariance, n, "covariance")


class Trajectory(Message, frozen=True, kw_only=True, tag="trajectory/1"):
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
            check_pose_covariance(self.covariances[72 * i : 72 * (i + 1)], "covariances")
