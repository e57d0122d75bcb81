"""A landmark graph as a data set, cut into one piece per robot."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from teamslam.sim.datasets.factor_graph import (
    FactorGraph,
    Key,
    Matrix,
    PointEdge,
    PoseEdge,
    streams_of_graph,
)
from teamslam.sim.datasets.graph_lines import Form, Line, first_line, read_graph, read_lines
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.datasets.unlabelled import pieces
from teamslam.sim.world.config import GraphWorld, starts_unknown
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import UNNAMED
from teamslam.team.shapes import Float

EXPECTED = "expected a landmark graph of isam, g2o or pyfg"


def is_graph(path: str | Path) -> bool:
    """Whether a file is a graph, by its first keyword."""
    return Path(path).is_file() and first_line(Path(path)) is not None


def robot_count(path: str) -> int:
    """Number of robots in a graph; raises DatasetError."""
    return max(1, len(_read(path).robots))


def graph_world(world: GraphWorld, robots: int) -> WorldStreams:
    """Streams of the file's robots, or of pieces of its only one; raises DatasetError."""
    if not world.path:
        raise DatasetError(f"no data set given: name it with --dataset FILE; {EXPECTED}")
    found = streams_of_graph(_read(world.path))
    streams = found.streams
    if world.duration_s is not None:
        length_ns = round(world.duration_s * 1e9)
        streams = tuple(each.until(each.start_ns + length_ns) for each in streams)
    if len(streams) == 1 < robots:
        if robots > len(streams[0].intervals.end_ns):
            raise DatasetError(
                f"{world.path}: {len(streams[0].intervals.end_ns)} odometry edges can not be cut "
                f"into {robots} pieces: give fewer --robots"
            )
        first, *others = pieces(streams[0], robots)
        streams = (replace(first, start=streams[0].start), *others)
    if robots != len(streams):
        raise DatasetError(
            f"{world.path}: {len(streams)} robots are in it, {robots} asked for: leave --robots out"
        )
    known = (
        replace(each, start=None) if starts_unknown(world, each.robot) else each for each in streams
    )
    return replace(found, streams=tuple(known))


def _read(path: str) -> FactorGraph:
    first = first_line(Path(path)) if Path(path).is_file() else None
    if first is None:
        raise DatasetError(f"{path}: no such file, or not a graph; {EXPECTED}")
    return read_pyfg(Path(path)) if is_pyfg(first) else read_graph(Path(path))


FORMS = {
    "VERTEX_SE2": Form(2, (3,), "time pose x y theta"),
    "VERTEX_XY": Form(1, (2,), "landmark x y"),
    "VERTEX_SE2:PRIOR": Form(2, (9,), "time pose x y theta and six numbers of the covariance"),
    "EDGE_SE2": Form(3, (9,), "time pose pose x y theta and six numbers of the covariance"),
    "EDGE_SE2_XY": Form(3, (5,), "time pose landmark x y and three numbers of the covariance"),
}
SYMBOL = re.compile("([A-Za-z]+)([0-9]{1,10})")


def is_pyfg(line: Line) -> bool:
    """Whether a line has named vertices."""
    return any(SYMBOL.fullmatch(word) for word in line.words[:3])


def read_pyfg(path: Path) -> FactorGraph:
    """Read a file; raises DatasetError."""
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
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    matrix += np.triu(matrix, 1).T
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise line.error("its covariance is not positive definite: correct its last numbers")
    return matrix
