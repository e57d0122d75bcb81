"""The errors of the markers of landmarks without a name, as states of the full solution.

A sensor that tells the distance from an object's size or height measures each landmark too far by a
share of the range of its own, whoever observes it (`CommonBiasSigmas.marker`). The share belongs to
the landmark, whether robots read a name on it or not. Which local landmarks are one is known when
association has ended: before, the parts of one landmark would each have an error of their own, and
would be told apart less well.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from team.config import UNNAMED
from team.estimation import elementary
from team.estimation.map_joining.gauss_newton import Island
from team.estimation.map_joining.submap_graph import RANGE_POWER, CommonError, Joined, Prior


def with_markers(island: Island) -> Island:
    """The island with a state for the marker of each landmark without a name that has none; an
    island with condensed submaps as it is.
    """
    graph, number = island.graph, _unmarked(island)
    if not number or graph.condensed is not None:
        return island
    sigma = island.settings.common_bias_sigma["marker"]
    marked = [_numbers(each, number) for each in graph.submaps]
    first = len(graph.fixed)
    errors = dict.fromkeys(error for each in marked for error in each)
    nodes: dict[CommonError, int] = {error: first + k for k, error in enumerate(errors)}
    certainty = np.array([[1.0 / elementary.squared(sigma)]])
    count = len(nodes)
    graph = replace(
        graph,
        common={**graph.common, **nodes},
        offset=np.append(graph.offset, graph.offset[-1] + 1 + np.arange(count)),
        fixed=np.append(graph.fixed, np.zeros(count, np.bool_)),
        submaps=tuple(
            _marked(each, own, nodes, number)
            for each, own in zip(graph.submaps, marked, strict=True)
        ),
        priors=(*graph.priors, *(Prior(node, np.zeros(1), certainty) for node in nodes.values())),
    )
    return replace(island, graph=graph, state=np.append(island.state, np.zeros(count)))


def unmarked(island: Island) -> list[str]:
    """Warns, in words, of landmarks whose marker's error the full solution does not have."""
    graph, count = island.graph, len(_unmarked(island))
    if not count or not any(bias == "range_scale" for _, bias in graph.biases):
        return []
    return [
        f"{count} landmarks without a name lack the error of their marker, since old submaps are "
        "condensed: the map's covariance may be too small"
    ]


def _unmarked(island: Island) -> dict[int, int]:
    """The number of each node of a landmark without a name that has no state for its marker; none
    where the settings have none.
    """
    graph = island.graph
    if "marker" not in island.settings.common_bias_sigma:
        return {}
    return {
        node: id_
        for id_, node in graph.landmarks.items()
        if id_ >= UNNAMED and id_ not in graph.common
    }


def _numbers(submap: Joined, number: dict[int, int]) -> list[int]:
    """The numbers of a submap's landmarks with a new marker, in its order."""
    if "range_scale" not in submap.contribution.local.biases:
        return []
    return [number[node] for node in submap.landmarks.tolist() if node in number]


def _marked(
    submap: Joined, errors: list[int], nodes: Mapping[CommonError, int], number: dict[int, int]
) -> Joined:
    """The submap with a row of its sensitivity for each of these markers: that of the scale of the
    ranges, restricted to the landmark.
    """
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
    return submap._replace(
        nodes=np.append(submap.nodes, [nodes[error] for error in errors]),
        biases=(*submap.biases, *errors),
        range_power=np.append(submap.range_power, np.full(len(errors), RANGE_POWER["range_scale"])),
        sensitivity=np.concatenate((submap.sensitivity, rows)),
    )
