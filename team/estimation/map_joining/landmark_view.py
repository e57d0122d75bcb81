"""Landmarks of an island by id, nodes and those at rest (`condensing`) alike."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.submap_graph import append_nodes
from teamslam.team.shapes import Float, Int64


def known(island: Island) -> list[int]:
    """List the ids of all landmarks, ascending."""
    return sorted([*island.graph.landmarks, *resting(island)])


def resting(island: Island) -> list[int]:
    """List the ids of the landmarks at rest."""
    old = island.graph.condensed
    return [] if old is None else [*old.place]


def members(island: Island, ids: Sequence[int]) -> Int64[np.ndarray, " L"]:
    """Return the node of each landmark, or -1 - its place at rest. Raises KeyError."""
    landmarks, old = island.graph.landmarks, island.graph.condensed
    place = {} if old is None else old.place
    found = [landmarks[id_] if id_ in landmarks else -1 - place[id_] for id_ in ids]
    return np.array(found, np.int64)


def points_of(island: Island, ids: Sequence[int]) -> Float[np.ndarray, "L 2"]:
    """Return the positions [m] of landmarks."""
    return island.estimate.points(members(island, ids))


def blocks_of(island: Island, ids: Sequence[int]) -> Float[np.ndarray, "L 2 2"]:
    """Return the own covariance [m²] of each landmark."""
    with island.determined():
        return island.estimate.blocks(members(island, ids))


def joint(
    island: Island, nodes: Sequence[int], ids: Sequence[int]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Compute mean and joint covariance of nodes and landmarks."""
    return joint_marginal(island, [*nodes, *members(island, ids).tolist()])


def wake_landmarks(island: Island, ids: Collection[int]) -> Island:
    """Turn landmarks at rest into nodes again."""
    graph, old = island.graph, island.graph.condensed
    woken = [id_ for id_ in old.place if id_ in ids] if old is not None else []
    if old is None or not woken:
        return island
    grown, state, nodes = append_nodes(graph, island.state, [*points_of(island, woken)])
    with island.determined():
        factor = old.factor.woken(
            np.array([old.place[id_] for id_ in woken]), np.array([*nodes], np.int64)
        )
    condensed = replace(
        old,
        factor=factor,
        redundancy=old.redundancy + 2 * len(woken),
        resting=np.array([id_ for id_ in old.place if id_ not in ids], np.int64),
    )
    landmarks = {**graph.landmarks, **dict(zip(woken, nodes, strict=True))}
    return replace(
        island, graph=replace(grown, landmarks=landmarks, condensed=condensed), state=state
    )
