"""Search for the lowest minimum: one island solved from several starts.

After a long path without landmarks Gauss-Newton may fold a chain wrongly, which a cost far above
its degrees of freedom or a lower end of another start reveals.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.contribution import Stream, named
from teamslam.team.estimation.gaussian import UNSOLVABLE, NotDeterminedError
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    degrees_of_freedom,
    final_cost,
    is_suspicious,
    likely_limit,
    solve_island,
)
from teamslam.team.estimation.map_joining.nonlinearity import (
    ends,
    heading_sigma,
    nonlinearity_warnings,
    profile,
)
from teamslam.team.estimation.map_joining.relaxation import relax_headings
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float

Values = Float[np.ndarray, " _"]

SETTLED_M = 1e-3  # length of the last step [m, rad] above which a solution is not yet a minimum
MORE_SOLUTIONS = 4  # further solutions of the best start before it is reported as not settled
FEW_LANDMARKS = 6  # most landmarks with which a chain may fold wrongly at an unsuspicious cost
RIVAL = "another map fits about as well"
MISFIT = "the map does not fit its submaps"
"""First words of the warnings about another minimum, and about the cost."""
WIDE = 30.0  # Cauchy's scale at which the annealed start begins


class Minimum(NamedTuple):
    """A full solution: number of iterations, last change [m, rad], cost."""

    island: Island
    iterations: int
    change: float
    cost: float


class Search(NamedTuple):
    """The lowest minimum, its gain over the first start, and a second minimum."""

    best: Minimum
    gained: float
    second: Minimum | None

    @property
    def ambiguous(self) -> bool:
        """Whether a second minimum is about as likely."""
        return self.second is not None and self.second.cost - self.best.cost < likely_rise()


def solve_minimum(island: Island) -> Minimum:
    """Solve in full from the island's state."""
    solved, iterations, change = solve_island(island)
    return Minimum(solved, iterations, change, final_cost(solved))


def likely_rise() -> float:
    """Return the quantile of χ² of 3 above which another place is unlikely."""
    return likely_limit(3)


def search_minima(starts: Sequence[Island]) -> Search:
    """Find the lowest minimum from several starts of one graph, and from the relaxation of its
    headings; while the cost is suspicious, or with few landmarks, from `_make_starts`.

    Raises NotDeterminedError if no start has a solution.
    """
    few = len(starts[0].graph.landmarks) <= FEW_LANDMARKS
    found = list(_solve_each(starts))
    for each in _solve_each(_make_starts(starts[0])):
        found.append(each)
        if not few and not is_suspicious(starts[0], min(each.cost for each in found)):
            break
    if not found:
        raise NotDeterminedError("every place that was tried")
    return _select_lowest(found)


def _solve_each(starts: Iterable[Island]) -> Iterator[Minimum]:
    for start in starts:
        found = None
        with suppress(*UNSOLVABLE), np.errstate(all="ignore"):
            found = solve_minimum(start)
        if found is not None and math.isfinite(found.cost):
            yield found


def widen_search(search: Search) -> Search:
    """Extend the search by the minima next to the best one, for maps with few landmarks: each
    uncertain heading of a first or last pose is displaced, and each stream mirrored.
    """
    best = search.best.island
    if len(best.graph.landmarks) > FEW_LANDMARKS:
        return search
    found = [search.best] if search.second is None else [search.best, search.second]
    for _, _, node in ends(best):
        with suppress(*UNSOLVABLE):  # of the walk itself
            found += _solve_each(walked for walked, _ in profile(best, node))
    found += _solve_each(_mirror_streams(best))
    wider = _select_lowest(found)
    return wider._replace(gained=search.gained + search.best.cost - wider.best.cost)


def _mirror_streams(island: Island) -> Iterator[Island]:
    """Mirror a stream's poses at the line through two landmarks.

    With the line's direction α: p' = a + R(2α) conj(p − a), θ' = 2α − θ.
    """
    graph = island.graph
    for stream in sorted(graph.streams):
        own = [node for (of, _), node in graph.poses.items() if of == stream]
        poses = np.array([n for n in (*graph.streams[stream], *own) if not graph.fixed[n]])
        at = graph.offset[poses]
        for pair in _list_passages(island, stream):
            a, b = (complex(*island.state[at_l : at_l + 2]) for at_l in pair)
            if a == b:
                continue
            along = (b - a) / core.hypot(b.real - a.real, b.imag - a.imag)
            turned = along * along
            p = island.state[at] + 1j * island.state[at + 1]
            p = a + turned * np.conj(p - a)
            state = island.state.copy()
            state[at], state[at + 1] = p.real, p.imag
            state[at + 2] = wrapped(np.angle(turned) - island.state[at + 2])
            yield replace(island, state=state)


def _list_passages(island: Island, stream: Stream) -> list[tuple[int, int]]:
    graph, before = island.graph, set[int]()
    pairs: set[tuple[int, int]] = set()
    for submap in graph.submaps:
        seen = set(submap.landmarks.tolist())
        if submap.contribution.stream != stream or not seen:
            continue
        pairs |= {(min(a, b), max(a, b)) for a in before for b in seen - before if a not in seen}
        before = seen
    return [(int(graph.offset[a]), int(graph.offset[b])) for a, b in sorted(pairs)]


def _select_lowest(found: Sequence[Minimum]) -> Search:
    best = _settle_minimum(min(found, key=lambda each: each.cost))
    others = [each for each in found if each.change < SETTLED_M and is_another_minimum(each, best)]
    second = min(others, key=lambda each: each.cost, default=None)
    return Search(best, found[0].cost - best.cost, second)


def _make_starts(island: Island) -> Iterator[Island]:
    """Make starts independent of the state: relaxed, without inter-robot measurements, and with
    wide robust scales; none with condensed submaps.
    """
    graph = island.graph
    if graph.condensed is not None:
        return
    guess = relax_headings(graph, island.state)
    if guess is not None:
        yield replace(island, state=guess)
    if graph.sightings:
        unseen = replace(
            island, graph=replace(graph, sightings=()), sighting_age=island.sighting_age[:0]
        )
        alone = relax_headings(unseen.graph, island.state)
        if alone is not None:  # none, where only inter-robot measurements tie the robots
            for found in _solve_each([replace(unseen, state=alone)]):
                yield replace(island, state=found.island.state)
    if guess is not None:
        doubting = replace(island.settings, robust=True, robust_start=WIDE)
        for found in _solve_each([replace(island, state=guess, settings=doubting)]):
            yield replace(island, state=found.island.state)


def _settle_minimum(best: Minimum) -> Minimum:
    for _ in range(MORE_SOLUTIONS):
        if best.change <= SETTLED_M:
            break
        further = solve_minimum(best.island)
        best = further._replace(iterations=best.iterations + further.iterations)
    return best


def is_another_minimum(one: Minimum, best: Minimum) -> bool:
    """Return whether a minimum is another map: dᵀAd, the rise that the best one's covariance
    predicts for the difference d, exceeds `likely_rise`.
    """
    values, _ = best.island.estimate.normal_equations
    difference = _difference(one.island, best.island)
    return best.island.graph.pattern.quadratic(values, difference) > likely_rise()


def _difference(one: Island, other: Island) -> Values:
    difference: Values = one.state - other.state
    headings = one.graph.headings
    difference[headings] = wrapped(difference[headings])
    return difference


def rival_distance(search: Search) -> float | None:
    """Compute the distance [m] of a second minimum that is as likely and significantly apart."""
    if search.second is None or not search.ambiguous:
        return None
    island = search.best.island
    away = _difference(search.second.island, island)
    points = island.graph.offset[:-1][np.diff(island.graph.offset) > 1]
    sigma = np.sqrt(island.selected_covariance[island.graph.pattern.diagonal])
    if not bool((np.abs(away) > sigma).any()):
        return None
    return float(core.hypot(away[points], away[points + 1]).max())


def warnings(search: Search) -> list[str]:
    """Warn the map's user about other minima."""
    island, found = search.best.island, []
    dof = degrees_of_freedom(island)
    if is_suspicious(island, search.best.cost):
        found.append(
            f"{MISFIT}: chi² {search.best.cost:.1f} with {dof} degrees of "
            "freedom; it may be a wrong minimum, or the covariances are too small"
        )
    if search.best.change == math.inf:
        found.append("the map has no full solution: it is what the last tick has left")
    elif search.best.change > SETTLED_M:
        found.append(
            f"the map is not settled: after {search.best.iterations} iterations "
            f"a step is still {search.best.change:.2g} m or rad"
        )
    limit = island.settings.alignment_heading_sigma
    found += [
        f"{named(stream)} is placed weakly: its heading is known to {np.degrees(sigma):.0f}° at "
        f"best, {np.degrees(limit):.0f}° needed; the map may be bent by more than its covariance "
        "allows"
        for stream, nodes in sorted(island.graph.streams.items())
        if (sigma := min(heading_sigma(island, node) for node in nodes)) > limit
    ]
    with suppress(*UNSOLVABLE):  # a heading that cannot be moved bends nothing
        found += nonlinearity_warnings(island)
    if search.second is not None and (farthest := rival_distance(search)) is not None:
        found.append(
            f"{RIVAL}: chi² {search.second.cost - search.best.cost:.1f} more, "
            f"up to {farthest:.1f} m away"
        )
    return found
