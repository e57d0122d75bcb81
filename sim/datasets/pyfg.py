"""Read landmark graphs in the text format of PyFactorGraph.

VERTEX_SE2 t A0 x y theta               true pose 0 of the robot A at time t
VERTEX_XY L3 x y                        true landmark
VERTEX_SE2:PRIOR t A0 x y theta  C      prior of a pose; C: upper triangle of the covariance
EDGE_SE2 t A0 A1 x y theta  C           pose A1 in the frame of A0
EDGE_SE2_XY t A0 L3 x y  C              landmark in the frame of A0

Ranges (EDGE_RANGE) and edges between robots are not used.
https://github.com/MarineRoboticsGroup/PyFactorGraph
"""

import re
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.factor_graph import FactorGraph, Key, Matrix, PointEdge, PoseEdge
from teamslam.sim.datasets.graph_lines import Form, Line, read_lines
from teamslam.team.config import UNNAMED
from teamslam.team.shapes import Float

FORMS = {
    "VERTEX_SE2": Form(2, (3,), "time pose x y theta"),
    "VERTEX_XY": Form(1, (2,), "landmark x y"),
    "VERTEX_SE2:PRIOR": Form(2, (9,), "time pose x y theta and six numbers of the covariance"),
    "EDGE_SE2": Form(3, (9,), "time pose pose x y theta and six numbers of the covariance"),
    "EDGE_SE2_XY": Form(3, (5,), "time pose landmark x y and three numbers of the covariance"),
}
SYMBOL = re.compile("([A-Za-z]+)([0-9]{1,10})")


def is_pyfg(line: Line) -> bool:
    """Whether a graph's line has named vertices, as this format has."""
    return any(SYMBOL.fullmatch(word) for word in line.words[:3])


def read_pyfg(path: Path) -> FactorGraph:
    """Read a file; raises DatasetError with file, line and remedy."""
    graph = FactorGraph(path.stem, are_true=True)
    for line, values in read_lines(path, FORMS, graph):
        _take(line, values, graph)
    return graph


def _take(line: Line, values: Float[np.ndarray, " n"], graph: FactorGraph) -> None:
    match line.keyword:
        case "VERTEX_SE2":
            key = _key(line, 1)
            graph.poses[key] = values
            time = Line(line.name, line.number, line.keyword, line.words[:1]).values(0)[0]
            graph.stamps_ns[key] = round(float(time) * 1e9)
        case "VERTEX_XY":
            graph.landmarks[_key(line, 0)[1]] = values
        case "VERTEX_SE2:PRIOR":
            graph.priors[_key(line, 1)] = values[:3], _matrix(line, values[3:], 3)
        case "EDGE_SE2":
            start, end = _key(line, 1), _key(line, 2)
            graph.pose_edges.append(PoseEdge(start, end, values[:3], _matrix(line, values[3:], 3)))
        case _:
            pose, landmark = _key(line, 1), _key(line, 2)[1]
            graph.point_edges.append(
                PointEdge(pose, landmark, values[:2], _matrix(line, values[2:], 2))
            )


def _key(line: Line, k: int) -> Key:
    found = SYMBOL.fullmatch(line.words[k])
    if found is None or int(found[2]) >= UNNAMED:
        raise line.error(
            f"{line.words[k]!r} is no vertex: a letter and a number, as A0, are expected"
        )
    return found[1], int(found[2])


def _matrix(line: Line, upper: Float[np.ndarray, " u"], size: int) -> Matrix:
    """Symmetric covariance; raises DatasetError if it is not positive definite."""
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    matrix += np.triu(matrix, 1).T
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise line.error("its covariance is not positive definite: correct its last numbers")
    return matrix
