"""Read landmark graphs in the text formats of isam, TORO and g2o.

isam      ODOMETRY | EDGE2 i j x y theta  S_xx S_xy S_xt S_yy S_yt S_tt
          LANDMARK i landmark x y  S_xx S_xy S_yy        S: upper square root of the information
TORO      VERTEX2 i x y theta; EDGE2 i j x y theta  I_xx I_xy I_yy I_tt I_xt I_yt
          LANDMARK as above, with the information I
g2o       VERTEX_SE2 i x y theta; VERTEX_XY landmark x y; FIX i
          EDGE_SE2 i j x y theta  I_xx I_xy I_xt I_yy I_yt I_tt
          EDGE_SE2_XY i landmark x y  I_xx I_xy I_yy

A file with VERTEX2 is TORO's. isam and TORO state errors in the axes of the first pose, g2o in
those of the measured second one. Weights may be left out: then they are 1.
https://github.com/RainerKuemmerle/g2o/wiki/File-Format-SLAM-2D
"""

from collections.abc import Iterator, Mapping, Sequence
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
)
from teamslam.sim.datasets.tables import LARGEST, DatasetError
from teamslam.team.config import UNNAMED
from teamslam.team.shapes import Float

POSES = ("VERTEX_SE2", "VERTEX2")
POSE_EDGES = ("EDGE_SE2", "EDGE2", "ODOMETRY")
POINT_EDGES = ("EDGE_SE2_XY", "LANDMARK")
SPATIAL = ("EDGE3", "VERTEX3", "EDGE_SE3:QUAT", "VERTEX_SE3:QUAT", "EDGE_SE3_XYZ", "VERTEX_XYZ")


class Form(NamedTuple):
    """Words before a line's numbers, counts of numbers, their meaning."""

    names: int
    counts: tuple[int, ...]
    words: str


FORMS = {
    **dict.fromkeys(POSES, Form(1, (3,), "pose x y theta")),
    "VERTEX_XY": Form(1, (2,), "landmark x y"),
    "FIX": Form(1, (0,), "pose"),
    **dict.fromkeys(
        POSE_EDGES, Form(2, (9, 3), "pose pose x y theta and six numbers of the information")
    ),
    **dict.fromkeys(
        POINT_EDGES, Form(2, (5, 2), "pose landmark x y and three numbers of the information")
    ),
}
TRUTH = "_groundtruth"
"""Ending of the name of a file's errorless twin."""
HEAD = 65_536
"""Bytes in which a graph's first keyword is."""


class Line(NamedTuple):
    """Keyword and words of a line, with its place."""

    name: str
    number: int
    keyword: str
    words: Sequence[str]

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


def lines_of(path: Path) -> Iterator[Line]:
    """Lines with a keyword; `#` begins a comment."""
    text = path.read_bytes().decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if words:
            yield Line(path.name, number, words[0], words[1:])


def read_lines(
    path: Path, forms: Mapping[str, Form], graph: FactorGraph
) -> Iterator[tuple[Line, Float[np.ndarray, " n"]]]:
    """Lines with their numbers; other keywords are counted in the graph; raises DatasetError."""
    for line in lines_of(path):
        if line.keyword in SPATIAL:
            raise line.error("a graph in three dimensions; planar ones are read")
        form = forms.get(line.keyword)
        if form is None:
            if not line.keyword.replace("_", "").replace(":", "").isupper():
                raise line.error(f"no keyword {line.keyword!r}: known are {', '.join(forms)}")
            graph.unused[line.keyword] = graph.unused.get(line.keyword, 0) + 1
            continue
        if len(line.words) - form.names not in form.counts:
            raise line.error(
                f"{len(line.words)} words after {line.keyword}, {form.names + form.counts[0]} "
                f"expected ({form.words}): complete the line, or take it out"
            )
        yield line, line.values(form.names)


def first_line(path: Path) -> Line | None:
    """First line of a graph; None for other files."""
    known = {*FORMS, *SPATIAL, "VERTEX_SE2:PRIOR", "EDGE_RANGE"}
    with path.open("rb") as file:
        head = file.read(HEAD).decode("utf-8", errors="replace")
    for number, line in enumerate(head.splitlines(), 1):
        words = line.partition("#")[0].split()
        if words and words[0] in known:
            return Line(path.name, number, words[0], words[1:])
        if words and not words[0].replace("_", "").replace(":", "").isupper():
            return None
    return None


def read_graph(path: Path) -> FactorGraph:
    """Read a file and its errorless twin NAME_groundtruth; raises DatasetError."""
    graph = _read(path)
    twin = path.with_name(f"{path.stem}{TRUTH}{path.suffix}")
    if twin.is_file():
        truth = _read(twin)
        place_by_odometry(truth)
        graph.poses, graph.landmarks, graph.are_true = truth.poses, truth.landmarks, True
    return graph


def _read(path: Path) -> FactorGraph:
    graph = FactorGraph(path.stem)
    found = list(read_lines(path, FORMS, graph))
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
    line: Line, weights: Float[np.ndarray, " w"], size: int, *, is_toro: bool
) -> Matrix:
    """Invert the stated information; isam states its square root."""
    if not len(weights):
        return np.eye(size)
    if is_toro and size == 3:
        weights = weights[[0, 1, 4, 2, 5, 3]]
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = weights
    is_root = not (is_toro or line.keyword.startswith("EDGE_SE2"))
    information = upper.T @ upper if is_root else upper + np.triu(upper, 1).T
    return inverse_of(line, information)


def inverse_of(line: Line, information: Matrix) -> Matrix:
    """Inverse of a positive definite matrix; raises DatasetError."""
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        raise line.error("its information is not positive definite: correct its last numbers")
    inverse = np.linalg.inv(information)
    return np.asarray(0.5 * (inverse + inverse.T))


def turn_covariance(
    covariance: Float[np.ndarray, "*N 3 3"], theta: Float[np.ndarray, "*N"] | float
) -> Float[np.ndarray, "*N 3 3"]:
    """Covariance of a motion, from the axes of its start to those of its end."""
    c, s = np.cos(theta), np.sin(theta)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = np.stack([c, s, zero, -s, c, zero, zero, zero, one], axis=-1)
    R = rows.reshape(*np.shape(theta), 3, 3)
    return np.asarray(R @ covariance @ np.swapaxes(R, -1, -2))
