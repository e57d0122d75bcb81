"""The share of the landmarks near a matched place that are matched."""

import numpy as np
from jaxtyping import Float

from team.association import AssociationProfile
from team.estimation import elementwise

WIDE = 3.0
"""Radius around a closure's places that an audit considers, in spacings."""


def matched_share(
    one: Float[np.ndarray, "n 2"],
    two: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "k 2"],
    pairs: int,
    profile: AssociationProfile,
) -> float:
    """Number of pairs over the number of points near the matched places, of the side with fewer.

    A point is near if it is no farther from a matched place than the median distance between
    neighbouring places.
    """
    if len(places) < 2:
        return 0.0
    radius = 0.5 * spacing(places, profile)
    counts = [int((distance(side, places) <= radius).sum()) for side in (one, two)]
    return pairs / max(min(counts), 1)


def overlap_share(
    one: Float[np.ndarray, "n 2"],
    two: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "k 2"],
    profile: AssociationProfile,
) -> float:
    """Matched places over the number of points of the side with fewer, where both sides know the
    area.

    one, two: all points of either side, the matched ones among them. The area is within WIDE
        spacings of a matched place and within one spacing of a point of the other side: where two
        robots have been at different places their maps differ in extent.
    """
    if len(places) < 2 or not len(one) or not len(two):
        return 0.0
    radius = spacing(places, profile)
    counts = [
        int(((distance(a, places) <= WIDE * radius) & (distance(a, b) <= radius)).sum())
        for a, b in ((one, two), (two, one))
    ]
    return len(places) / max(min(counts), 1)


def spacing(places: Float[np.ndarray, "k 2"], profile: AssociationProfile) -> float:
    """Twice the median distance [m] between neighbouring places, and at least twice `same`."""
    away = elementwise.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    return max(2.0 * float(np.median(away.min(axis=0))), 2.0 * profile.same)


def distance(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " n"]:
    """Distance [m] from each point to the nearest one of `others`."""
    away: Float[np.ndarray, " n"] = elementwise.hypot(
        *(points[:, None] - others[None]).transpose(2, 0, 1)
    ).min(axis=1)
    return away
