"""Negative evidence: landmarks of one side that the other side viewed without observing them.

The landmarks that one keyframe observed span a polygon inside its convex field of view, in which it
should have observed every landmark.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from teamslam.team import core
from teamslam.team.shapes import Bool, Float, Int64

OVERLOOKED = 0.4
"""Upper bound of the probability that a window which observes a landmark misses one beside it."""
WELL_KNOWN = 4  # submaps from which a landmark reveals the misses of those beside it
LEAST_OVERLOOKED = 0.1
"""Lower bound of the same probability: some landmarks are visible from one side only."""

Views = Int64[np.ndarray, "_ _"]
"""Landmarks that each keyframe observed together; rows are padded with −1."""


def pad_views(views: Iterable[Int64[np.ndarray, " _"]]) -> Views:
    """Arrange lists of landmarks as the rows of one array, padded with −1."""
    each = list(views)
    out = np.full((len(each), max(map(len, each), default=0)), -1)
    for row, view in zip(out, each, strict=True):
        row[: len(view)] = view
    return out


def renumber_views(views: Views, to: Int64[np.ndarray, " n"]) -> Views:
    """Renumber the landmarks of the views; −1 drops a landmark, and views of fewer than three."""
    if not views.size:
        return views
    numbered = np.where(views >= 0, to[views], -1)
    polygons: Views = numbered[(numbered >= 0).sum(axis=1) >= 3]
    return polygons


def mark_visible(
    points: Float[np.ndarray, "n 2"], own: Float[np.ndarray, "m 2"], views: Views
) -> Bool[np.ndarray, " n"]:
    """Mark the points in the convex hull of any one view's landmarks, at their positions `own`.

    In a hull the directions to its points leave no gap of half a turn.
    """
    inside = np.zeros(len(points), np.bool_)
    if not len(points) or not views.size:
        return inside
    at = np.where((views >= 0)[..., None], own[views], np.nan)
    low, high = np.fmin.reduce(at, axis=1), np.fmax.reduce(at, axis=1)
    near = (points[:, None] >= low) & (points[:, None] <= high)
    point, view = np.nonzero(near.all(axis=2))
    if not len(point):
        return inside
    x, y = (at[view] - points[point, None]).transpose(2, 0, 1)
    angle = np.sort(core.atan2(y, x), axis=1)  # NaN, the padding, is last
    last = np.fmax.reduce(angle, axis=1)
    widest = np.fmax.reduce(angle[:, 1:] - angle[:, :-1], axis=1)
    gap = np.fmax(widest, angle[:, 0] + 2.0 * np.pi - last)
    inside[point[gap < np.pi]] = True
    return inside


def miss_probabilities(
    points: Float[np.ndarray, "n 2"], seen_by: Sequence[Int64[np.ndarray, " _"]], radius: float
) -> Float[np.ndarray, " n"]:
    """Compute the probability that all windows with a landmark missed another one beside it.

    seen_by: landmarks of each window. radius [m]: of a place around a landmark.
    """
    x, y = points.T
    near = core.hypot(x[:, None] - x, y[:, None] - y) < radius
    seen = np.zeros((len(seen_by), len(points)), np.float32)
    for row, places in zip(seen, seen_by, strict=True):
        row[places] = 1.0
    counts = (seen @ near.astype(np.float32) > 0.0).sum(axis=0)  # exact: sums of ones
    chance = core.exp(core.log(OVERLOOKED) * np.maximum(counts - 1.0, 0.0))
    return np.asarray(np.maximum(chance, LEAST_OVERLOOKED))


def mark_missed(sees: Bool[np.ndarray, "K n"]) -> Bool[np.ndarray, " n"]:
    """Mark the landmarks that later submaps miss.

    A landmark of n < WELL_KNOWN submaps is missed if each well-known one beside it in its last
    submap is in WELL_KNOWN n submaps since. sees: by submap, in the order of time.
    """
    counts = sees.sum(axis=0)
    beside = sees & (counts >= WELL_KNOWN)
    since = sees[::-1].cumsum(axis=0)[::-1] - sees
    fewest = np.where(beside, since, len(sees)).min(axis=1, initial=len(sees))
    fewest[~beside.any(axis=1)] = 0
    missed = np.zeros(sees.shape[1], np.bool_)
    if len(sees):
        last = len(sees) - 1 - sees[::-1].argmax(axis=0)
        missed = (counts > 0) & (counts < WELL_KNOWN) & (fewest[last] >= WELL_KNOWN * counts)
    return missed
