"""Where one set of points may lie on another, from their shapes alone: pairs of points vote.

Two points of one side at the distance of two points of the other propose a rigid motion; motions
that many pairs propose are refined by the nearest neighbours. No place is left out: an alignment
that is not looked for is a rival that is not seen.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.map_joining.alignment import procrustes

MOST_BINS = 40
"""So many of the motions with the most votes are refined."""
ANGLE_BIN = np.radians(6.0)
REFINEMENTS = 4
MOST_HYPOTHESES = 100_000


class Points(NamedTuple):
    """Points of one side [m], and each one's standard deviation beside its neighbours [m]."""

    mean: Float[np.ndarray, "n 2"]
    sd: Float[np.ndarray, " n"]


class Vote(NamedTuple):
    """b_from_a (x, y, θ) about the centroid of the a, and the pairs of points that it makes one."""

    motion: Float[np.ndarray, "3"]
    first: Int64[np.ndarray, " k"]
    second: Int64[np.ndarray, " k"]


def voted(a: Points, b: Points, tolerance: float, longest: float) -> list[Vote]:
    """Distinct rigid motions of a onto b by falling number of matched points.

    tolerance: how far matched points may lie apart [m]. longest: pairs of points that are farther
    apart do not vote [m], since maps are not rigid over any distance.
    """
    if len(a.mean) < 2 or len(b.mean) < 2:
        return []
    centre = a.mean.mean(axis=0)
    found = [
        _refined(a, b, centre, motion, tolerance)
        for motion in _proposed(a.mean - centre, b.mean, tolerance, longest)
    ]
    found.sort(key=lambda vote: (-len(vote.first), *vote.motion.tolist()))
    distinct: list[Vote] = []
    paired: list[Int64[np.ndarray, " n"]] = []
    for vote in found:
        if len(vote.first) >= 2 and not any(_is_variant(vote, other) for other in paired):
            distinct.append(vote)
            paired.append(np.full(len(a.mean), -1))
            paired[-1][vote.first] = vote.second
    return distinct


def _proposed(
    a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "m 2"], tolerance: float, longest: float
) -> list[Float[np.ndarray, "3"]]:
    """The motions (of a's origin, its centroid) in the bins with the most votes."""
    shortest = 4.0 * tolerance
    i, j, length_a = _baselines(a, shortest, longest)
    k, last, length_b = _baselines(b, shortest - 2.0 * tolerance, longest + 2.0 * tolerance)
    order = np.argsort(length_b, kind="stable")
    k, last, length_b = k[order], last[order], length_b[order]
    begin = np.searchsorted(length_b, length_a - 1.4 * tolerance)
    count = np.searchsorted(length_b, length_a + 1.4 * tolerance) - begin
    if count.sum() > MOST_HYPOTHESES:  # the longest baselines tell most of the heading
        keep = np.argsort(-length_a, kind="stable")
        keep = keep[np.cumsum(count[keep]) <= MOST_HYPOTHESES]
        i, j, begin, count = i[keep], j[keep], begin[keep], count[keep]
    of_a = np.repeat(np.arange(len(i)), count)
    of_b = np.repeat(begin - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
    of_b = of_b + np.arange(len(of_a))
    one, two = a[i[of_a]], a[j[of_a]]
    span = two - one
    heading = np.arctan2(span[:, 1], span[:, 0])
    motions = []
    for p, q in ((k[of_b], last[of_b]), (last[of_b], k[of_b])):
        across = b[q] - b[p]
        turn = np.arctan2(across[:, 1], across[:, 0]) - heading
        c, s = np.cos(turn), np.sin(turn)
        middle = 0.5 * (one + two)
        moved = np.column_stack(
            [c * middle[:, 0] - s * middle[:, 1], s * middle[:, 0] + c * middle[:, 1]]
        )
        motions.append(np.column_stack([0.5 * (b[p] + b[q]) - moved, turn]))
    return _peaks(np.concatenate(motions), 3.0 * tolerance)


def _baselines(
    points: Float[np.ndarray, "n 2"], shortest: float, longest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of points with these distances, and their distances."""
    i, j = np.triu_indices(len(points), 1)
    length = np.hypot(*(points[i] - points[j]).T)
    kept = (length >= shortest) & (length <= longest)
    return i[kept], j[kept], length[kept]


def _peaks(motions: Float[np.ndarray, "v 3"], cell: float) -> list[Float[np.ndarray, "3"]]:
    """The mean motion of each of the fullest cells, in two grids that lie half a cell apart."""
    peaks = []
    turns = round(2.0 * np.pi / ANGLE_BIN)
    for shift in (0.0, 0.5):
        cells = np.floor(motions[:, :2] / cell + shift).astype(np.int64)
        angle = np.floor(motions[:, 2] / ANGLE_BIN + shift).astype(np.int64) % turns
        low = cells.min(axis=0, initial=0)
        size = cells.max(axis=0, initial=0) - low + 1
        code = ((cells[:, 0] - low[0]) * size[1] + cells[:, 1] - low[1]) * turns + angle
        values, of, counts = np.unique(code, return_inverse=True, return_counts=True)
        fullest = np.argsort(-counts, kind="stable")[:MOST_BINS]
        rank = np.full(len(values), -1)
        rank[fullest] = np.arange(len(fullest))
        inside = rank[of] >= 0
        at, some = rank[of[inside]], motions[inside]
        weight = np.bincount(at, minlength=len(fullest))
        x = np.bincount(at, some[:, 0], len(fullest)) / weight
        y = np.bincount(at, some[:, 1], len(fullest)) / weight
        cosine = np.bincount(at, np.cos(some[:, 2]), len(fullest))
        sine = np.bincount(at, np.sin(some[:, 2]), len(fullest))
        peaks += list(np.column_stack([x, y, np.arctan2(sine, cosine)]))
    return peaks


def _refined(
    a: Points,
    b: Points,
    centre: Float[np.ndarray, "2"],
    motion: Float[np.ndarray, "3"],
    tolerance: float,
) -> Vote:
    """The motion that the nearest neighbours agree on, with a tolerance that narrows to its own."""
    local = a.mean - centre
    first = second = np.zeros(0, np.int64)
    for step in range(REFINEMENTS):
        first, second = _neighbours(
            moved(motion, local), b.mean, tolerance * (1.5 if step < 2 else 1.0)
        )
        if len(first) < 2:
            break
        if step < REFINEMENTS - 1:
            weights = 1.0 / (a.sd[first] ** 2 + b.sd[second] ** 2 + tolerance**2)
            motion = procrustes(b.mean[second], local[first], weights)
    return Vote(motion, first, second)


def moved(
    motion: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Points about the centroid, in the other side's frame."""
    c, s = np.cos(motion[2]), np.sin(motion[2])
    placed: Float[np.ndarray, "n 2"] = points @ np.array([[c, s], [-s, c]]) + motion[:2]
    return placed


def _neighbours(
    a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "m 2"], tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points that are each other's nearest neighbours, within the tolerance."""
    away = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    to_b, to_a = away.argmin(axis=1), away.argmin(axis=0)
    index = np.arange(len(a))
    mutual = (to_a[to_b] == index) & (away[index, to_b] < tolerance)
    return index[mutual], to_b[mutual]


def _is_variant(vote: Vote, other: Int64[np.ndarray, " n"]) -> bool:
    """Whether most of its pairs are those of another alignment: then it is no rival of it.

    other: of each point the one that the other alignment pairs it with, or −1.
    """
    return bool(2 * np.count_nonzero(other[vote.first] == vote.second) >= len(vote.first))
