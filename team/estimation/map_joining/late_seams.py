"""Seams shown by later submaps: landmarks that one side of a place should have observed.

Among few landmarks a robot that is carried off loses sight of nothing at once (`continuity`), but
later misses the landmarks of places that it passes and maps others. The log-likelihood ratio of a
stream elsewhere from a submap on, against one at its place, is

  Σ min(Σ_s −ln(1 − p(d_ls)), −ln LEAST_OVERLOOKED) − PRESENT · (landmarks of both sides)

over the landmarks l of one side and the submaps s of the other, unless another landmark of that
side is within the gate. p(d), the probability that a submap of the robot observes a landmark at
distance d, is estimated from all its submaps and landmarks and averaged over the uncertainty of d.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.gating import Joint, list_pairs
from teamslam.team.estimation.association.visibility import LEAST_OVERLOOKED
from teamslam.team.estimation.contribution import Stream, is_map
from teamslam.team.estimation.map_joining.absence import distances, learn_rate, path_of
from teamslam.team.estimation.map_joining.continuity import LEAST_BEFORE, PRESENT, Seam
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.submap_graph import Joined
from teamslam.team.shapes import Bool, Float, Int64

MOST_ABSENT = -core.log(LEAST_OVERLOOKED)
"""Most evidence of one landmark, which may be visible from one side only."""
LATE_EVIDENCE = 3.0 * MOST_ABSENT  # least evidence of a seam: three landmarks missed beyond doubt
AMBIGUOUS = 1.0  # difference of evidence below which neighbouring seams are one
LEAST_COUNT = 4  # least measurements of a landmark: fewer may be clutter
MOST_TRACKED = 1  # most landmarks that a robot observes on both sides of a seam, by chance
MOST_COMMON = 2
"""Most landmarks on both sides of a seam, by chance: three place a stream. More than these must be
new after it, and each side must miss one beyond doubt: a narrow camera misses many but maps none
twice.
"""
NODES = ((0.0, 2.0 / 3.0), (math.sqrt(3.0), 1.0 / 6.0), (-math.sqrt(3.0), 1.0 / 6.0))
"""Nodes and weights of the Gauss-Hermite rule of three points."""


class _Place(NamedTuple):
    """A candidate: rows of the submaps before and after a seam in a stream, and its evidence."""

    before: int
    after: int
    evidence: float


@dataclass(frozen=True, eq=False)
class _Sights:
    """Observations of n unnamed landmarks, by node, in K submaps.

    stable: landmarks of LEAST_COUNT or more measurements. away: distance [m] of each from each
    submap's path. misses: −ln P(the submap misses the landmark). possible: pairs of landmarks that
    may be one.
    """

    submaps: list[Joined]
    nodes: Int64[np.ndarray, " n"]
    points: Float[np.ndarray, "n 2"]
    sees: Bool[np.ndarray, "K n"]
    stable: Bool[np.ndarray, " n"]
    away: Float[np.ndarray, "K n"]
    misses: Float[np.ndarray, "K n"]
    possible: Bool[np.ndarray, "n n"]

    def rows_of(self, stream: Stream) -> list[int]:
        """List the rows of a stream's submaps."""
        return [k for k, each in enumerate(self.submaps) if each.contribution.stream == stream]

    def with_misses(self, spread: Float[np.ndarray, "K n"]) -> "_Sights":
        """Compute `misses` with standard deviations [m] of the distances."""
        misses = np.zeros(self.away.shape)
        robots = np.array([each.contribution.robot for each in self.submaps])
        for robot in sorted({*robots.tolist()}):
            own = robots == robot
            away, seen = self.away[np.ix_(own, self.stable)], self.sees[np.ix_(own, self.stable)]
            if seen.any():
                rate = learn_rate(away.ravel(), seen.ravel(), unseen=1.0)
                far = self.away[own], spread[own]
                p = sum(weight * rate.at(np.abs(far[0] + z * far[1])) for z, weight in NODES)
                misses[own] = -core.log(np.maximum(1.0 - p, LEAST_OVERLOOKED))
        return replace(self, misses=misses)


def find_late_seam(island: Island) -> Seam | None:
    """Find the seam with the most evidence, at least LATE_EVIDENCE, among unnamed landmarks."""
    sights = _sights_of(island)
    if not len(sights.nodes) or not _best_places(sights):
        return None
    places = _best_places(_with_uncertainty(island, sights))
    if not places:
        return None
    stream = sights.submaps[places[0].before].contribution.stream
    rows, after = sights.rows_of(stream), max(each.after for each in places)
    first, previous, last = (
        sights.submaps[row].contribution
        for row in (min(each.before for each in places), rows[rows.index(after) - 1], after)
    )
    evidence = max(each.evidence for each in places)
    return Seam(stream, first.sequence, last.sequence, first.end_ns, previous.end_ns, evidence)


def _sights_of(island: Island) -> _Sights:
    graph = island.graph
    submaps = [each for each in graph.submaps if not is_map(each.contribution.stream)]
    nodes = np.array(
        sorted(node for id_, node in graph.landmarks.items() if id_ >= UNNAMED), np.int64
    )
    n = len(nodes)
    place = np.full(len(graph.fixed) + 1, -1, np.int64)
    place[nodes] = np.arange(n)
    sees = np.zeros((len(submaps), n), np.bool_)
    counts = np.zeros(n, np.int64)
    for row, each in zip(sees, submaps, strict=True):
        local = each.contribution.local
        own = place[each.landmarks[local.ids >= UNNAMED]]
        row[own[own >= 0]] = True
        np.add.at(counts, own[own >= 0], local.unnamed.counts[own >= 0].astype(np.int64))
    points = island.points(nodes)
    paths = [distances(path_of(island, each), points) for each in submaps]
    away = np.array(paths).reshape(sees.shape)
    nothing = np.zeros((n, n), np.bool_)
    stable = counts >= LEAST_COUNT
    sights = _Sights(submaps, nodes, points, sees, stable, away, np.zeros_like(away), nothing)
    return sights.with_misses(np.zeros_like(away))


def _with_uncertainty(island: Island, sights: _Sights) -> _Sights:
    """Weigh the misses by the standard deviation of the distances of landmarks from the submaps'
    nearer ends, and find the landmarks that may be one.
    """
    graph, points, n = island.graph, sights.points, len(sights.nodes)
    ends = np.array([each.nodes[:2] for each in sights.submaps])
    union = np.union1d(sights.nodes, ends)
    _, covariance = joint_marginal(island, union.tolist())
    first = np.concatenate([[0], np.cumsum(np.diff(graph.offset)[union])])
    at = np.add.outer(first[np.searchsorted(union, sights.nodes)], np.arange(2))
    own = covariance[np.ix_(at.ravel(), at.ravel())]
    pairs = list_pairs(np.arange(n), np.arange(n))
    profile = island.settings.association
    joint = Joint(points, own, np.zeros((n, n), np.bool_), profile)
    possible = np.eye(n, dtype=np.bool_)
    possible[pairs] = joint.evaluate(*pairs).chi2 < profile.gate
    spread = np.zeros(sights.away.shape)
    blocks = dense.diagonal_blocks(own)
    for row, pair in zip(spread, ends, strict=True):
        offsets = points[:, None] - island.points(pair)
        nearer = (offsets * offsets).sum(axis=2).argmin(axis=1)
        end = np.add.outer(first[np.searchsorted(union, pair)], np.arange(2))[nearer]
        away = offsets[np.arange(n), nearer]
        along = away / np.maximum(core.hypot(away[:, 0], away[:, 1]), 1e-9)[:, None]
        cross = covariance[at[:, :, None], end[:, None, :]]
        of_end = covariance[end[:, :, None], end[:, None, :]]
        difference = blocks + of_end - cross - cross.transpose(0, 2, 1)
        variance = np.einsum("ni,nij,nj->n", along, difference, along)
        row[:] = np.sqrt(np.maximum(variance, 0.0))
    return replace(sights.with_misses(spread), possible=possible)


def _best_places(sights: _Sights) -> list[_Place]:
    """Find the place with the most evidence of any stream, at least LATE_EVIDENCE, with its
    neighbours of about the same evidence; empty if there is none.
    """
    streams = sorted({each.contribution.stream for each in sights.submaps})
    found = [list(_list_places(sights, stream)) for stream in streams]
    places = max(found, key=_most_evidence, default=[])
    most = _most_evidence(places)
    if most < LATE_EVIDENCE:
        return []
    best = [each.evidence for each in places].index(most)
    low = high = best
    while low > 0 and places[low - 1].evidence >= most - AMBIGUOUS:
        low -= 1
    while high + 1 < len(places) and places[high + 1].evidence >= most - AMBIGUOUS:
        high += 1
    return places[low : high + 1]


def _most_evidence(places: Sequence[_Place]) -> float:
    return max((each.evidence for each in places), default=0.0)


def _list_places(sights: _Sights, stream: Stream) -> Iterator[_Place]:
    rows = sights.rows_of(stream)
    for k in range(LEAST_BEFORE, len(rows)):
        before, row = rows[k - 1], rows[k]
        for after in (k, k + 1):
            tracked = (
                int((sights.sees[before] & sights.sees[row]).sum())
                if after == k
                else _least_tracked(sights.submaps[row])
            )
            if after == len(rows) or tracked > MOST_TRACKED:
                continue
            sides, common, fresh = _weigh_place(sights, rows, (k, after))
            if common > MOST_COMMON or fresh <= common or min(sides) < MOST_ABSENT:
                continue
            yield _Place(before, rows[after], sum(sides) - PRESENT * float(common))


def weigh_places(island: Island, places: Sequence[tuple[Stream, int]]) -> list[float]:
    """Compute the evidence for places (stream, sequence) that no landmark spans."""
    if not places:
        return []
    sights, found = _with_uncertainty(island, _sights_of(island)), []
    for stream, first in places:
        rows = sights.rows_of(stream)
        k = [sights.submaps[row].contribution.sequence for row in rows].index(first)
        found.append(sum(_weigh_place(sights, rows, (k, k))[0]))
    return found


def _weigh_place(
    sights: _Sights, rows: list[int], place: tuple[int, int]
) -> tuple[list[float], int, int]:
    """Return the evidence of each side of a place (k, after), the number of common landmarks, and
    of those of the submaps `rows[after:]` alone; rows[k:after] is on neither side.
    """
    behind = np.zeros(len(sights.submaps), np.bool_)
    behind[rows[place[1] :]] = True
    ahead = ~behind
    ahead[rows[slice(*place)]] = False
    one, two = sights.sees[ahead].any(axis=0), sights.sees[behind].any(axis=0)
    sides: list[float] = []
    fresh = 0
    for own, other, by in ((one, two, behind), (two, one, ahead)):
        alone = own & ~other & sights.stable & ~sights.possible[:, other].any(axis=1)
        missed = np.minimum(sights.misses[np.ix_(by, alone)].sum(axis=0), MOST_ABSENT)
        sides.append(float(missed.sum()))
        fresh = int(alone.sum())
    return sides, int((one & two).sum()), fresh


def _least_tracked(submap: Joined) -> int:
    seen = submap.contribution.local.unnamed.seen
    before = np.logical_or.accumulate(seen, axis=1)[:, :-1]
    after = np.logical_or.accumulate(seen[:, ::-1], axis=1)[:, ::-1][:, 1:]
    return int((before & after).sum(axis=0).min(initial=len(seen)))
