"""Split a node of a graph between its submaps, and drop a submap: hypotheses about a misfit.

A moved landmark is two landmarks, before and after; a jump at a seam is two poses. A spoilt submap
is left out.
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

ITERATIONS = 15
"""Most steps after a split."""
TOLERANCE = 1e-4
"""Largest change [m, rad] of the last step."""


def robust(island: Island) -> Island:
    """Solve an island with a robust loss, if it has none."""
    settings = island.settings
    if settings.robust:
        return island
    solved, *_ = solve_island(replace(island, settings=replace(settings, robust=True)))
    return solved


def split(
    island: Island, node: int, submaps: Collection[int], value: Float[np.ndarray, " k"]
) -> Island:
    """Give some submaps, by place in the graph, a node of their own (the last) for `node`."""
    grown, state, new = append_nodes(island.graph, island.state, [value])
    split_up = tuple(
        each._replace(nodes=np.where(each.nodes == node, new[0], each.nodes))
        if at in submaps
        else each
        for at, each in enumerate(grown.submaps)
    )
    return replace(island, graph=replace(grown, submaps=split_up), state=state)


def without(island: Island, places: Collection[int]) -> Island:
    """Drop submaps by place in the graph; a pose that nothing measures is fixed."""
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
    """Solve at final robust scales; return the solution and its cost."""
    island, damping = age_factors(island, FULL_AGE), 0.0
    try:
        for _ in range(ITERATIONS):
            island, damping, change = take_step(island, damping)
            if change < TOLERANCE or damping == STUCK:
                break
        return (island, final_cost(island)) if is_solvable(island) else None
    except UNSOLVABLE:
        return None
