"""How densely landmarks stand about landmarks, from those that one keyframe saw together.

What one keyframe saw are different landmarks, whatever else is unknown. Their distances give the
density of others within a radius R of a landmark, K(R) / (π R²) (Ripley 1976, J. Appl. Prob. 13),
which is far above the mean density of a map where landmarks stand in groups: a pair that is no
better known than the members of a group stand apart may be either of them. They also bound the
lengths of a profile: two landmarks farther apart than their neighbours are not one that was split.
"""

from collections.abc import Iterable
from functools import cached_property

import msgspec
import numpy as np
from jaxtyping import Float

from team.association import AssociationProfile
from team.estimation.submap import LocalMap

CLOSE = 0.1
"""The spacing that so large a part of the landmarks falls short of is taken for that of groups."""
FEWEST = 10
"""Of fewer landmarks with a neighbour the smallest spacing is taken."""
SAME, TIGHT, SLACK = 1.5, 0.5, 0.18
"""A profile's lengths are so many of these spacings at the most."""


class Crowd:
    """The spacings of the landmarks without names of some submaps."""

    def __init__(self, submaps: Iterable[LocalMap]) -> None:
        each = [local.spacings for local in submaps]
        self.landmarks = sum(len(away) for away in each)
        nearest = np.concatenate(
            [np.zeros(0), *(away.min(axis=1, initial=np.inf) for away in each)]
        )
        self.nearest: Float[np.ndarray, " m"] = np.sort(nearest[np.isfinite(nearest)])
        self._each = each

    @cached_property
    def _distances(self) -> Float[np.ndarray, " n"]:
        found = np.concatenate([np.zeros(0), *(away.ravel() for away in self._each)])
        return np.sort(found[np.isfinite(found)])

    def density(self, radius: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Other landmarks per square metre within each radius [m] of one; what has not been seen is
        taken for half a pair.
        """
        within = np.searchsorted(self._distances, radius) + 1.0
        found: Float[np.ndarray, " k"] = within / (max(self.landmarks, 1) * np.pi * radius**2)
        return found

    def bounded(self, profile: AssociationProfile) -> AssociationProfile:
        """The profile with lengths that tell neighbours apart."""
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
