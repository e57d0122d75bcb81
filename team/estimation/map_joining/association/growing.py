"""The basic step of data association between submaps: merges pairs of landmarks of a joint
Gaussian.

The pair of landmarks with the best log-likelihood ratio of "one landmark" against "two" is merged,
mean and covariance are conditioned on it, and so on. With the difference d of a pair, its
covariance S (joint, plus the slack s₀²) and λ expected landmarks per square metre

    LLR = −½ dᵀS⁻¹d − ½ ln|S| − ln 2π − ln λ.

Since each ratio is conditional on the pairs before it, their sum is the ratio of all of them
together.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.association import AssociationProfile
from team.estimation import dense, elementary, elementwise
from team.estimation.map_joining.association.crowding import Crowd

Indices = Int64[np.ndarray, " _"]
PREGATE = 4.0
"""Multiple of the gate beyond which a pair is excluded for good."""
SURE_AFTER = 3
"""Number of pairs after which an alignment grows only by pairs of small standard deviation: others
connect landmarks to neighbours that are one spacing off.
"""


SPLIT = 1.0
"""What two landmarks that one window has as two need beyond others to be one: a window seldom
splits a landmark.
"""


class Joint(NamedTuple):
    """Landmarks with their joint covariance, in one frame.

    mean: positions [m].
    covariance: of (x₁, y₁, x₂, …) [m²].
    apart: which two can not be one, symmetric: they were observed in one scan, have different
        names, or an operator declared them to be two.
    crowd: their local density; None: the density of the profile.
    unseen: of one map's landmarks, the probability that all windows which saw each of them missed
        another one beside it; the density of the profile is then an upper bound of the map's own.
    apart_in_window: which two one submap has as two, symmetric; None: unknown.
    """

    mean: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "m m"]
    apart: Bool[np.ndarray, "n n"]
    crowd: Crowd | None = None
    unseen: Float[np.ndarray, " n"] | None = None
    apart_in_window: Bool[np.ndarray, "n n"] | None = None


class Pair(NamedTuple):
    """Two landmarks that are one, known by the second; rival: the best LLR of a pair that excludes
    it.
    """

    first: int
    second: int
    llr: float
    sd: float
    rival: float


class Grown(NamedTuple):
    """Pairs in the order in which they were merged, and the joint Gaussian afterwards.

    doubtful: pairs that passed their gate and likelihood, and were rejected because of a rival.
    """

    pairs: tuple[Pair, ...]
    joint: Joint
    doubtful: int

    @property
    def llr(self) -> float:
        """Log-likelihood ratio of all pairs together."""
        return sum(pair.llr for pair in self.pairs)


class Likelihoods(NamedTuple):
    """For each candidate: χ², log-likelihood ratio, largest standard deviation of the
    difference.
    """

    chi2: Float[np.ndarray, " k"]
    llr: Float[np.ndarray, " k"]
    sd: Float[np.ndarray, " k"]


def likelihoods(
    joint: Joint, first: Indices, second: Indices, profile: AssociationProfile
) -> Likelihoods:
    """The likelihoods that each candidate pair is one landmark."""
    difference = joint.mean[first] - joint.mean[second]
    n = len(joint.mean)
    P = joint.covariance.reshape(n, 2, n, 2)
    R = P[first, :, first] + P[second, :, second] - P[first, :, second] - P[second, :, first]
    half = 0.5 * (R[:, 0, 0] + R[:, 1, 1])
    spread = elementwise.hypot(0.5 * (R[:, 0, 0] - R[:, 1, 1]), R[:, 0, 1])
    slack = elementary.squared(profile.slack)
    a, b, c = R[:, 0, 0] + slack, R[:, 0, 1], R[:, 1, 1] + slack
    determinant = np.maximum(a * c - b * b, 1e-18)
    x, y = difference.T
    chi2 = (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
    density = np.full(len(x), profile.density)
    if joint.crowd is not None:
        radius = np.sqrt(profile.gate) * np.sqrt(np.sqrt(determinant))
        crowded = joint.crowd.density(radius)
        if joint.unseen is not None:
            crowded *= joint.unseen[second]
            density = np.minimum(density, joint.crowd.density_in_map(radius))
        density = np.maximum(density, crowded)
    llr = -0.5 * chi2 - 0.5 * elementwise.log(determinant) - elementwise.log(2.0 * np.pi * density)
    return Likelihoods(chi2, llr, np.sqrt(np.maximum(half + spread, 0.0)))


def needed(
    joint: Joint,
    first: Indices,
    second: Indices,
    sd: Float[np.ndarray, " k"],
    profile: AssociationProfile,
) -> Float[np.ndarray, " k"]:
    """The log-likelihood ratio with which each pair is one landmark where it has no rival: more
    where the standard deviation is large, and by SPLIT more where one submap has it as two.
    """
    least = np.where(sd < profile.tight, profile.llr_tight, profile.llr_loose)
    if joint.apart_in_window is not None:
        least = least + SPLIT * joint.apart_in_window[first, second]
    return least


def conditioned(joint: Joint, first: int, second: int, profile: AssociationProfile) -> Joint:
    """The joint Gaussian given that two landmarks are one, which is two with whatever either was
    two with.
    """
    n = len(joint.mean)
    P = joint.covariance
    one, two = slice(2 * first, 2 * first + 2), slice(2 * second, 2 * second + 2)
    gain = P[:, one] - P[:, two]
    S = gain[one] - gain[two] + elementary.squared(profile.slack) * np.eye(2)
    weighted = dense.solve(S, gain.T)
    difference = joint.mean[first] - joint.mean[second]
    mean = joint.mean - (dense.product(weighted.T, difference)).reshape(n, 2)
    in_window = joint.apart_in_window
    return joint._replace(
        mean=mean,
        covariance=P - dense.product(gain, weighted),
        apart=_of_both(joint.apart, first, second),
        apart_in_window=in_window if in_window is None else _of_both(in_window, first, second),
    )


def _of_both(relation: Bool[np.ndarray, "n n"], first: int, second: int) -> Bool[np.ndarray, "n n"]:
    """A symmetric relation, of which the second has what either has."""
    out = relation.copy()
    out[second] = out[:, second] = relation[first] | relation[second]
    return out


def grow(
    joint: Joint,
    candidates: Sequence[Indices],
    profile: AssociationProfile,
    *,
    seeds: Sequence[tuple[int, int]] = (),
    most_sd: float = np.inf,
    sure_sd: float = np.inf,
) -> Grown | None:
    """Merges pairs one after the other, the likeliest first; None where a seed fails its gate.

    candidates: two lists of landmarks, pair by pair; when a landmark is merged, its other pairs are
        dropped.
    seeds: pairs to begin with, whatever their rivals.
    most_sd: pairs with a larger standard deviation are not merged; sure_sd: the same, once
        SURE_AFTER pairs are merged.
    """
    taken: list[Pair] = []
    for one, two in seeds:
        if joint.apart[one, two]:
            return None
        at = likelihoods(joint, np.array([one]), np.array([two]), profile)
        if at.chi2[0] > profile.gate:
            return None
        taken.append(Pair(one, two, float(at.llr[0]), float(at.sd[0]), -np.inf))
        joint = conditioned(joint, one, two, profile)
    first, second = candidates
    gone = np.isin(first, [pair.first for pair in taken])
    open_ = ~joint.apart[first, second] & ~gone
    first, second = first[open_], second[open_]
    near = likelihoods(joint, first, second, profile).chi2 < PREGATE * profile.gate
    first, second = first[near], second[near]
    doubtful = 0
    while len(first):
        at = likelihoods(joint, first, second, profile)
        least = needed(joint, first, second, at.sd, profile)
        limit = min(most_sd, sure_sd) if len(taken) >= SURE_AFTER else most_sd
        fits = (at.chi2 < profile.gate) & (at.llr >= least) & (at.sd <= limit)
        if not fits.any():
            doubtful = 0
            break
        rival = _rivals(joint, first, second, at, profile)
        clear = fits & (at.llr - rival >= profile.odds)
        doubtful = int((fits & ~clear).sum())
        if not clear.any():
            break
        best = int(np.argmax(np.where(clear, at.llr, -np.inf)))
        one, two = int(first[best]), int(second[best])
        taken.append(Pair(one, two, float(at.llr[best]), float(at.sd[best]), float(rival[best])))
        joint = conditioned(joint, one, two, profile)
        open_ = (first != one) & (second != one) & ~joint.apart[first, second]
        first, second = first[open_], second[open_]
    return Grown(tuple(taken), joint, doubtful)


def _rivals(
    joint: Joint, first: Indices, second: Indices, at: Likelihoods, profile: AssociationProfile
) -> Float[np.ndarray, " k"]:
    """The best LLR of each candidate's rivals: another partner of its first or of its second
    landmark.

    A partner that may be the same object as this one (split in two, close to it, never observed
    with it) is no rival: fragments of one landmark would block each other.
    """
    rival = np.full(len(first), -np.inf)
    for mine, other in ((first, second), (second, first)):
        each, against = _of_one(mine)
        p, q = other[each], other[against]
        x, y = (joint.mean[p] - joint.mean[q]).T
        differ = (x * x + y * y >= elementary.squared(profile.same)) | joint.apart[p, q]
        np.maximum.at(rival, each[differ], at.llr[against[differ]])
    return rival


def _of_one(landmarks: Indices) -> tuple[Indices, Indices]:
    """Every two candidates of one landmark, in both orders."""
    order = np.argsort(landmarks, kind="stable")
    ordered = landmarks[order]
    begin = np.searchsorted(ordered, ordered, side="left")
    count = np.searchsorted(ordered, ordered, side="right") - begin
    each = np.repeat(np.arange(len(order)), count)
    against = np.arange(len(each)) - np.repeat(np.cumsum(count) - count - begin, count)
    two = each != against
    return order[each[two]], order[against[two]]
