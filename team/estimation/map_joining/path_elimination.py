"""The quadratic of factors at the present state, with the old poses eliminated run by run.

A run of old poses touches only the landmarks seen along it and the poses at its ends. Each is
eliminated from a dense quadratic over these, whose rest is a factor of the next run (George 1973,
SIAM J. Numer. Anal. 10(2), by blocks).
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.map_joining.condensed_factor import places
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.resting import eliminate
from teamslam.team.shapes import Bool, Float, Int64

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]

RUN = 16
"""Number of submaps whose poses are eliminated together."""


class MarkedFactors(NamedTuple):
    """Marks of submaps, inter-robot measurements and priors, in the graph's order."""

    submaps: Bool[np.ndarray, " F"]
    sightings: Bool[np.ndarray, " S"]
    priors: Bool[np.ndarray, " priors"]


class Left(NamedTuple):
    """A quadratic over some nodes, ascending, left by the elimination of others."""

    nodes: Indices
    information: Matrix
    slope: Values


def eliminate_paths(
    island: Island, union: Indices, factors: MarkedFactors, eliminated: Bool[np.ndarray, " _"]
) -> tuple[Indices, Matrix, Values, float]:
    """Eliminate poses from the factors' quadratic; return its nodes, A, half the gradient and the
    lowered cost. The graph must have no condensed factor.

    union: the factors' nodes but constants. eliminated: marks of nodes; landmarks stay.
    """
    graph = island.graph
    sizes, total = np.diff(graph.offset), 0.0
    left: list[Left] = []
    rest = MarkedFactors(*(each.copy() for each in factors))
    for run in _list_runs(island, factors.submaps):
        path = np.zeros(len(graph.fixed), np.bool_)
        for f in run:
            contribution, nodes, *_ = graph.submaps[f]
            path[nodes[0]] = True
            path[nodes[2 : 2 + len(contribution.local.node_stamps)]] = True
        path &= ~graph.fixed
        taken = _mark_factors(island, run, path, rest)
        for each, marks in zip(rest, taken, strict=True):
            each[marks] = False
        beside = [each for each in left if path[each.nodes].any()]
        left = [each for each in left if not path[each.nodes].any()]
        nodes = nodes_of(island, taken, (each.nodes for each in beside))
        H, g, cost = island.estimate.quadratic(nodes, *taken)
        _add(H, g, sizes, nodes, beside)
        parts = eliminate(H, g, np.repeat(path[nodes], sizes[nodes]))
        left.append(Left(nodes[~path[nodes]], parts.information, parts.slope))
        total += cost - parts.lowered
    union = union[~eliminated[union] | (sizes[union] == 2)]
    H, g, cost = island.estimate.quadratic(union, *rest)
    _add(H, g, sizes, union, left)
    return union, H, g, total + cost


def _list_runs(island: Island, leaving: Bool[np.ndarray, " F"]) -> Iterator[list[int]]:
    streams: dict[Stream, list[int]] = defaultdict(list)
    for f in np.flatnonzero(leaving).tolist():
        streams[island.graph.submaps[f].contribution.stream].append(f)
    for stream in sorted(streams):
        own = streams[stream]
        yield from (own[k : k + RUN] for k in range(0, len(own), RUN))


def _mark_factors(
    island: Island, run: list[int], path: Bool[np.ndarray, " _"], among: MarkedFactors
) -> MarkedFactors:
    graph = island.graph
    submaps = np.zeros(len(graph.submaps), np.bool_)
    submaps[run] = True
    seen = np.array([path[a] or path[b] for _, a, b in graph.sightings], np.bool_)
    priors = np.array([path[[*each.nodes]].any() for each in graph.priors], np.bool_)
    return MarkedFactors(submaps, among.sightings & seen, among.priors & priors)


def nodes_of(island: Island, factors: MarkedFactors, others: Iterable[Indices]) -> Indices:
    """List the free nodes of factors and `others`, ascending."""
    graph = island.graph
    touched = [*others]
    touched += [graph.submaps[f].nodes for f in np.flatnonzero(factors.submaps)]
    touched += [np.array(graph.sightings[s][1:]) for s in np.flatnonzero(factors.sightings)]
    touched += [np.array(graph.priors[k].nodes) for k in np.flatnonzero(factors.priors)]
    union = np.unique(np.concatenate(touched))
    found: Indices = union[~graph.fixed[union]]
    return found


def _add(H: Matrix, g: Values, sizes: Indices, nodes: Indices, left: list[Left]) -> None:
    first = np.concatenate([[0], np.cumsum(sizes[nodes])])
    for each in left:
        within = places(first, np.searchsorted(nodes, each.nodes))
        H[np.ix_(within, within)] += each.information
        g[within] += each.slope
