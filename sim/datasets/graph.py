"""Landmark graphs as data sets, in the formats of isam, TORO, g2o and pyfg (docs/your_data.md).

isam and TORO state errors in the axes of the first pose, g2o in those of the measured second one.
https://github.com/RainerKuemmerle/g2o/wiki/File-Format-SLAM-2D
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from teamslam.sim.datasets.factor_graph import (
    FactorGraph,
    Key,
    Matrix,
    PointEdge,
    PoseEdge,
    place_by_odometry,
    split_at_gaps,
    streams_of_graph,
    turn_covariance,
)
from teamslam.sim.datasets.tables import LARGEST, DatasetError
from teamslam.sim.datasets.unlabelled import pieces
from teamslam.sim.world.config import GraphWorld
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import UNNAMED
from teamslam.team.shapes import Float

EXPECTED = "expected a landmark graph of isam, g2o or pyfg"


def is_graph(path: str | Path) -> bool:
    """Whether a file is a graph, by its first keyword."""
    return Path(path).is_file() and _first_line(Path(path)) is not None


def robot_count(path: str) -> int:
    """Number of robots in a graph; raises DatasetError."""
    return max(1, len(_read(path).robots))


def graph_world(world: GraphWorld, robots: int) -> WorldStreams:
    """Streams of the file's robots, or of pieces of its only one; raises DatasetError."""
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
    return replace(found, streams=streams)


def _read(path: str) -> FactorGraph:
    first = _first_line(Path(path)) if Path(path).is_file() else None
    if first is None:
        raise DatasetError(f"{path}: no such file, or not a graph; {EXPECTED}")
    is_pyfg = any(SYMBOL.fullmatch(word) for word in first.words[:3])
    return read_pyfg(Path(path)) if is_pyfg else read_graph(Path(path))


POSES = ("VERTEX_SE2", "VERTEX2")
POSE_EDGES = ("EDGE_SE2", "EDGE2", "ODOMETRY")
POINT_EDGES = ("EDGE_SE2_XY", "LANDMARK")
SPATIAL = ("EDGE3", "VERTEX3", "EDGE_SE3:QUAT", "VERTEX_SE3:QUAT", "EDGE_SE3_XYZ", "VERTEX_XYZ")


class _Form(NamedTuple):
    names: int
    counts: tuple[int, ...]
    words: str


GRAPH_FORMS = {
    **dict.fromkeys(POSES, _Form(1, (3,), "pose x y theta")),
    "VERTEX_XY": _Form(1, (2,), "landmark x y"),
    "FIX": _Form(1, (0,), "pose"),
    **dict.fromkeys(
        POSE_EDGES, _Form(2, (9, 3), "pose pose x y theta and six numbers of the information")
    ),
    **dict.fromkeys(
        POINT_EDGES, _Form(2, (5, 2), "pose landmark x y and three numbers of the information")
    ),
}
TRUTH = "_groundtruth"  # ending of the name of a file's errorless twin
HEAD = 65_536  # bytes in which a graph's first keyword is


class _Line(NamedTuple):
    name: str
    number: int
    keyword: str
    words: Sequence[str]

    @property
    def is_keyword(self) -> bool:
        return self.keyword.replace("_", "").replace(":", "").isupper()

    def error(self, defect: str) -> DatasetError:
        """Error with file, line and text."""
        shown = " ".join([self.keyword, *self.words])[:80]
        return DatasetError(f"{self.name}, line {self.number}: {defect}: `{shown}`")

    def identity(self, k: int) -> int:
        """Word k as an identity."""
        word = self.words[k]
        if not (word.isascii() and word.isdigit() and int(word) < UNNAMED):
            raise self.error(f"{word!r} is no number of a vertex: give 0 to {UNNAMED - 1}")
        return int(word)

    def values(self, first: int) -> Float[np.ndarray, " n"]:
        """Words from `first` on as finite numbers."""
        try:
            found = np.array([float(word) for word in self.words[first:]])
        except ValueError:
            raise self.error("not a number in it: correct the line, or take it out") from None
        if not (np.abs(found) <= LARGEST).all():
            raise self.error("a number is not finite or out of bounds: correct it") from None
        return found


def _lines_of(path: Path, most: int = -1) -> Iterator[_Line]:
    with path.open("rb") as file:
        text = file.read(most).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if words:
            yield _Line(path.name, number, words[0], words[1:])


def _read_lines(
    path: Path, forms: Mapping[str, _Form], graph: FactorGraph
) -> Iterator[tuple[_Line, Float[np.ndarray, " n"]]]:
    """Lines with their numbers; other keywords are counted in the graph; raises DatasetError."""
    for line in _lines_of(path):
        if line.keyword in SPATIAL:
            raise line.error("a graph in three dimensions; planar ones are read")
        form = forms.get(line.keyword)
        if form is None:
            if not line.is_keyword:
                raise line.error(f"no keyword {line.keyword!r}: known are {', '.join(forms)}")
            graph.unused[line.keyword] = graph.unused.get(line.keyword, 0) + 1
            continue
        if len(line.words) - form.names not in form.counts:
            raise line.error(
                f"{len(line.words)} words after {line.keyword}, {form.names + form.counts[0]} "
                f"expected ({form.words}): complete the line, or take it out"
            )
        yield line, line.values(form.names)


def _first_line(path: Path) -> _Line | None:
    """First line of a graph; None for other files."""
    known = {*GRAPH_FORMS, *SPATIAL, "VERTEX_SE2:PRIOR", "EDGE_RANGE"}
    for line in _lines_of(path, HEAD):
        if line.keyword in known:
            return line
        if not line.is_keyword:
            return None
    return None


def read_graph(path: Path) -> FactorGraph:
    """Read a file and its errorless twin NAME_groundtruth; raises DatasetError."""
    graph = _read_numbered(path)
    twin = path.with_name(f"{path.stem}{TRUTH}{path.suffix}")
    if twin.is_file():
        truth = _read_numbered(twin)
        place_by_odometry(truth)
        graph.poses, graph.landmarks, graph.are_true = truth.poses, truth.landmarks, True
    return graph


def _read_numbered(path: Path) -> FactorGraph:
    graph = FactorGraph(path.stem)
    found = list(_read_lines(path, GRAPH_FORMS, graph))
    fixed: list[Key] = []
    is_toro = any(line.keyword == "VERTEX2" for line, _ in found)
    for line, values in found:
        first = ("", line.identity(0))
        if line.keyword in POSES:
            graph.poses[first] = values
        elif line.keyword == "FIX":
            fixed.append(first)
        elif line.keyword == "VERTEX_XY":
            graph.landmarks[first[1]] = values
        elif line.keyword in POSE_EDGES:
            covariance = _covariance(line, values[3:], 3, is_toro=is_toro)
            if line.keyword != "EDGE_SE2":
                covariance = turn_covariance(covariance, values[2])
            edge = PoseEdge(first, ("", line.identity(1)), values[:3], covariance)
            graph.pose_edges.append(edge)
        elif line.keyword in POINT_EDGES:
            covariance = _covariance(line, values[2:], 2, is_toro=is_toro)
            graph.point_edges.append(PointEdge(first, line.identity(1), values[:2], covariance))
    graph.priors = {key: (graph.poses[key], None) for key in fixed if key in graph.poses}
    return split_at_gaps(graph)


def _covariance(
    line: _Line, weights: Float[np.ndarray, " w"], size: int, *, is_toro: bool
) -> Matrix:
    """Invert the stated information; isam states its square root."""
    if not len(weights):
        return np.eye(size)
    if is_toro and size == 3:
        weights = weights[[0, 1, 4, 2, 5, 3]]
    is_root = not (is_toro or line.keyword.startswith("EDGE_SE2"))
    inverse = np.linalg.inv(_definite(line, weights, size, "information", is_root=is_root))
    return np.asarray(0.5 * (inverse + inverse.T))


def _definite(
    line: _Line, weights: Float[np.ndarray, " w"], size: int, thing: str, *, is_root: bool = False
) -> Matrix:
    """Matrix of an upper triangle, or SᵀS of its root S; raises DatasetError."""
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = weights
    matrix = upper.T @ upper if is_root else upper + np.triu(upper, 1).T
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise line.error(f"its {thing} is not positive definite: correct its last numbers")
    return np.asarray(matrix)


PYFG_FORMS = {
    "VERTEX_SE2": _Form(2, (3,), "time pose x y theta"),
    "VERTEX_XY": _Form(1, (2,), "landmark x y"),
    "VERTEX_SE2:PRIOR": _Form(2, (9,), "time pose x y theta and six numbers of the covariance"),
    "EDGE_SE2": _Form(3, (9,), "time pose pose x y theta and six numbers of the covariance"),
    "EDGE_SE2_XY": _Form(3, (5,), "time pose landmark x y and three numbers of the covariance"),
}
SYMBOL = re.compile("([A-Za-z]+)([0-9]{1,10})")


def read_pyfg(path: Path) -> FactorGraph:
    """Read a file; raises DatasetError."""
    graph = FactorGraph(path.stem, are_true=True)
    for line, values in _read_lines(path, PYFG_FORMS, graph):
        _take(line, values, graph)
    return graph


def _take(line: _Line, values: Float[np.ndarray, " n"], graph: FactorGraph) -> None:
    match line.keyword:
        case "VERTEX_SE2":
            key = _key(line, 1)
            graph.poses[key] = values
            time = line._replace(words=line.words[:1]).values(0)[0]
            graph.stamps_ns[key] = round(float(time) * 1e9)
        case "VERTEX_XY":
            graph.landmarks[_key(line, 0)[1]] = values
        case "VERTEX_SE2:PRIOR":
            graph.priors[_key(line, 1)] = values[:3], _definite(line, values[3:], 3, "covariance")
        case "EDGE_SE2":
            start, end = _key(line, 1), _key(line, 2)
            graph.pose_edges.append(
                PoseEdge(start, end, values[:3], _definite(line, values[3:], 3, "covariance"))
            )
        case _:
            pose, landmark = _key(line, 1), _key(line, 2)[1]
            graph.point_edges.append(
                PointEdge(pose, landmark, values[:2], _definite(line, values[2:], 2, "covariance"))
            )


def _key(line: _Line, k: int) -> Key:
    found = SYMBOL.fullmatch(line.words[k])
    if found is None or int(found[2]) >= UNNAMED:
        raise line.error(
            f"{line.words[k]!r} is no vertex: a letter and a number, as A0, are expected"
        )
    return found[1], int(found[2])
