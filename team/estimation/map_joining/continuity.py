"""Seams: places where a robot's view changes at once although its odometry measures no motion.

The log-likelihood ratio of a robot that was carried off or slipped against one that overlooks
landmarks is

  ABSENT · (landmarks absent on the other side) − PRESENT · (landmarks that may be there).

The view of a side is the sector of its landmarks, to the greatest distance of both sides. A seam
inside a submap spoils it. For landmarks with identities see `central.diagnosis`.
"""

import math
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.gating import Joint, list_pairs
from teamslam.team.estimation.contribution import Stream, first_of
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.submap_graph import Joined
from teamslam.team.shapes import Bool, Float, Int64

SCANS = 3  # scans with detections on a side
LEAST_SCANS = 2 * SCANS  # least scans of a submap, so that the last ones are beside its end
LEAST_COUNT = 2  # least measurements of a landmark: single ones may be clutter
ABSENT, PRESENT = 1.5, 2.0
"""−ln P(overlooked), and ln of P(seen) over P(another landmark is within the gate)."""
EVIDENCE = 6.0  # least evidence of a seam: four absent landmarks
LEAST_BEFORE = 2  # least submaps of a stream or part before a seam
AROUND = math.pi
"""Gap between the directions of neighbouring landmarks above which a view does not close round."""

Indices = Int64[np.ndarray, " _"]


class Seam(NamedTuple):
    """A place at which a stream is cut.

    before, after: last submap before and first after it; one between is spoilt. begin_ns, end_ns:
    end of the former, beginning of the latter.
    """

    stream: Stream
    before: int
    after: int
    begin_ns: int
    end_ns: int
    evidence: float


def find_seam(island: Island, stream: Stream, sequence: int) -> Seam | None:
    """Find a seam of at least EVIDENCE before a submap of a stream, or inside it.

    Returns None with fewer than LEAST_BEFORE submaps before it.
    """
    if sequence - first_of(stream) < LEAST_BEFORE:
        return None
    pair = [
        each
        for each in island.graph.submaps
        if each.contribution.stream == stream
        and sequence - 1 <= each.contribution.sequence <= sequence
    ]
    if len(pair) < 2 or min(map(_count_scans, pair)) < LEAST_SCANS:
        return None
    one, two = pair
    begin_ns, end_ns = one.contribution.end_ns, two.contribution.end_ns
    sides = (
        _Side.of(one, slice(-SCANS, None), slice(None)),
        _Side.of(two, slice(SCANS), slice(None)),
    )
    evidence = _compare_sides(island, *sides, _place(island, two, 0.0))
    if evidence >= EVIDENCE:
        return Seam(stream, sequence - 1, sequence, begin_ns, begin_ns, evidence)
    evidence = _compare_inside(island, two)
    if evidence >= EVIDENCE:
        return Seam(stream, sequence - 1, sequence + 1, begin_ns, end_ns, evidence)
    return None


def _compare_inside(island: Island, submap: Joined) -> float:
    scans = _count_scans(submap)
    found = [0.0]
    for k in range(SCANS, scans - SCANS + 1):
        before = _Side.of(submap, slice(k - SCANS, k), slice(k))
        after = _Side.of(submap, slice(k, k + SCANS), slice(k, None))
        found.append(_compare_sides(island, before, after, _place(island, submap, k / scans)))
    return max(found)


def _count_scans(submap: Joined) -> int:
    return int(submap.contribution.local.unnamed.seen.shape[1])


class _Side(NamedTuple):
    """Nodes of the landmarks beside a place, and in all scans of that side."""

    beside: Indices
    all: Indices

    @classmethod
    def of(cls, submap: Joined, beside: slice, of_side: slice) -> "_Side":
        return cls(_seen(submap, beside), _seen(submap, of_side))


def _seen(submap: Joined, scans: slice) -> Indices:
    local = submap.contribution.local
    unnamed = local.unnamed
    seen = unnamed.seen[:, scans].any(axis=1) & (unnamed.counts >= LEAST_COUNT)
    nodes = submap.landmarks[local.ids >= UNNAMED][seen]
    return np.unique(nodes[nodes >= 0])


def _place(island: Island, submap: Joined, share: float) -> Float[np.ndarray, "2"]:
    start, end = island.points(submap.nodes[:2])
    return np.asarray((1.0 - share) * start + share * end)


def _compare_sides(
    island: Island, before: _Side, after: _Side, place: Float[np.ndarray, "2"]
) -> float:
    """Compute the evidence between two sides; 0 with two or more common landmarks."""
    one, two = before.beside, after.beside
    if not len(one) or not len(two) or len(np.intersect1d(before.all, after.all)) > 1:
        return 0.0
    nodes = np.union1d(one, two)
    a, b = np.searchsorted(nodes, one), np.searchsorted(nodes, two)
    points, possible = _mark_possible(island, nodes, a, b)
    reach = float(core.hypot(*(points - place).T).max())
    absent = present = 0
    for own, other, found in ((a, b, possible.any(axis=1)), (b, a, possible.any(axis=0))):
        in_view = _mark_in_sector(points[own] - place, points[other] - place, reach)
        absent += int((in_view & ~found).sum())
        present += int(found.sum())
    return ABSENT * absent - PRESENT * present


def _mark_possible(
    island: Island, nodes: Indices, one: Indices, two: Indices
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, "a b"]]:
    mean, covariance = joint_marginal(island, nodes.tolist())
    points = mean.reshape(-1, 2)
    profile = island.settings.association
    joint = Joint(points, covariance, np.zeros((len(nodes), len(nodes)), np.bool_), profile)
    fits = joint.evaluate(*list_pairs(one, two)).chi2 < profile.gate
    possible = np.equal.outer(one, two)
    possible[~possible] = fits
    return points, possible


def _mark_in_sector(
    points: Float[np.ndarray, "n 2"], of: Float[np.ndarray, "m 2"], reach: float
) -> Bool[np.ndarray, " n"]:
    directions = np.sort(core.atan2(of[:, 1], of[:, 0]))
    gaps = np.diff(np.append(directions, directions[0] + 2.0 * math.pi))
    near = core.hypot(*points.T) <= reach
    widest = int(gaps.argmax())
    if gaps[widest] <= AROUND:
        return np.asarray(near)
    begin = directions[(widest + 1) % len(directions)]
    turned = np.mod(core.atan2(points[:, 1], points[:, 0]) - begin, 2.0 * math.pi)
    return np.asarray(near & (turned <= 2.0 * math.pi - gaps[widest]))
