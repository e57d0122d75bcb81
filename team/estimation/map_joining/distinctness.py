"""Landmarks that a final map leaves out, and streams that are lost or tied by odometry alone.

A robot that is carried off, or whose odometry slips by metres, maps landmarks twice without a
contradiction. For each boundary between submaps beyond which a stream observes hardly any landmark
of the rest, the n landmarks first observed beyond it are aligned with the N others, in an area A,
by a rigid motion (`voting`). The expected number of motions that match m or more within r by chance
is

  E = n(n − 1) N(N − 1) P(X ≥ m − 2),   X ~ binomial(n − 2, min(1, π r² N/A))

since each pair on a pair defines one motion. Of the radii from `same` down to the default
profile's, the one of least E is used, and E is multiplied by their number. A building that repeats
itself gives the same result.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.association import DEFAULT_PROFILE
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.voting import (
    PointSet,
    Vote,
    apply_motion,
    propose_alignments,
)
from teamslam.team.estimation.contribution import Stream, is_map
from teamslam.team.estimation.map_joining.condensed import MOST
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.late_seams import MOST_ABSENT, weigh_places
from teamslam.team.estimation.map_joining.nonlinearity import heading_sigma
from teamslam.team.shapes import Bool, Float, Int64


def find_weakly_placed(island: Island, ids: Collection[int]) -> list[int]:
    """Find the landmarks that only submaps of an uncertain heading observe, ascending.

    A turn by θ moves a point at distance d by d (1 − cos θ) in a direction that the linearised
    covariance takes as certain: d/3 at `alignment_heading_sigma` and three standard deviations.
    """
    best: dict[int, float] = {}
    for submap in island.graph.submaps:
        sigma = min(heading_sigma(island, node) for node in submap.nodes[:2].tolist())
        for node in submap.landmarks[submap.landmarks >= 0].tolist():
            best[node] = min(sigma, best.get(node, math.inf))
    limit, node_of = island.settings.alignment_heading_sigma, island.graph.landmarks
    return [id_ for id_ in sorted(ids) if best.get(node_of.get(id_, -1), 0.0) > limit]


WELL_OBSERVED = 4
"""Least submaps of a landmark whose residuals count in the scale of right associations."""
LEAST_RESIDUALS = 30  # least number of residuals for an estimate of their scale
LEAST_SCALE = 0.1  # least scale of residuals: data without noise have none


def find_disagreeing(fold: Fold, ids: Collection[int], least: int) -> list[int]:
    """Find the unnamed landmarks with which fewer than `least` submaps agree, ascending, except for
    those of a saved map or judged by an operator.

    A submap agrees if its χ² is below `landmark_gate` · min(1, median of the map's χ² / (2 ln 2)):
    covariances stated too large must not admit a neighbour.
    """
    island = fold.main
    graph, settings = island.graph, island.settings
    chi2 = graph.factors.landmark_chi2(island.state, settings.covariance_factor)
    nodes = np.concatenate([each.landmarks for each in graph.submaps])
    saved = np.isin(nodes, [n for k in graph.saved_maps for n in graph.submaps[k].landmarks])
    counts = np.bincount(nodes[nodes >= 0], minlength=len(graph.fixed))
    unnamed = np.isin(nodes, [node for id_, node in graph.landmarks.items() if id_ >= UNNAMED])
    sound = chi2[unnamed & ~saved & (counts[nodes] >= WELL_OBSERVED)]
    if len(sound) < LEAST_RESIDUALS:
        return []
    scale = max(min(float(np.median(sound)) / (2.0 * core.log(2.0)), 1.0), LEAST_SCALE)
    agrees = (chi2 <= scale * settings.landmark_gate) & (nodes >= 0)
    enough = np.bincount(nodes[agrees], minlength=len(counts)) >= least
    enough[nodes[saved & (nodes >= 0)]] = True
    judged = fold.landmarks.judged()
    unnamed_ids = (id_ for id_ in sorted({*ids} - judged) if id_ >= UNNAMED)
    return [id_ for id_ in unnamed_ids if not enough[graph.landmarks[id_]]]


def find_missed(fold: Fold, ids: Collection[int]) -> list[int]:
    """Find the landmarks that nearly all submaps with a view of them miss, ascending, except those
    judged by an operator.

    A landmark of n < MOST submaps is missed if each landmark of MOST or more submaps beside it was
    observed by MOST n, and at least half of its submaps have one beside it. Saved maps
    do not count.
    """
    graph = fold.main.graph
    counts = np.zeros(len(graph.fixed), np.int64)
    for id_, node in graph.landmarks.items():
        counts[node] = graph.departed.believed.get(id_, 0)
    for submap in graph.submaps:
        counts[submap.landmarks[submap.landmarks >= 0]] += 1
    observed = np.full(len(counts), np.iinfo(np.int64).max)
    having, knowing = np.zeros_like(counts), np.zeros_like(counts)
    for each in graph.observed:
        if is_map(each.observation.stream):
            continue
        beside = counts[each.known]
        well_known = beside[beside >= MOST]
        having[each.known] += 1
        if len(well_known):
            knowing[each.known] += 1
            observed[each.known] = np.minimum(observed[each.known], well_known.min())
    missing = (counts < MOST) & (observed >= MOST * counts) & (2 * knowing >= having) & (having > 0)
    gone = {*np.flatnonzero(missing).tolist()}
    judged = fold.landmarks.judged()
    return [id_ for id_ in sorted({*ids} - judged) if graph.landmarks.get(id_) in gone]


def find_lost_streams(island: Island) -> dict[Stream, float]:
    """Find the streams with a heading deviation above `alignment_heading_sigma`; return the largest
    [rad].
    """
    worst = {
        stream: max(heading_sigma(island, node) for node in nodes)
        for stream, nodes in island.graph.streams.items()
    }
    limit = island.settings.alignment_heading_sigma
    return {stream: sigma for stream, sigma in worst.items() if sigma > limit}


def find_parts(island: Island) -> dict[int, int]:
    """Label the landmarks by the part of the island that common landmarks connect."""
    node_of = island.graph.landmarks
    part = np.arange(len(node_of))
    for sees in _tabulate(island, [*node_of.values()]):
        labels = part[sees]
        part[np.isin(part, labels)] = labels.min(initial=len(part))
    return dict(zip(node_of, part.tolist(), strict=True))


LEAST_TIED = 2  # least number of landmarks on either side of a place that odometry alone ties


class OdometryTie(NamedTuple):
    """A place in a stream that no landmark spans.

    first: submap after it. earlier, later: numbers of landmarks. begin_ns, end_ns: of the later
    part. sigmas: of its start's position [m] and heading [rad].
    """

    stream: Stream
    first: int
    earlier: int
    later: int
    begin_ns: int
    end_ns: int
    sigmas: tuple[float, float]


def find_odometry_ties(
    island: Island, shown: Collection[int], undecided: Collection[int] = ()
) -> list[OdometryTie]:
    """Find each stream's odometry tie with the most evidence of missed landmarks (`late_seams`), at
    least MOST_ABSENT, and a shown landmark on both sides.
    """
    unnamed = sorted(node for id_, node in island.graph.landmarks.items() if id_ >= UNNAMED)
    sees = _tabulate(island, unnamed)
    node_of = island.graph.landmarks
    is_shown, counted = (
        np.isin(unnamed, [node_of[id_] for id_ in ids if id_ in node_of])
        for ids in (shown, {*shown, *undecided})
    )
    submaps, found = island.graph.submaps, []
    for stream in sorted(island.graph.streams):
        rows = _rows_of(island, stream)
        places: list[tuple[int, int, int]] = []
        for k, rest, behind in _list_boundaries(sees, rows):
            beyond = behind.any(axis=0)
            counts = int((rest & counted).sum()), int((beyond & counted).sum())
            if (rest & beyond).any() or not ((rest & is_shown).any() and (beyond & is_shown).any()):
                continue
            if min(counts) >= LEAST_TIED:
                places.append((k, *counts))
        firsts = [(stream, submaps[rows[k]].contribution.sequence) for k, *_ in places]
        evidence = weigh_places(island, firsts)
        if max(evidence, default=0.0) < MOST_ABSENT:
            continue
        k, earlier, later = places[int(np.argmax(evidence))]
        before, submap = (submaps[rows[at]].contribution for at in (k - 1, k))
        _, P = joint_marginal(island, [int(submaps[rows[k]].nodes[0])])
        found.append(
            OdometryTie(
                stream=stream,
                first=submap.sequence,
                earlier=earlier,
                later=later,
                begin_ns=before.end_ns,
                end_ns=submaps[rows[-1]].contribution.end_ns,
                sigmas=(math.sqrt(P[0, 0] + P[1, 1]), math.sqrt(P[2, 2])),
            )
        )
    return found


def _rows_of(island: Island, stream: Stream) -> list[int]:
    submaps = island.graph.submaps
    return [k for k, each in enumerate(submaps) if each.contribution.stream == stream]


def _list_boundaries(
    sees: Bool[np.ndarray, "K n"], rows: Sequence[int]
) -> Iterator[tuple[int, Bool[np.ndarray, " n"], Bool[np.ndarray, "k n"]]]:
    """List each k from 1 with the landmarks of all submaps but rows[k:], and those of these."""
    elsewhere = np.delete(sees, rows, axis=0).any(axis=0)
    for k in range(1, len(rows)):
        rest: Bool[np.ndarray, " n"] = np.logical_or(elsewhere, sees[rows[:k]].any(axis=0))
        yield k, rest, sees[rows[k:]]


def _tabulate(island: Island, nodes: Collection[int]) -> Bool[np.ndarray, "K n"]:
    at = np.full(len(island.graph.fixed), -1, np.int64)
    at[[*nodes]] = np.arange(len(nodes))
    sees = np.zeros((len(island.graph.submaps), len(nodes)), np.bool_)
    for row, submap in zip(sees, island.graph.submaps, strict=True):
        known = at[submap.landmarks[submap.landmarks >= 0]]
        row[known[known >= 0]] = True
    return sees


LEAST_PAIRS = 6  # least number of landmarks that repeat others
LEAST_SHARE = 0.5  # least share of the landmarks beyond the boundary that repeat others
MOST_SHARED = 0.25  # largest share of these submaps' landmarks that the rest has, too
BY_CHANCE = -14.0  # largest ln E: one in a million
FARTHER = 4.0  # least distance of the two places, in radii
MOST_POINTS = 400  # larger maps are not searched: voting would take seconds
TRIED = 4  # most boundaries of a stream that are examined, by least shared part


class Repetition(NamedTuple):
    """Landmarks of a stream's submaps from `first` on that repeat others after a motion.

    ids: landmarks of these submaps alone; pairs: those that match. begin_ns, end_ns: of these
    submaps. place: of the boundary [m]; displacement (x, y) [m] and turn [rad] that would make each
    pair one landmark.
    """

    stream: Stream
    first: int
    ids: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]
    begin_ns: int
    end_ns: int
    place: tuple[float, float]
    displacement: tuple[float, float, float]


def find_repetitions(island: Island, ids: Collection[int]) -> list[Repetition]:
    """Find at most one repetition of each stream."""
    unnamed = sorted(id_ for id_ in ids if id_ >= UNNAMED)
    if not 2 * LEAST_PAIRS <= len(unnamed) <= MOST_POINTS:
        return []
    nodes = [island.graph.landmarks[i] for i in unnamed]
    points, sees = island.points(nodes), _tabulate(island, nodes)
    streams = sorted(island.graph.streams)
    found = (_find_in_stream(island, stream, sees, points, unnamed) for stream in streams)
    return [each for each in found if each is not None]


def _find_in_stream(
    island: Island,
    stream: Stream,
    sees: Bool[np.ndarray, "K n"],
    points: Float[np.ndarray, "n 2"],
    ids: list[int],
) -> Repetition | None:
    rows = _rows_of(island, stream)
    candidates = []
    for k, rest, beyond in _list_boundaries(sees, rows):
        fresh = np.flatnonzero(beyond.any(axis=0) & ~rest)
        shared = float((beyond & rest).sum()) / max(float(beyond.sum()), 1.0)
        if len(fresh) >= LEAST_PAIRS and shared <= MOST_SHARED:
            candidates.append((shared, k, fresh))
    candidates.sort(key=lambda each: each[:2])
    for _, k, fresh in candidates[:TRIED]:
        others = np.setdiff1d(np.arange(len(ids)), fresh)
        found = _align_beyond_chance(
            points[fresh], points[others], island.settings.association.same
        )
        if found is None:
            continue
        vote, radius = found
        submap = island.graph.submaps[rows[k]].contribution
        start = island.graph.submaps[rows[k]].nodes[0]
        place = island.value(int(start))[:2]
        there = apply_motion(vote.motion, (place - points[fresh].mean(axis=0))[None])[0]
        gone = there - place
        if math.hypot(*gone.tolist()) < FARTHER * radius:
            continue
        before = island.graph.submaps[rows[k - 1]].contribution
        pairs = zip(fresh[vote.first].tolist(), others[vote.second].tolist(), strict=True)
        return Repetition(
            stream=stream,
            first=submap.sequence,
            ids=tuple(ids[i] for i in fresh.tolist()),
            pairs=tuple((ids[one], ids[two]) for one, two in pairs),
            begin_ns=before.end_ns,
            end_ns=island.graph.submaps[rows[-1]].contribution.end_ns,
            place=(float(place[0]), float(place[1])),
            displacement=(float(gone[0]), float(gone[1]), float(vote.motion[2])),
        )
    return None


def _align_beyond_chance(
    own: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "N 2"], same: float
) -> tuple[Vote, float] | None:
    if min(len(own), len(others)) < LEAST_PAIRS:
        return None
    a, b = PointSet(own, np.zeros(len(own))), PointSet(others, np.zeros(len(others)))
    longest = float(np.ptp(np.concatenate((own, others)), axis=0).max())
    least = max(LEAST_PAIRS, LEAST_SHARE * min(len(own), len(others)))
    radii = list_radii(same)
    most, found = BY_CHANCE - core.log(float(len(radii))), None
    for radius in radii:
        votes = propose_alignments(a, b, radius, longest)
        matched = len(votes[0].first) if votes else 0
        if matched < least:
            continue
        by_chance = log_by_chance(len(own), others, matched, radius)
        if by_chance < most:
            most, found = by_chance, (votes[0], radius)
    return found


def list_radii(same: float) -> list[float]:
    """List the radii from `same` down to the default profile's, each half of the one before."""
    radii = [same]
    while radii[-1] > DEFAULT_PROFILE.same:
        radii.append(max(0.5 * radii[-1], DEFAULT_PROFILE.same))
    return radii


def log_by_chance(n: int, others: Float[np.ndarray, "N 2"], matched: int, radius: float) -> float:
    """Compute ln E of n points of which `matched` match others."""
    count = len(others)
    area = max(float(np.ptp(others, axis=0).prod()), math.pi * core.squared(radius))
    p = min(math.pi * core.squared(radius) * count / area, 1.0 - 1e-9)
    left, least = n - 2, matched - 2
    terms: Int64[np.ndarray, " k"] = np.arange(least, left + 1)
    logs = np.array([core.log(float(math.comb(left, int(k)))) for k in terms])
    logs = logs + terms * core.log(p) + (left - terms) * core.log(1.0 - p)
    most = float(logs.max())
    tail = most + core.log(float(core.exp(logs - most).sum()))
    return tail + core.log(float(n * (n - 1)) * count * (count - 1))
