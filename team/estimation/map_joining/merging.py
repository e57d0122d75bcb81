"""Merge two islands when their common points leave a single likely place of one in the other.

Starts are the places that the shared points propose (all, the landmarks alone, the inter-robot
measurements alone, every heading at which they fit well), and one independent of them (`minima`).
The lowest full solution is accepted if the maps agree and no other place is about as likely.

A shared point is a landmark of both, or a teammate observed from a pose node: at pose ∘ (range,
bearing) in the observer's island, at its pose node in its own.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.core import located
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.gaussian import UNSOLVABLE, deviation
from teamslam.team.estimation.inter_robot import InterRobotFactor, SightingKey
from teamslam.team.estimation.map_joining import alignment
from teamslam.team.estimation.map_joining.alignment import (
    LEAST_AGREEING,
    Alignment,
    Maps,
    SharedPoints,
    agreeing,
)
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    add_sightings,
    ages,
    is_solvable,
    joint_marginal,
)
from teamslam.team.estimation.map_joining.minima import (
    Minimum,
    Search,
    search_minima,
    solve_minimum,
)
from teamslam.team.estimation.map_joining.saved_maps import (
    disagreeing,
    maps_of,
    separate,
)
from teamslam.team.estimation.map_joining.submap_graph import (
    Graph,
    merge_graphs,
    observer_of,
    teammate_of,
)
from teamslam.team.estimation.se2 import transformed
from teamslam.team.shapes import Float

JointPoints = tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m m"]]
"""n points [m] and their joint covariance, m = 2n."""
HEADINGS = 24
MOST_POINTS = 24
"""Most points for which more than the best heading is tried; more do not fit at two headings."""
MOST_FIXES = 60  # most fixes that align islands: the work grows with the cube of their number
HOPELESS = 100.0  # rise of χ² above the best heading's beyond which a heading is not tried


class SharedPoint(NamedTuple):
    """A point's node in both islands, and the measurement that ties them.

    seen: inter-robot measurement; None for a landmark. from_main: the observer is in the main
    island.
    """

    main: int
    other: int
    seen: InterRobotFactor | None = None
    from_main: bool = False


def ties(main: Graph, other: Graph, sightings: Sequence[InterRobotFactor]) -> list[SharedPoint]:
    """List the shared landmarks by id, then the inter-robot measurements."""
    shared = sorted(main.landmarks.keys() & other.landmarks.keys())
    found = [SharedPoint(main.landmarks[id_], other.landmarks[id_]) for id_ in shared]
    for each in sightings:
        for observers, seen, from_main in ((main, other, True), (other, main, False)):
            observer, teammate = observer_of(observers, each), teammate_of(seen, each)
            if observer is not None and teammate is not None:
                nodes = (observer, teammate) if from_main else (teammate, observer)
                found.append(SharedPoint(*nodes, each, from_main))
    return found


def _unused_fixes(
    main: Island, other: Island, tied: Sequence[SharedPoint]
) -> frozenset[SightingKey]:
    """List the fixes that do not align islands: all but MOST_FIXES, evenly spaced in time, and
    outliers of their common rigid motion.
    """
    every = {each.seen.key: each for each in tied if each.seen is not None and each.seen.is_fix}
    if len(every) <= LEAST_AGREEING:
        return frozenset()
    keys = list(every)[:: -(-len(every) // MOST_FIXES)]
    limit = chi2_limit(2, 1.0 - main.settings.alignment_confidence)
    agree = agreeing(_shared_maps(main, other, [every[key] for key in keys]), limit)
    return frozenset(every).difference(compress(keys, agree))


def _align(main: Island, other: Island, tied: Sequence[SharedPoint]) -> Alignment | None:
    if len(tied) < alignment.NEEDED:
        return None
    return alignment.align(_shared_maps(main, other, tied))


def _shared_maps(main: Island, other: Island, tied: Sequence[SharedPoint]) -> Maps:
    in_main = _points(main, [(t.main, t.seen, t.from_main) for t in tied])
    in_other = _points(other, [(t.other, t.seen, not t.from_main) for t in tied])
    return Maps(*in_main, *in_other)


def _points(island: Island, at: Sequence[tuple[int, InterRobotFactor | None, bool]]) -> JointPoints:
    """Compute positions of nodes, or of points measured from or on them, with joint covariance.

    at: node, measurement, and whether the node is the observer's.
    """
    mean, covariance = joint_marginal(island, [node for node, _, _ in at])
    points = np.empty((len(at), 2))
    J = np.zeros((2 * len(at), len(mean)))
    noise = np.zeros((2 * len(at), 2 * len(at)))
    begin = 0
    for k, (node, seen, is_observer) in enumerate(at):
        rows, value = slice(2 * k, 2 * k + 2), mean[begin:]
        J[rows, begin : begin + 2] = np.eye(2)
        points[k] = value[:2]
        if seen is not None and not is_observer and seen.is_fix:
            points[k] = transformed(value[:3], seen.point)
            x, y = points[k] - value[:2]
            J[rows, begin + 2] = -y, x
        elif seen is not None and is_observer:
            distance, bearing = float(seen.measurement[0]), float(seen.measurement[1])
            points[k] = located(value[:3], distance, bearing)
            x, y = points[k] - value[:2]
            J[rows, begin + 2] = -y, x
            direction = core.atan2(y, x)
            s, c = core.sin_and_cos(direction)
            polar = np.array([[c, -distance * s], [s, distance * c]])
            noise[rows, rows] = dense.congruent(polar, seen.covariance)
        begin += int(island.graph.offset[node + 1] - island.graph.offset[node])
    return points, dense.congruent(J, covariance) + noise


def _headings_that_fit(
    main: Island, other: Island, tied: Sequence[SharedPoint]
) -> list[Float[np.ndarray, "3"]]:
    """Find every main_from_other whose heading is a local minimum of the shared points' χ².

    The best translation at each heading of a grid is closed-form.
    """
    if not alignment.NEEDED <= len(tied) <= MOST_POINTS:
        return []
    maps = _shared_maps(main, other, tied)
    grid = [2.0 * math.pi * k / HEADINGS - math.pi for k in range(HEADINGS)]
    found = [alignment.fit_at_heading(maps, heading) for heading in grid]
    costs = [chi2 for _, chi2 in found]
    limit = min(costs) + HOPELESS
    return [
        np.array([*shift, heading])
        for k, (heading, (shift, chi2)) in enumerate(zip(grid, found, strict=True))
        if chi2 <= min(costs[k - 1], costs[(k + 1) % HEADINGS], limit)
    ]


WORTH_TELLING = 1.0  # least reported gain of a search in χ²


class Merge(NamedTuple):
    """The merged island, the waiting inter-robot measurements, and a description."""

    island: Island
    waiting: tuple[InterRobotFactor, ...]
    words: str


class Waits(NamedTuple):
    """Reason why two islands stay separate; after_search: after a (slow) search."""

    why: str
    after_search: bool


def merge(main: Island, other: Island, waiting: Sequence[InterRobotFactor]) -> Merge | Waits:
    """Merge the other island into the main one's frame, or return the reason to wait."""
    if other.graph.condensed is not None:
        return Waits("its submaps are condensed in a frame of their own", after_search=False)
    try:
        with np.errstate(all="ignore"):
            return _merge(main, other, waiting)
    except UNSOLVABLE as error:
        return Waits(f"cannot be solved for: {error}", after_search=True)


def _merge(main: Island, other: Island, waiting: Sequence[InterRobotFactor]) -> Merge | Waits:
    apart = _separate_moved(main, other)
    if isinstance(apart, Waits):
        return apart
    main, other = apart
    tied = ties(main.graph, other.graph, waiting)
    unused = _unused_fixes(main, other, tied)
    tied = [tie for tie in tied if tie.seen is None or tie.seen.key not in unused]
    aside = [each for each in waiting if each.key in unused]
    waiting = [each for each in waiting if each.key not in unused]
    seen = sum(tie.seen is not None for tie in tied)
    shared = SharedPoints(len(tied) - seen, seen)
    found = _align(main, other, tied)
    why = alignment.refusal(shared, found, main.settings.alignment_heading_sigma)
    if found is None or why is not None:
        return Waits(why or str(shared), after_search=False)
    both, left = place_island(main, other, found.a_from_b, waiting)
    graph = both.graph
    others = [
        place_island(main, other, place, ())[0] for place in _propose_places(main, other, tied)
    ]
    search = search_minima([both, *(replace(both, state=each.state) for each in others)])
    rise = search.best.cost - solve_minimum(main).cost - solve_minimum(other).cost
    # Fixes whose errors drift agree with the alignment one by one (`_unused_fixes`), not together.
    are_fixes = all(tie.seen is not None and tie.seen.is_fix for tie in tied)
    if not are_fixes:
        why = alignment.disagreement(shared, rise, main.settings.alignment_confidence)
    if why is None and search.second is not None and search.ambiguous:
        why = _describe_ambiguity(
            shared, search, search.second, graph.streams[min(other.graph.streams)][0]
        )
    if why is not None:
        return Waits(why, after_search=True)
    if not is_solvable(search.best.island):
        return Waits(f"{shared}, with which the map has no solution", after_search=True)
    words = _describe_merge(other, shared, search, rise)
    island, left = add_sightings(
        search.best.island, sorted((*left, *aside), key=lambda each: each.key)
    )
    return Merge(island, left, words)


def _separate_moved(main: Island, other: Island) -> tuple[Island, Island] | Waits:
    island = main if maps_of(main.graph) else other
    saved = maps_of(island.graph)
    ids = sorted(main.graph.landmarks.keys() & other.graph.landmarks.keys())
    if not saved or len(ids) <= alignment.NEEDED:
        return main, other
    moved = disagreeing(main, other, ids, main.settings.alignment_confidence)
    if isinstance(moved, str):
        return Waits(moved, after_search=True)
    after = island
    for each in saved:
        own = {*each.landmarks.tolist()}
        after = separate(after, each, [m for m in moved if island.graph.landmarks[m] in own])
    return (after, other) if island is main else (main, after)


def place_island(
    main: Island,
    other: Island,
    main_from_other: Float[np.ndarray, "3"],
    waiting: Sequence[InterRobotFactor],
) -> tuple[Island, tuple[InterRobotFactor, ...]]:
    """Join both islands at the initial robust scales."""
    graph, state = merge_graphs(main.graph, main.state, other.graph, other.state, main_from_other)
    new = ages(len(graph.submaps)), ages(len(graph.sightings))
    return add_sightings(Island(graph, state, *new, main.settings), waiting)


def _propose_places(
    main: Island, other: Island, tied: Sequence[SharedPoint]
) -> list[Float[np.ndarray, "3"]]:
    by_landmarks = [tie for tie in tied if tie.seen is None]
    by_sightings = [tie for tie in tied if tie.seen is not None]
    proposed: list[Alignment | None] = []
    if by_landmarks and by_sightings:
        for some in (by_landmarks, by_sightings):
            with suppress(*UNSOLVABLE):
                proposed.append(_align(main, other, some))
    places = [found.a_from_b for found in proposed if found is not None]
    return [*places, *_headings_that_fit(main, other, tied)]


def _describe_ambiguity(shared: SharedPoints, search: Search, second: Minimum, node: int) -> str:
    away = second.island.value(node) - search.best.island.value(node)
    return (
        f"{shared} leave two places {core.hypot(away[0], away[1]):.1f} m apart: "
        f"chi² of one is only {second.cost - search.best.cost:.1f} more"
    )


def _describe_merge(other: Island, shared: SharedPoints, search: Search, rise: float) -> str:
    node = search.best.island.graph.streams[min(other.graph.streams)][0]
    _, covariance = joint_marginal(search.best.island, [node])
    sigma_m = deviation(covariance[0, 0] + covariance[1, 1])
    sigma_deg = float(np.degrees(deviation(covariance[2, 2])))
    dof = 2 * sum(shared) - 3
    text = (
        f"{shared}, chi² {max(rise, 0.0) / dof:.1f} per degree of freedom, "
        f"transform sigma {sigma_m:.2g} m / {sigma_deg:.2g}°"
    )
    if search.gained > WORTH_TELLING:
        text += f"; the first guess led to a minimum {search.gained:.0f} higher in chi²"
    return text
