"""Write a landmark graph as text of g2o, isam or PyFactorGraph."""

from collections.abc import Iterator, Sequence

import numpy as np

from teamslam.sim.datasets.factor_graph import FactorGraph, Key, Matrix
from teamslam.sim.datasets.graph_lines import turn_covariance

LETTERS = "ABCDEFGHIJKMNOPQRSTUVWXYZ"
"""Names of robots in pyfg, where L is a landmark's."""


def g2o_lines(graph: FactorGraph) -> Iterator[str]:
    """Lines of a g2o file: poses are numbered behind the landmarks."""
    first = max(graph.landmarks, default=-1) + 1
    vertex: dict[Key, int] = {}
    for landmark, point in sorted(graph.landmarks.items()):
        yield f"VERTEX_XY {landmark} {_numbers(point)}"
    for robot in graph.robots:
        yield f"# robot {robot}"
        for key in graph.chain(robot)[0]:
            vertex[key] = first + len(vertex)
            yield f"VERTEX_SE2 {vertex[key]} {_numbers(graph.poses[key])}"
            if key in graph.priors and graph.priors[key][1] is None:
                yield f"FIX {vertex[key]}"
        first += 1  # a gap in the numbers, where no odometry leads from robot to robot
    for pose_edge in graph.pose_edges:
        ends = f"{vertex[pose_edge.start]} {vertex[pose_edge.end]}"
        yield (
            f"EDGE_SE2 {ends} {_numbers(pose_edge.motion)} "
            f"{_upper(np.linalg.inv(pose_edge.covariance))}"
        )
    for seen in graph.point_edges:
        yield (
            f"EDGE_SE2_XY {vertex[seen.pose]} {seen.landmark} {_numbers(seen.point)} "
            f"{_upper(np.linalg.inv(seen.covariance))}"
        )


def isam_lines(graph: FactorGraph, robot: str) -> Iterator[str]:
    """Lines of an isam file of one robot, with the root S of the information SᵀS."""
    number = {key: k for k, key in enumerate(graph.chain(robot)[0])}
    seen_from: dict[Key, list[str]] = {}
    for seen in graph.point_edges:
        if seen.pose in number:
            seen_from.setdefault(seen.pose, []).append(
                f"LANDMARK {number[seen.pose]} {seen.landmark} {_numbers(seen.point)} "
                f"{_upper(_root(seen.covariance))}"
            )
    for edge in graph.chain(robot)[1]:
        yield from seen_from.pop(edge.start, ())
        covariance = turn_covariance(edge.covariance, -edge.motion[2])
        yield (
            f"ODOMETRY {number[edge.start]} {number[edge.end]} {_numbers(edge.motion)} "
            f"{_upper(_root(covariance))}"
        )
    for rest in seen_from.values():
        yield from rest


def pyfg_lines(graph: FactorGraph) -> Iterator[str]:
    """Lines of a pyfg file: robots are A, B, C, …, in order."""
    name: dict[Key, str] = {}
    for letter, robot in zip(LETTERS, graph.robots, strict=False):
        for k, key in enumerate(graph.chain(robot)[0]):
            name[key] = f"{letter}{k}"
            yield f"VERTEX_SE2 {_time(graph, key)} {name[key]} {_numbers(graph.poses[key])}"
    for landmark, point in sorted(graph.landmarks.items()):
        yield f"VERTEX_XY L{landmark} {_numbers(point)}"
    for key, (pose, covariance) in sorted(graph.priors.items()):
        if covariance is not None:
            yield (
                f"VERTEX_SE2:PRIOR {_time(graph, key)} {name[key]} {_numbers(pose)} "
                f"{_upper(covariance)}"
            )
    for edge in graph.pose_edges:
        yield (
            f"EDGE_SE2 {_time(graph, edge.end)} {name[edge.start]} {name[edge.end]} "
            f"{_numbers(edge.motion)} {_upper(edge.covariance)}"
        )
    for seen in graph.point_edges:
        yield (
            f"EDGE_SE2_XY {_time(graph, seen.pose)} {name[seen.pose]} L{seen.landmark} "
            f"{_numbers(seen.point)} {_upper(seen.covariance)}"
        )


def _time(graph: FactorGraph, key: Key) -> str:
    whole, rest = divmod(graph.stamps_ns[key], 10**9)
    return f"{whole}.{rest:09d}"


def _root(covariance: Matrix) -> Matrix:
    """Upper root S of the information, SᵀS = C⁻¹."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)


def _upper(matrix: Matrix) -> str:
    return _numbers(matrix[np.triu_indices(len(matrix))])


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)
