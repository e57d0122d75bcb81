"""Split a node of a graph between its submaps, and drop a submap: hypotheses about a misfit.

A moved landmark is two landmarks, a jump at a seam two poses; a spoilt submap is left out.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.map_joining.gauss_newton import (
    FULL_AGE,
    STUCK,
    Island,
    age_factors,
    final_cost,
    is_solvable,
    solve_island,
    take_step,
)
from teamslam.team.estimation.map_joining.submap_graph import append_nodes
from teamslam.team.shapes import Float

ITERATIONS = 15  # most steps after a split
TOLERANCE = 1e-4  # largest change [m, rad] of the last step


def robust(island: Island) -> Island:
    """Solve an island with a robust loss, unless it has one."""
    settings = island.settings
    if settings.robust:
        return island
    solved, *_ = solve_island(replace(island, settings=replace(settings, robust=True)))
    return solved


def split(
    island: Island, node: int, submaps: Collection[int], value: Float[np.ndarray, " k"]
) -> Island:
    """Assign a new, last node to some submaps (by place in the graph) instead of `node`."""
    grown, state, new = append_nodes(island.graph, island.state, [value])
    split_up = tuple(
        each._replace(nodes=np.where(each.nodes == node, new[0], each.nodes))
        if at in submaps
        else each
        for at, each in enumerate(grown.submaps)
    )
    return replace(island, graph=replace(grown, submaps=split_up), state=state)


def without(island: Island, places: Collection[int]) -> Island:
    """Drop submaps by place in the graph; fix poses that nothing measures."""
    graph = island.graph
    keep = np.array([at not in places for at in range(len(graph.submaps))], np.bool_)
    left = tuple(each for at, each in enumerate(graph.submaps) if keep[at])
    measured = np.zeros(len(graph.fixed), np.bool_)
    for each in left:
        measured[each.nodes] = True
    for seen in graph.sightings:
        measured[[seen.observer, seen.teammate]] = True
    measured[[node for each in graph.priors for node in each.nodes]] = True
    if graph.condensed is not None:
        measured[graph.condensed.nodes] = True
    less = replace(graph, submaps=left, fixed=graph.fixed | ~measured)
    return replace(island, graph=less, age=island.age[keep])


def resolved(island: Island) -> tuple[Island, float] | None:
    """Solve at final robust scales; return the solution and its cost, or None."""
    island, damping = age_factors(island, FULL_AGE), 0.0
    try:
        for _ in range(ITERATIONS):
            island, damping, change = take_step(island, damping)
            if change < TOLERANCE or damping == STUCK:
                break
        return (island, final_cost(island)) if is_solvable(island) else None
    except UNSOLVABLE:
        return None
