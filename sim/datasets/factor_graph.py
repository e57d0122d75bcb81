"""A planar landmark graph: poses, odometry between them, points measured from them.

As measurements, an odometry edge is an increment, and the points from a pose are one scan.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from teamslam.sim.datasets.tables import DatasetError, Scans, count_note, first_of_each, on_circle
from teamslam.sim.world.streams import RobotStream, StartPose, WorldStreams, moved, no_detections
from teamslam.team.shapes import Float

STEP_NS = 1_000_000_000  # time between two poses [ns] of a graph without times
Pose = Float[np.ndarray, "3"]
Point = Float[np.ndarray, "2"]
Matrix = Float[np.ndarray, "n n"]
Key = tuple[str, int]  # robot and number of a pose


@dataclass(frozen=True)
class PoseEdge:
    """Pose `end` in the frame of `start`; covariance of an error in the frame of the end."""

    start: Key
    end: Key
    motion: Pose
    covariance: Matrix


@dataclass(frozen=True)
class PointEdge:
    """Landmark seen from a pose, as a point in its frame."""

    pose: Key
    landmark: int
    point: Point
    covariance: Matrix


@dataclass
class FactorGraph:
    """Edges in the order of the file, and vertices.

    poses, landmarks: initial values, or true ones. priors: initial poses with covariance; None:
    exact. unused: counts of lines by keyword.
    """

    name: str
    pose_edges: list[PoseEdge] = field(default_factory=list)
    point_edges: list[PointEdge] = field(default_factory=list)
    poses: dict[Key, Pose] = field(default_factory=dict)
    landmarks: dict[int, Point] = field(default_factory=dict)
    priors: dict[Key, tuple[Pose, Matrix | None]] = field(default_factory=dict)
    stamps_ns: dict[Key, int] = field(default_factory=dict)
    unused: dict[str, int] = field(default_factory=dict)
    are_true: bool = False

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots that have poses."""
        return tuple(sorted({edge.start[0] for edge in self.pose_edges}))

    def chain(self, robot: str) -> tuple[list[Key], list[PoseEdge]]:
        """A robot's poses by number, and the odometry edges between them; raises DatasetError."""
        keys = {key for e in self.pose_edges for key in (e.start, e.end) if key[0] == robot}
        keys |= {edge.pose for edge in self.point_edges if edge.pose[0] == robot}
        ordered = sorted(keys)
        links: dict[tuple[Key, Key], PoseEdge] = {}
        for edge in self.pose_edges:
            links.setdefault((edge.start, edge.end), edge)
        for before, after in pairwise(ordered):
            if (before, after) not in links:
                raise DatasetError(
                    f"{self.name}: no edge from pose {_show_key(before)} to pose "
                    f"{_show_key(after)}: a robot's odometry links each pose to the next; number "
                    "the poses in order, or cut the file there"
                )
        return ordered, [links[pair] for pair in pairwise(ordered)]


def _show_key(key: Key) -> str:
    return f"{key[0]}{key[1]}"


def split_at_gaps(graph: FactorGraph) -> FactorGraph:
    """Make robots of poses with numbers alone, split where no edge leads on."""
    links = {(edge.start, edge.end) for edge in graph.pose_edges}
    keys = sorted({key for link in links for key in link} | {e.pose for e in graph.point_edges})
    ends = [after for before, after in pairwise(keys) if (before, after) not in links]
    if not ends:
        return graph
    robots = np.searchsorted([number for _, number in ends], [k for _, k in keys], side="right")
    new = {key: (f"{robot + 1}:", key[1]) for key, robot in zip(keys, robots, strict=True)}
    return replace(
        graph,
        pose_edges=[replace(e, start=new[e.start], end=new[e.end]) for e in graph.pose_edges],
        point_edges=[replace(e, pose=new[e.pose]) for e in graph.point_edges],
        poses={new[key]: pose for key, pose in graph.poses.items() if key in new},
        priors={new[key]: prior for key, prior in graph.priors.items() if key in new},
    )


def place_by_odometry(graph: FactorGraph) -> None:
    """Place missing vertices by odometry, and landmarks by their first edge."""
    for robot in graph.robots:
        keys, edges = graph.chain(robot)
        pose = graph.poses.setdefault(keys[0], np.zeros(3))
        for edge in edges:
            heading = on_circle(pose[2:] + edge.motion[2:])
            end = np.concatenate((_place_point(pose, edge.motion[:2]), heading))
            pose = graph.poses.setdefault(edge.end, end)
    for seen in graph.point_edges:
        graph.landmarks.setdefault(seen.landmark, _place_point(graph.poses[seen.pose], seen.point))


def _place_point(pose: Pose, point: Point) -> Point:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(pose[:2] + np.array([[c, -s], [s, c]]) @ point)


def streams_of_graph(graph: FactorGraph) -> WorldStreams:
    """Measurements of robots r1, r2, …; raises DatasetError.

    The first robot starts at its prior, its first vertex, or the origin; others at their priors.
    """
    if not graph.point_edges:
        raise DatasetError(
            f"{graph.name}: no landmark is measured in it (LANDMARK, EDGE_SE2_XY), and "
            "loop closures between poses are not used: give a graph with landmarks"
        )
    robots = graph.robots
    names = tuple(f"r{number}" for number in range(1, len(robots) + 1))
    found = [_stream(graph, robot, name, names) for robot, name in zip(robots, names, strict=True)]
    placed = graph.landmarks if graph.are_true else {}
    ids = sorted({edge.landmark for edge in graph.point_edges} & set(placed))
    closures = len(graph.pose_edges) - sum(len(each.intervals.end_ns) for each in found)
    notes = [
        count_note(closures, "edge", "between poses not used: no odometry"),
        *(f"{keyword}: {count_note(n, 'line', 'not used')}" for keyword, n in graph.unused.items()),
    ]
    if robots != ("",):
        pairs = zip(names, robots, strict=True)
        notes.append(", ".join(f"{name} is {robot} of the file" for name, robot in pairs))
    return WorldStreams(
        streams=tuple(found),
        landmark_ids=np.array(ids, dtype=np.uint32),
        landmarks=np.array([placed[i] for i in ids]) if ids else None,
        source=f"data set {graph.name}",
        notes=tuple(note for note in notes if note),
    )


def _stream(graph: FactorGraph, robot: str, name: str, names: tuple[str, ...]) -> RobotStream:
    keys, edges = graph.chain(robot)
    stamps = np.arange(len(keys), dtype=np.int64) * STEP_NS
    if all(key in graph.stamps_ns for key in keys):
        stated = np.array([graph.stamps_ns[key] for key in keys])
        stamps = stated if (np.diff(stated) > 0).all() else stamps
    at = dict(zip(keys, stamps.tolist(), strict=True))
    scans, dropped = _scans([edge for edge in graph.point_edges if edge.pose[0] == robot], at)
    true = [graph.poses[key] for key in keys if graph.are_true and key in graph.poses]
    has_truth = len(true) == len(keys)
    start = graph.priors.get(keys[0])
    if start is None and name == names[0]:
        start = graph.poses.get(keys[0], np.zeros(3)), None
    motions = np.array([edge.motion for edge in edges])
    covariances = np.array([edge.covariance for edge in edges])
    return RobotStream(
        robot=name,
        start_ns=int(stamps[0]),
        start=None if start is None else StartPose(*start),
        intervals=moved(stamps[1:], np.diff(stamps), motions, covariances),
        landmark_detections=scans.grouped(),
        teammate_detections=no_detections(),
        teammates=names,
        truth_ns=stamps if has_truth else None,
        truth=np.array(true) if has_truth else None,
        notes=(dropped,) if dropped else (),
    )


def _scans(edges: Sequence[PointEdge], at: Mapping[Key, int]) -> tuple[Scans, str]:
    edges = sorted(edges, key=lambda edge: at[edge.pose])
    points = np.array([edge.point for edge in edges]).reshape(-1, 2)
    scans = Scans(
        stamps_ns=np.array([at[edge.pose] for edge in edges], dtype=np.int64),
        ids=np.array([edge.landmark for edge in edges], dtype=np.uint32),
        ranges=np.hypot(*points.T),
        bearings=on_circle(np.arctan2(points[:, 1], points[:, 0])),
        points=points,
        covariances=np.array([e.covariance[np.triu_indices(2)] for e in edges]).reshape(-1, 3),
    )
    single = first_of_each(scans.stamps_ns, scans.ids, scans.ranges > 0.0)
    lost = count_note(int((~single).sum()), "point", "dropped: repeated, or at the pose itself")
    return scans.where(single), lost


def turn_covariance(
    covariance: Float[np.ndarray, "*N 3 3"], theta: Float[np.ndarray, "*N"] | float
) -> Float[np.ndarray, "*N 3 3"]:
    """Covariance of a motion, from the axes of its start to those of its end."""
    c, s = np.cos(theta), np.sin(theta)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = np.stack([c, s, zero, -s, c, zero, zero, zero, one], axis=-1)
    R = rows.reshape(*np.shape(theta), 3, 3)
    return np.asarray(R @ covariance @ np.swapaxes(R, -1, -2))
