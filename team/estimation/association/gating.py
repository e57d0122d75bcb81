"""Gates: detections against landmarks, and landmarks against landmarks.

Both test the squared Mahalanobis distance d² = dᵀS⁻¹d of a difference d with covariance S against
χ² of two degrees of freedom (individual compatibility; Neira and Tardós 2001, IEEE T-RA 17(6)). Two
landmarks also have a log-likelihood ratio of "one" against "two": with S plus the slack s₀², and λ
expected landmarks per square metre,

  LLR = −½ dᵀS⁻¹d − ½ ln|S| − ln 2π − ln λ,

plus the evidence of their classes.
"""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.association import AssociationProfile
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation.association.classes import CONTRADICTED, Classes, compare_classes
from teamslam.team.estimation.association.density import LandmarkDensity
from teamslam.team.estimation.association.scans import UNASSIGNED
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]

LEAST_DETERMINANT = 1e-32
"""Lower bound of |S| [m⁴]: the smallest accepted standard deviation is 1e-8 m."""
SPLIT = 1.0
"""Additional log-likelihood ratio for a pair of one window, which seldom splits a landmark."""


def compute_mahalanobis(
    differences: Float[np.ndarray, "*n 2"], covariances: Float[np.ndarray, "*n 2 2"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Compute dᵀS⁻¹d and |S| of each difference d."""
    a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    x, y = differences[..., 0], differences[..., 1]
    determinants = np.maximum(a * c - b * b, LEAST_DETERMINANT)
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinants, determinants


def match_scan(
    points: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    names: Int64[np.ndarray, " n"],
    predicted: tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2 2"]],
    mapped_names: Int64[np.ndarray, " L"],
    settings: AssociationSettings,
) -> Int64[np.ndarray, " n"]:
    """Match the detections of a scan with landmarks; UNASSIGNED without a match.

    An unnamed detection matches unnamed landmarks in its gate; a named one its landmark at any
    distance. A pair costs dᵀS⁻¹d + ln|S|. points, covariances, predicted: in the robot's frame [m,
    m²].
    """
    seen, spread = predicted
    S = spread[None] + settings.variance_factor * covariances[:, None]
    squared, determinants = compute_mahalanobis(points[:, None] - seen[None], S)
    allowed = names[:, None] == mapped_names[None]
    allowed &= (squared < settings.gate) | (names[:, None] != UNASSIGNED)
    return match_best_first(allowed, squared + core.log(determinants))


def match_best_first(
    allowed: Bool[np.ndarray, "n L"], costs: Float[np.ndarray, "n L"]
) -> Int64[np.ndarray, " n"]:
    """Assign a landmark to each detection, the allowed pair of least cost first, or UNASSIGNED.

    Equal costs keep their order.
    """
    found = np.full(len(allowed), UNASSIGNED)
    rows, columns = np.nonzero(allowed)
    assigned = np.zeros(allowed.shape[1], np.bool_)
    for index in np.argsort(costs[rows, columns], kind="stable"):
        row, column = rows[index], columns[index]
        if found[row] == UNASSIGNED and not assigned[column]:
            found[row], assigned[column] = column, True
    return found


class Joint(NamedTuple):
    """Landmarks with their joint covariance, in one frame.

    mean: positions [m]. covariance: of (x₁, y₁, x₂, …) [m²]. apart: pairs that cannot be one
    landmark, symmetric: observed in one scan, named differently, or declared to be two. density:
    local; None: the profile's. unseen: probability that all windows with a landmark missed another
    one beside it; the profile's density is then an upper bound. apart_in_window: pairs that are two
    in one submap, symmetric; None: not recorded.
    """

    mean: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "m m"]
    apart: Bool[np.ndarray, "n n"]
    density: LandmarkDensity | None = None
    unseen: Float[np.ndarray, " n"] | None = None
    apart_in_window: Bool[np.ndarray, "n n"] | None = None
    classes: Classes | None = None

    def select(self, chosen: Indices) -> "Joint":
        """Return the marginal of some landmarks, in this order."""
        n, k = len(self.mean), 2 * len(chosen)
        blocks = self.covariance.reshape(n, 2, n, 2)[chosen][:, :, chosen]
        square = np.ix_(chosen, chosen)
        return Joint(
            mean=self.mean[chosen],
            covariance=blocks.reshape(k, k),
            apart=self.apart[square],
            density=self.density,
            unseen=None if self.unseen is None else self.unseen[chosen],
            apart_in_window=None if self.apart_in_window is None else self.apart_in_window[square],
            classes=None if self.classes is None else self.classes[chosen],
        )

    def compare_classes(self, first: Indices, second: Indices) -> Float[np.ndarray, " k"]:
        """Compute each pair's log-likelihood ratio by classes; zero without classes."""
        if self.classes is None:
            return np.zeros(len(first))
        return compare_classes(self.classes[first], self.classes[second])


class Pair(NamedTuple):
    """Two landmarks merged into one, the second.

    sd: largest standard deviation [m] of the difference. rival: best LLR of a pair that excludes
    this one.
    """

    first: int
    second: int
    llr: float
    sd: float
    rival: float


class Likelihoods(NamedTuple):
    """χ², log-likelihood ratio and largest standard deviation [m] of each pair's difference."""

    chi2: Float[np.ndarray, " k"]
    llr: Float[np.ndarray, " k"]
    sd: Float[np.ndarray, " k"]


def list_pairs(first: Indices, second: Indices) -> tuple[Indices, Indices]:
    """List every pair of a landmark of the first list with another one of the second."""
    one, two = (each.ravel() for each in np.meshgrid(first, second, indexing="ij"))
    different = one != two
    return one[different], two[different]


def evaluate_pairs(
    joint: Joint, first: Indices, second: Indices, profile: AssociationProfile
) -> Likelihoods:
    """Evaluate the likelihood that each pair is one landmark."""
    n = len(joint.mean)
    P = joint.covariance.reshape(n, 2, n, 2)
    R = P[first, :, first] + P[second, :, second] - P[first, :, second] - P[second, :, first]
    half = 0.5 * (R[:, 0, 0] + R[:, 1, 1])
    spread = core.hypot(0.5 * (R[:, 0, 0] - R[:, 1, 1]), R[:, 0, 1])
    S = R + core.squared(profile.slack) * np.eye(2)
    chi2, determinant = compute_mahalanobis(joint.mean[first] - joint.mean[second], S)
    density = np.full(len(chi2), profile.density)
    if joint.density is not None:
        radius = np.sqrt(profile.gate) * np.sqrt(np.sqrt(determinant))
        observed = joint.density.around_landmarks(radius)
        if joint.unseen is not None:
            observed *= joint.unseen[second]
            density = np.minimum(density, joint.density.of_map(radius))
        density = np.maximum(density, observed)
    llr = -0.5 * chi2 - 0.5 * core.log(determinant) - core.log(2.0 * np.pi * density)
    if joint.classes is not None:
        llr = llr + joint.compare_classes(first, second)
    return Likelihoods(chi2, llr, np.sqrt(np.maximum(half + spread, 0.0)))


def gate_pairs(
    joint: Joint,
    first: Indices,
    second: Indices,
    profile: AssociationProfile,
    most_sd: float = np.inf,
) -> tuple[Indices, Indices, Float[np.ndarray, " k"]]:
    """Select the pairs that can be one landmark; return them with the standard deviation [m]."""
    at = evaluate_pairs(joint, first, second, profile)
    open_ = (at.chi2 < profile.gate) & (at.sd <= most_sd) & ~joint.apart[first, second]
    open_ &= joint.compare_classes(first, second) > -CONTRADICTED
    return first[open_], second[open_], at.sd[open_]


def required_llr(
    joint: Joint,
    first: Indices,
    second: Indices,
    sd: Float[np.ndarray, " k"],
    profile: AssociationProfile,
) -> Float[np.ndarray, " k"]:
    """Return the log-likelihood ratio that a merge needs, plus SPLIT if one submap has both."""
    least = np.where(sd < profile.tight, profile.llr_tight, profile.llr_loose)
    if joint.apart_in_window is not None:
        least = least + SPLIT * joint.apart_in_window[first, second]
    return least
