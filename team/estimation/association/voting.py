"""Align two sets of points by their shapes alone, by votes of pairs of points.

Two points of one side at the distance of two points of the other propose a rigid motion (a Hough
transform over SE(2)); nearest neighbours refine motions with many votes. All places are searched,
so that every rival is found.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.gating import (
    CONTRADICTED,
    Classes,
    compare_classes,
    stack_classes,
)
from teamslam.team.shapes import Bool, Float, Int64

MOST_BINS = 60  # most refined motions, those with the most votes
ANGLE_BIN = np.radians(6.0)
"""Width of a bin of rotations [rad]; bins of translations are three tolerances wide."""
REFINEMENTS = 4  # steps of nearest neighbours
MOST_HYPOTHESES = 100_000
"""Most pairs of baselines that vote: the longest, which determine the heading best."""
MOST_OF_PART = 16  # motions of a part that are refined on all points
MOST_COUNTED = 4_000_000  # most cells whose votes are counted cell by cell
WIDER = 1.01
"""Half width of the strip searched for points within reach, in reaches, with a margin for rounding.
"""
MOST_DISTANCES = 2_000_000  # most distances between points in memory at once


class PointSet(NamedTuple):
    """Points of one side [m], with the standard deviation [m] of each relative to its neighbours.

    classes: evidence of their classes; points of contradicting ones do not match.
    """

    mean: Float[np.ndarray, "n 2"]
    sd: Float[np.ndarray, " n"]
    classes: Classes | None = None

    def select(self, part: Int64[np.ndarray, " k"]) -> "PointSet":
        """Select some of the points."""
        return PointSet(
            self.mean[part], self.sd[part], None if self.classes is None else self.classes[part]
        )

    def move(self, by: Float[np.ndarray, "2"]) -> "PointSet":
        """Translate the points."""
        return self._replace(mean=self.mean + by)


class Vote(NamedTuple):
    """The motion b_from_a (x, y, θ) about the centroid of a's points, and the pairs it matches."""

    motion: Float[np.ndarray, "3"]
    first: Int64[np.ndarray, " k"]
    second: Int64[np.ndarray, " k"]


def propose_alignments(
    a: PointSet,
    b: PointSet,
    tolerance: float,
    longest: float,
    parts: Sequence[Int64[np.ndarray, " _"]] = (),
) -> list[Vote]:
    """Propose distinct rigid motions of a onto b, by decreasing number of matched points.

    tolerance: largest distance of matched points [m]. longest: largest distance [m] of two points
    that vote together. parts: subsets of a that also vote by themselves, for a small common place.
    """
    if len(a.mean) < 2 or len(b.mean) < 2:
        return []
    centre = a.mean.mean(axis=0)
    motions = [_propose_motions(a.move(-centre), b, tolerance, longest)]
    for part in parts:
        if not 2 <= len(part) < len(a.mean):
            continue
        own = a.select(part)
        middle = own.mean.mean(axis=0)
        proposed = _propose_motions(own.move(-middle), b, tolerance, longest)
        found = _keep_distinct(_refine(own, b, middle, proposed, tolerance), len(part))[
            :MOST_OF_PART
        ]
        if found:
            moving = np.array([vote.motion for vote in found])
            s, c = core.sin_and_cos(moving[:, 2])
            x, y = centre - middle
            moving[:, :2] += np.column_stack([c * x - s * y, s * x + c * y])
            motions.append(moving)
    return _keep_distinct(_refine(a, b, centre, np.concatenate(motions), tolerance), len(a.mean))


def _keep_distinct(found: list[Vote], points: int) -> list[Vote]:
    found.sort(key=lambda vote: (-len(vote.first), *vote.motion.tolist()))
    distinct: list[Vote] = []
    paired = np.full((len(found), points), -1)
    for vote in found:
        same = (paired[: len(distinct), vote.first] == vote.second).sum(axis=1)
        if (2 * same < len(vote.first)).all():
            paired[len(distinct), vote.first] = vote.second
            distinct.append(vote)
    return distinct


def _compatible(a: PointSet, b: PointSet) -> Bool[np.ndarray, "n m"] | None:
    if a.classes is None or b.classes is None:
        return None
    n, m = len(a.mean), len(b.mean)
    both = stack_classes([(n, a.classes), (m, b.classes)])
    assert both is not None
    one, two = np.repeat(both[:n], m, axis=0), np.tile(both[n:], (n, 1))
    return np.asarray(compare_classes(one, two).reshape(n, m) > -CONTRADICTED)


def _propose_motions(
    one_side: PointSet, other_side: PointSet, tolerance: float, longest: float
) -> Float[np.ndarray, "_ 3"]:
    a, b, fits = one_side.mean, other_side.mean, _compatible(one_side, other_side)
    shortest = 4.0 * tolerance
    i, j, length_a = _list_baselines(a, shortest, longest)
    k, last, length_b = _list_baselines(b, shortest - 2.0 * tolerance, longest + 2.0 * tolerance)
    order = np.argsort(length_b, kind="stable")
    k, last, length_b = k[order], last[order], length_b[order]
    begin = np.searchsorted(length_b, length_a - 1.4 * tolerance)
    count = np.searchsorted(length_b, length_a + 1.4 * tolerance) - begin
    if count.sum() > MOST_HYPOTHESES:
        keep = np.argsort(-length_a, kind="stable")
        keep = keep[np.cumsum(count[keep]) <= MOST_HYPOTHESES]
        i, j, begin, count = i[keep], j[keep], begin[keep], count[keep]
    of_a = np.repeat(np.arange(len(i)), count)
    of_b = np.repeat(begin - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
    of_b = of_b + np.arange(len(of_a))
    one, two = a[i[of_a]], a[j[of_a]]
    span = two - one
    heading = core.atan2(span[:, 1], span[:, 0])
    motions = []
    for p, q in ((k[of_b], last[of_b]), (last[of_b], k[of_b])):
        across = b[q] - b[p]
        turn = core.atan2(across[:, 1], across[:, 0]) - heading
        s, c = core.sin_and_cos(turn)
        middle = 0.5 * (one + two)
        rotated = np.column_stack(
            [c * middle[:, 0] - s * middle[:, 1], s * middle[:, 0] + c * middle[:, 1]]
        )
        proposed = np.column_stack([0.5 * (b[p] + b[q]) - rotated, turn])
        if fits is not None:
            proposed = proposed[fits[i[of_a], p] & fits[j[of_a], q]]
        motions.append(proposed)
    return np.array(_find_peaks(np.concatenate(motions), 3.0 * tolerance)).reshape(-1, 3)


def _list_baselines(
    points: Float[np.ndarray, "n 2"], shortest: float, longest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    i, j = np.triu_indices(len(points), 1)
    length = core.hypot(*(points[i] - points[j]).T)
    chosen = (length >= shortest) & (length <= longest)
    return i[chosen], j[chosen], length[chosen]


def _find_peaks(motions: Float[np.ndarray, "v 3"], cell: float) -> list[Float[np.ndarray, "3"]]:
    peaks = []
    turns = round(2.0 * np.pi / ANGLE_BIN)
    for shift in (0.0, 0.5):
        cells = np.floor(motions[:, :2] / cell + shift).astype(np.int64)
        angle = np.floor(motions[:, 2] / ANGLE_BIN + shift).astype(np.int64) % turns
        low = cells.min(axis=0, initial=0)
        size = cells.max(axis=0, initial=0) - low + 1
        code = ((cells[:, 0] - low[0]) * size[1] + cells[:, 1] - low[1]) * turns + angle
        of, counts = _rank_codes(code, int(size[0] * size[1]) * turns)
        fullest = np.argsort(-counts, kind="stable")[:MOST_BINS]
        rank = np.full(len(counts), -1)
        rank[fullest] = np.arange(len(fullest))
        inside = rank[of] >= 0
        at, some = rank[of[inside]], motions[inside]
        weight = np.bincount(at, minlength=len(fullest))
        x = np.bincount(at, some[:, 0], len(fullest)) / weight
        y = np.bincount(at, some[:, 1], len(fullest)) / weight
        cosine: Float[np.ndarray, " n"] = np.bincount(at, core.cos(some[:, 2]), len(fullest))
        sine: Float[np.ndarray, " n"] = np.bincount(at, core.sin(some[:, 2]), len(fullest))
        peaks += list(np.column_stack([x, y, core.atan2(sine, cosine)]))
    return peaks


def _rank_codes(
    codes: Int64[np.ndarray, " v"], beyond: int
) -> tuple[Int64[np.ndarray, " v"], Int64[np.ndarray, " _"]]:
    if beyond > MOST_COUNTED:
        _, of, counts = np.unique(codes, return_inverse=True, return_counts=True)
        return of, counts
    counts = np.bincount(codes, minlength=1)
    rank = np.cumsum(counts > 0) - 1
    return rank[codes], counts[counts > 0]


def _refine(
    a: PointSet,
    b: PointSet,
    centre: Float[np.ndarray, "2"],
    motions: Float[np.ndarray, "B 3"],
    tolerance: float,
) -> list[Vote]:
    local, fits = a.mean - centre, _compatible(a, b)
    size = max(1, MOST_DISTANCES // (len(a.mean) * len(b.mean)))
    votes = []
    for k in range(0, len(motions), size):
        batch = motions[k : k + size]
        for step in range(REFINEMENTS):
            reach = tolerance * (1.5 if step < 2 else 1.0)
            to, agree = _find_neighbours(batch, local, b.mean, reach, fits)
            lasting = agree.sum(axis=1) >= 2
            batch, to, agree = batch[lasting], to[lasting], agree[lasting]
            if step < REFINEMENTS - 1 and len(batch):
                weights = agree / (
                    core.squared(a.sd) + core.squared(b.sd[to]) + core.squared(tolerance)
                )
                batch = _fit_motions(local, b.mean[to], weights)
        votes += [
            Vote(motion, np.flatnonzero(own), of[own])
            for motion, of, own in zip(batch, to, agree, strict=True)
        ]
    return votes


def _find_neighbours(
    motions: Float[np.ndarray, "B 3"],
    a: Float[np.ndarray, "n 2"],
    b: Float[np.ndarray, "m 2"],
    reach: float,
    fits: Bool[np.ndarray, "n m"] | None,
) -> tuple[Int64[np.ndarray, "B n"], Bool[np.ndarray, "B n"]]:
    """Find the nearest point of b within reach of each point, else 0; mark mutually nearest ones.

    fits: pairs of compatible classes; None: all.
    """
    n, m = len(a), len(b)
    s, c = core.sin_and_cos(motions[:, 2:])
    x = (c * a[:, 0] - s * a[:, 1] + motions[:, :1]).ravel()
    y = (s * a[:, 0] + c * a[:, 1] + motions[:, 1:2]).ravel()
    order = np.argsort(b[:, 0], kind="stable")
    begin = np.searchsorted(b[order, 0], x - WIDER * reach)
    count = np.searchsorted(b[order, 0], x + WIDER * reach) - begin
    point = np.repeat(np.arange(len(x)), count)
    to = order[np.arange(len(point)) - np.repeat(np.cumsum(count) - count - begin, count)]
    away = core.squared(x[point] - b[to, 0]) + core.squared(y[point] - b[to, 1])
    near = away < core.squared(reach)
    if fits is not None:
        near &= fits[point % n, to]
    point, to, away = point[near], to[near], away[near]
    target = point // n * m + to
    to_b, to_a = np.zeros(len(x), np.int64), np.zeros(len(motions) * m, np.int64)
    mutual = np.zeros(len(x), np.bool_)
    for group, other, nearest in ((point, to, to_b), (target, point, to_a)):
        ranked = np.lexsort((other, away, group))
        first = ranked[np.diff(group[ranked], prepend=-1) > 0]
        nearest[group[first]] = other[first]
    mutual[point] = to_a[point // n * m + to_b[point]] == point
    return to_b.reshape(-1, n), mutual.reshape(-1, n)


def _fit_motions(
    a: Float[np.ndarray, "n 2"],
    to: Float[np.ndarray, "B n 2"],
    weights: Float[np.ndarray, "B n"],
) -> Float[np.ndarray, "B 3"]:
    """Minimise Σ w ‖to − R(θ) a − (x, y)‖² over (x, y, θ), for each of B sets of weights."""
    share = weights / weights.sum(axis=1, keepdims=True)
    from_, onto = dense.product(share, a), (share[:, :, None] * to).sum(axis=1)
    p, q = a - from_[:, None], to - onto[:, None]
    along = (share[:, :, None] * p * q).sum(axis=(1, 2))
    across = (share * (p[:, :, 0] * q[:, :, 1] - p[:, :, 1] * q[:, :, 0])).sum(axis=1)
    angle = core.atan2(across, along)
    s, c = core.sin_and_cos(angle)
    x = onto[:, 0] - c * from_[:, 0] + s * from_[:, 1]
    y = onto[:, 1] - s * from_[:, 0] - c * from_[:, 1]
    return np.column_stack([x, y, angle])


def apply_motion(
    motion: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Map points, given about the centroid, into the other side's frame."""
    s, c = core.sin_and_cos(motion[2])
    placed: Float[np.ndarray, "n 2"] = (
        dense.product(points, np.array([[c, s], [-s, c]])) + motion[:2]
    )
    return placed
