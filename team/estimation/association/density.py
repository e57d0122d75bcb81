"""Local density λ of landmarks, and the lengths that follow from their spacing.

The distances of landmarks observed in one keyframe, which are distinct, give the density of further
landmarks within R of a landmark, K(R) / (π R²) (Ripley 1976, J. Appl. Prob. 13); in groups it is
far above the map's mean. Neighbours that hide each other in a keyframe are counted among the map's
landmarks of several submaps.
"""

from collections.abc import Iterable
from functools import cached_property

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.association import AssociationProfile
from teamslam.team.shapes import Float

CLOSE = 0.1  # quantile of the landmarks' spacings taken as the spacing within groups
FEWEST = 10  # least landmarks with a neighbour; with fewer the smallest spacing is used
SAME, TIGHT, SLACK = 1.5, 0.5, 0.18
"""Upper bounds of a profile's lengths, in multiples of this spacing."""


Spacings = Float[np.ndarray, "U U"]


class LandmarkDensity:
    """Spacings of the unnamed landmarks of some submaps, and of the map's landmarks.

    spacings: of each submap. confirmed: positions [m] of landmarks of several submaps.
    """

    def __init__(
        self, spacings: Iterable[Spacings], confirmed: Float[np.ndarray, "n 2"] | None = None
    ) -> None:
        each = list(spacings)
        self.landmarks = sum(len(away) for away in each)
        nearest = np.concatenate(
            [np.zeros(0), *(away.min(axis=1, initial=np.inf) for away in each)]
        )
        self.nearest: Float[np.ndarray, " m"] = np.sort(nearest[np.isfinite(nearest)])
        self._each = each
        self.confirmed = np.zeros((0, 2)) if confirmed is None else confirmed

    @cached_property
    def _distances(self) -> Float[np.ndarray, " n"]:
        found = np.concatenate([np.zeros(0), *(away.ravel() for away in self._each)])
        return np.sort(found[np.isfinite(found)])

    def around_landmarks(self, radius: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Compute the density [1/m²] within each radius [m] of a landmark in single keyframes.

        (ordered pairs within R + 1) / (n π R²): half a pair is added to those observed.
        """
        within = np.searchsorted(self._distances, radius) + 1.0
        found: Float[np.ndarray, " k"] = within / (
            max(self.landmarks, 1) * np.pi * core.squared(radius)
        )
        return found

    @cached_property
    def _in_map(self) -> Float[np.ndarray, " p"]:
        one, two = np.triu_indices(len(self.confirmed), 1)
        return np.sort(core.hypot(*(self.confirmed[one] - self.confirmed[two]).T))

    def of_map(self, radius: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Compute the density [1/m²] of the map's n landmarks, (2 pairs + 1) / (n π R²).

        Duplicates count as neighbours, so it is never too small.
        """
        pairs = np.searchsorted(self._in_map, radius, side="right")
        found: Float[np.ndarray, " k"] = (2.0 * pairs + 1.0) / (
            max(len(self.confirmed), 1) * np.pi * core.squared(radius)
        )
        return found

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
