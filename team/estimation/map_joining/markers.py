"""Marker errors of unnamed landmarks, as states of the full solution.

A sensor that derives distance from an object's size measures each landmark too far by a constant
share of the range (`CommonBiasSigmas.marker`). The states are added after association, whose
evidence they would weaken.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.contribution import is_map
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.submap_graph import (
    CommonError,
    Joined,
    Prior,
    append_nodes,
)


def add_markers(island: Island) -> Island:
    """Add a marker state to each unnamed landmark without one, unless submaps are condensed."""
    graph, number = island.graph, _find_unmarked(island)
    if not number or graph.condensed is not None:
        return island
    sigma = island.settings.common_bias_sigma["marker"]
    marked = [_list_numbers(each, number) for each in graph.submaps]
    errors = dict.fromkeys(error for each in marked for error in each)
    graph, state, new = append_nodes(graph, island.state, [np.zeros(1) for _ in errors])
    nodes: dict[CommonError, int] = dict(zip(errors, new, strict=True))
    graph = replace(
        graph,
        common={**graph.common, **nodes},
        submaps=tuple(
            _add_rows(each, own, nodes, number)
            for each, own in zip(graph.submaps, marked, strict=True)
        ),
        priors=(*graph.priors, *(Prior.of_bias(node, sigma) for node in nodes.values())),
    )
    return replace(island, graph=graph, state=state)


def warn_of_unmarked(island: Island) -> list[str]:
    """Warn of landmarks without a marker state in the full solution."""
    graph, count = island.graph, len(_find_unmarked(island))
    if not count or not any(bias == "range_scale" for _, bias in graph.biases):
        return []
    return [
        f"{count} landmarks without a name lack the error of their marker, since old submaps are "
        "condensed: the map's covariance may be too small"
    ]


def _find_unmarked(island: Island) -> dict[int, int]:
    graph = island.graph
    if "marker" not in island.settings.common_bias_sigma:
        return {}
    return {
        node: id_
        for id_, node in graph.landmarks.items()
        if id_ >= UNNAMED and id_ not in graph.common
    }


def _list_numbers(submap: Joined, number: dict[int, int]) -> list[int]:
    of = submap.contribution
    if "range_scale" not in of.local.biases or is_map(of.stream):
        return []
    return [number[node] for node in submap.landmarks.tolist() if node in number]


def _add_rows(
    submap: Joined, errors: list[int], nodes: Mapping[CommonError, int], number: dict[int, int]
) -> Joined:
    """Add each marker's row of sensitivity: the range scale's, for the landmark alone."""
    if not errors:
        return submap
    local = submap.contribution.local
    scale = local.sensitivity[local.biases.index("range_scale")]
    first = len(scale) - 2 * len(local.ids)
    rows = np.zeros((len(errors), len(scale)))
    places = [k for k, node in enumerate(submap.landmarks.tolist()) if node in number]
    for row, k in zip(rows, places, strict=True):
        at = slice(first + 2 * k, first + 2 * k + 2)
        row[at] = scale[at]
    return Joined.with_rows(
        submap.contribution,
        np.append(submap.nodes, [nodes[error] for error in errors]),
        (*submap.biases, *errors),
        np.concatenate((submap.sensitivity, rows)),
    )
