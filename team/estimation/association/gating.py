"""Evidence that two landmarks of a joint Gaussian are one: positions, classes, local density.

Individual compatibility tests the squared Mahalanobis distance dᵀS⁻¹d of a difference d with
covariance S against χ² of two degrees of freedom (Neira and Tardós 2001, IEEE T-RA 17(6)). The
log-likelihood ratio of "one" against "two", with S plus the slack s₀² and λ expected landmarks per
square metre, is

  LLR = −½ dᵀS⁻¹d − ½ ln|S| − ln 2π − ln λ + evidence of the classes.

The distances of landmarks observed in one keyframe, which are distinct, give the density of further
landmarks within R of a landmark, K(R) / (π R²) (Ripley 1976, J. Appl. Prob. 13); in groups it is
far above the map's mean. Neighbours that hide each other in a keyframe are counted among the map's
landmarks of several submaps.
"""

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.association import AssociationProfile
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.scans import compute_mahalanobis
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Classes = Float[np.ndarray, "_ _"]
"""ln P(reports | class) up to a constant: a row for each landmark, a column for each class."""
CONTRADICTED = 3.0
"""Log-likelihood ratio (1 in 20) against one landmark from which a pair is not associated."""
SPLIT = 1.0
"""Additional log-likelihood ratio for a pair of one window, which seldom splits a landmark."""
CLOSE = 0.1  # quantile of the landmarks' spacings taken as the spacing within groups
FEWEST = 10  # least landmarks with a neighbour; with fewer the smallest spacing is used
SAME, TIGHT, SLACK = 1.5, 0.5, 0.18
"""Upper bounds of a profile's lengths, in multiples of this spacing."""


def compare_classes(one: Classes, two: Classes) -> Float[np.ndarray, " n"]:
    """Compute the log-likelihood ratio of one landmark against two, row by row.

    With p(c) ∝ P(reports | c) for equally frequent classes: ln(C Σ_c p₁(c) p₂(c)).
    """
    p, q = (core.exp(each - each.max(axis=1, keepdims=True)) for each in (one, two))
    common = (p * q).sum(axis=1) / (p.sum(axis=1) * q.sum(axis=1))
    return np.asarray(core.log(common * one.shape[1]))


def stack_classes(parts: Sequence[tuple[int, Classes | None]]) -> Classes | None:
    """Concatenate rows of classes, given with their counts; None if no list has classes.

    A landmark without classes has zeros; an unreported class is as unlikely as the least likely
    one.
    """
    most = max((rows.shape[1] for _, rows in parts if rows is not None), default=0)
    if not most:
        return None
    out = []
    for count, rows in parts:
        if rows is None or not rows.shape[1]:
            out.append(np.zeros((count, most)))
        else:
            least = rows.min(axis=1, keepdims=True)
            out.append(np.hstack((rows, np.repeat(least, most - rows.shape[1], axis=1))))
    return np.concatenate(out)


class LandmarkDensity:
    """Spacings of the unnamed landmarks of some submaps, and of the map's landmarks.

    spacings: of each submap. confirmed: positions [m] of landmarks of several submaps.
    """

    def __init__(
        self,
        spacings: Iterable[Float[np.ndarray, "U U"]],
        confirmed: Float[np.ndarray, "n 2"] | None = None,
    ) -> None:
        each = list(spacings)
        self.landmarks = sum(len(away) for away in each)
        self.nearest = _sort_finite(away.min(axis=1, initial=np.inf) for away in each)
        self._each = each
        self.confirmed = np.zeros((0, 2)) if confirmed is None else confirmed

    @cached_property
    def _distances(self) -> Float[np.ndarray, " n"]:
        return _sort_finite(away.ravel() for away in self._each)

    def around_landmarks(self, radius: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Compute the density [1/m²] within each radius [m] of a landmark in single keyframes.

        (ordered pairs within R + 1) / (n π R²): half a pair is added to those observed.
        """
        within = np.searchsorted(self._distances, radius) + 1.0
        return np.asarray(within / (max(self.landmarks, 1) * np.pi * core.squared(radius)))

    @cached_property
    def _in_map(self) -> Float[np.ndarray, " p"]:
        one, two = np.triu_indices(len(self.confirmed), 1)
        return np.sort(core.hypot(*(self.confirmed[one] - self.confirmed[two]).T))

    def of_map(self, radius: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Compute the density [1/m²] of the map's n landmarks, (2 pairs + 1) / (n π R²).

        Duplicates count as neighbours, so it is never too small.
        """
        within = 2.0 * np.searchsorted(self._in_map, radius, side="right") + 1.0
        return np.asarray(within / (max(len(self.confirmed), 1) * np.pi * core.squared(radius)))

    def limit_lengths(self, profile: AssociationProfile) -> AssociationProfile:
        """Shorten the profile's lengths so that they distinguish neighbours."""
        if not len(self.nearest):
            return profile
        share = CLOSE if len(self.nearest) >= FEWEST else 0.0
        spacing = float(np.quantile(self.nearest, share))
        return msgspec.structs.replace(
            profile,
            same=min(profile.same, SAME * spacing),
            tight=min(profile.tight, TIGHT * spacing),
            slack=min(profile.slack, SLACK * spacing),
        )


def _sort_finite(of: Iterable[Float[np.ndarray, " _"]]) -> Float[np.ndarray, " n"]:
    found = np.concatenate([np.zeros(0), *of])
    return np.sort(found[np.isfinite(found)])


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


class Joint(NamedTuple):
    """Landmarks with their joint covariance, in one frame, and the thresholds of their pairs.

    mean: positions [m]. covariance: of (x₁, y₁, x₂, …) [m²]. apart: pairs that cannot be one
    landmark, symmetric: observed in one scan, named differently, or declared to be two. density:
    local; None: the profile's. unseen: probability that all windows with a landmark missed another
    one beside it; the profile's density is then an upper bound. apart_in_window: pairs that are two
    in one submap, symmetric; None: not recorded.
    """

    mean: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "m m"]
    apart: Bool[np.ndarray, "n n"]
    profile: AssociationProfile
    density: LandmarkDensity | None = None
    unseen: Float[np.ndarray, " n"] | None = None
    apart_in_window: Bool[np.ndarray, "n n"] | None = None
    classes: Classes | None = None

    def select(self, chosen: Indices) -> "Joint":
        """Return the marginal of some landmarks, in this order."""
        n, k = len(self.mean), 2 * len(chosen)
        square = np.ix_(chosen, chosen)
        return self._replace(
            mean=self.mean[chosen],
            covariance=self.covariance.reshape(n, 2, n, 2)[chosen][:, :, chosen].reshape(k, k),
            apart=self.apart[square],
            unseen=None if self.unseen is None else self.unseen[chosen],
            apart_in_window=None if self.apart_in_window is None else self.apart_in_window[square],
            classes=None if self.classes is None else self.classes[chosen],
        )

    def condition(self, first: int, second: int) -> "Joint":
        """Condition on two landmarks being one; the second inherits the first's relations.

        With H the difference of the two and S = HPHᵀ + s₀²I, mean −= PHᵀS⁻¹(Hm), P −= PHᵀS⁻¹HP.
        """
        P = self.covariance
        one, two = slice(2 * first, 2 * first + 2), slice(2 * second, 2 * second + 2)
        gain = P[:, one] - P[:, two]
        S = gain[one] - gain[two] + core.squared(self.profile.slack) * np.eye(2)
        weighted = dense.solve(S, gain.T)
        step = dense.product(weighted.T, self.mean[first] - self.mean[second])
        in_window, classes = self.apart_in_window, self.classes
        if classes is not None:
            classes = classes.copy()
            classes[second] += classes[first]
        return self._replace(
            mean=self.mean - step.reshape(-1, 2),
            covariance=P - dense.product(gain, weighted),
            apart=_inherit(self.apart, first, second),
            apart_in_window=in_window if in_window is None else _inherit(in_window, first, second),
            classes=classes,
        )

    def evaluate(self, first: Indices, second: Indices) -> Likelihoods:
        """Evaluate the likelihood that each pair is one landmark."""
        n, profile = len(self.mean), self.profile
        P = self.covariance.reshape(n, 2, n, 2)
        R = P[first, :, first] + P[second, :, second] - P[first, :, second] - P[second, :, first]
        half = 0.5 * (R[:, 0, 0] + R[:, 1, 1])
        spread = core.hypot(0.5 * (R[:, 0, 0] - R[:, 1, 1]), R[:, 0, 1])
        S = R + core.squared(profile.slack) * np.eye(2)
        chi2, determinant = compute_mahalanobis(self.mean[first] - self.mean[second], S)
        density = np.full(len(chi2), profile.density)
        if self.density is not None:
            radius = np.sqrt(profile.gate) * np.sqrt(np.sqrt(determinant))
            observed = self.density.around_landmarks(radius)
            if self.unseen is not None:
                observed *= self.unseen[second]
                density = np.minimum(density, self.density.of_map(radius))
            density = np.maximum(density, observed)
        llr = -0.5 * chi2 - 0.5 * core.log(determinant) - core.log(2.0 * np.pi * density)
        llr = llr + self._compare_classes(first, second)
        return Likelihoods(chi2, llr, np.sqrt(np.maximum(half + spread, 0.0)))

    def gate(
        self, first: Indices, second: Indices, most_sd: float = np.inf
    ) -> tuple[Indices, Indices, Float[np.ndarray, " k"]]:
        """Select the pairs that can be one landmark; return also their standard deviation [m]."""
        at = self.evaluate(first, second)
        open_ = (at.chi2 < self.profile.gate) & (at.sd <= most_sd) & ~self.apart[first, second]
        open_ &= self._compare_classes(first, second) > -CONTRADICTED
        return first[open_], second[open_], at.sd[open_]

    def required_llr(
        self, first: Indices, second: Indices, sd: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, " k"]:
        """Return the log-likelihood ratio that a merge needs, plus SPLIT if one submap has both."""
        profile = self.profile
        least = np.where(sd < profile.tight, profile.llr_tight, profile.llr_loose)
        if self.apart_in_window is not None:
            least = least + SPLIT * self.apart_in_window[first, second]
        return least

    def _compare_classes(self, first: Indices, second: Indices) -> Float[np.ndarray, " k"]:
        if self.classes is None:
            return np.zeros(len(first))
        return compare_classes(self.classes[first], self.classes[second])


def _inherit(relation: Bool[np.ndarray, "n n"], first: int, second: int) -> Bool[np.ndarray, "n n"]:
    out = relation.copy()
    out[second] = out[:, second] = relation[first] | relation[second]
    return out
