"""A landmark graph as a data set, cut into one piece per robot."""

from dataclasses import replace
from pathlib import Path

from teamslam.sim.datasets.factor_graph import FactorGraph, streams_of_graph
from teamslam.sim.datasets.graph_lines import first_line, read_graph
from teamslam.sim.datasets.pyfg import is_pyfg, read_pyfg
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.datasets.unlabelled import pieces
from teamslam.sim.world.config import GraphWorld, starts_unknown
from teamslam.sim.world.streams import WorldStreams

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
