"""Place a sensor on its robot by transforms, and assign the frames of shared topics to robots."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import atan2, pi, remainder

import numpy as np

from teamslam.team.ros2.decoding import OdometryRecord, PoseRecord, Quaternion, Transform, Vector
from teamslam.team.ros2.topics import RobotTopics
from teamslam.team.shapes import Float

DEEPEST = 32  # most transforms between a sensor and its base


def rotation_matrix(q: Quaternion) -> Float[np.ndarray, "3 3"]:
    """Convert a quaternion (x, y, z, w) of any positive length to a rotation matrix."""
    x, y, z, w = np.array(q) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def heading(q: Quaternion) -> float:
    """Return the yaw of a rotation, in (−π, π]."""
    x, y, z, w = q
    if x == 0.0 and y == 0.0:
        turned = 2.0 * atan2(z, w)
        return atan2(np.sin(turned), np.cos(turned)) if abs(turned) > np.pi else turned
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


Place = tuple[float, float, float]  # a pose (x, y, yaw) on the base


def planar(record: OdometryRecord | PoseRecord | Transform) -> Place:
    """Return the (x, y, yaw) of a record's pose."""
    return record.position[0], record.position[1], heading(record.rotation)


SAME_PLACE = 1e-3  # places that differ by less [m, rad] are the same


@dataclass(frozen=True)
class Mount:
    """Map a sensor's frame to the plane of the robot's sensor: (ahead, left) by 2 × 3, then a
    shift.

    pose: of the robot's sensor on the base. place: of this sensor (`seen_from`).
    """

    pose: Place
    plane: Float[np.ndarray, "2 3"]
    place: Place
    shift: tuple[float, float] = (0.0, 0.0)

    def point(self, position: Vector) -> tuple[float, float]:
        """Map a position in the sensor's frame to (ahead, left)."""
        if self.plane is BODY and self.shift == (0.0, 0.0):
            return position[0], position[1]
        ahead, left = self.plane @ np.array(position)
        return float(ahead) + self.shift[0], float(left) + self.shift[1]

    def seen_from(self, first: "Mount") -> "Mount":
        """Return the same sensor with its points given from another one's place."""
        if self.place == first.pose:
            return self
        (x, y, yaw), (ox, oy, other) = self.place, first.pose
        c, s = np.cos(other), np.sin(other)
        shift = float(c * (x - ox) + s * (y - oy)), float(c * (y - oy) - s * (x - ox))
        c, s = np.cos(yaw - other), np.sin(yaw - other)
        return Mount(first.pose, np.array([[c, -s], [s, c]]) @ self.plane, self.place, shift)

    def covariance(self, block: tuple[float, ...]) -> tuple[float, float, float]:
        """Map a covariance of (x, y, z) to (xx, xy, yy) in the plane."""
        c = self.plane @ np.array(block).reshape(3, 3) @ self.plane.T
        return float(c[0, 0]), float(c[0, 1]), float(c[1, 1])


BODY = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a frame with x ahead and y left
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""A camera's frame, with z ahead and x right."""


@dataclass
class Frames:
    """Static transforms: each frame's pose in its parent; moving: parents that may change."""

    parents: dict[str, Transform] = field(default_factory=dict)
    moving: dict[str, str] = field(default_factory=dict)

    def take(self, transform: Transform) -> None:
        """Add a static transform."""
        self.parents[transform.child] = transform

    def above(self, frame: str) -> list[str]:
        """Return the frame and its ancestors, by transforms of both kinds."""
        found = [frame]
        while len(found) < DEEPEST:
            parent = self.parents[frame].parent if frame in self.parents else self.moving.get(frame)
            if parent is None:
                break
            found.append(frame := parent)
        return found

    def base_from(
        self, frame: str, base: str
    ) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
        """Return rotation and translation from a frame to the base; None without a chain.

        By a common ancestor: base_from_frame = ancestor_from_base⁻¹ ancestor_from_frame.
        """
        ours, theirs = self._ancestors(frame), self._ancestors(base)
        for ancestor, (rotation, moved) in ours.items():
            if ancestor == base:
                return rotation, moved
            if ancestor in theirs:
                turn, at = theirs[ancestor]
                return turn.T @ rotation, turn.T @ (moved - at)
        return None

    def _ancestors(
        self, frame: str
    ) -> dict[str, tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
        """The frame and its ancestors, with rotation and translation to each."""
        rotation, moved = np.eye(3), np.zeros(3)
        found = {frame: (rotation, moved)}
        while frame in self.parents and len(found) < DEEPEST:
            step = self.parents[frame]
            turn = rotation_matrix(step.rotation)
            rotation, moved = turn @ rotation, turn @ moved + np.array(step.position)
            frame = step.parent
            found[frame] = rotation, moved
        return found

    def mount(self, frame: str, base: str) -> Mount | None:
        """Mount of the sensor with this frame; with a level z axis it is a camera's."""
        found = self.base_from(frame, base)
        if found is None:
            return None
        rotation, moved = found
        level = np.hypot(*rotation[:2, 2]) > abs(rotation[2, 2])
        ahead = rotation[:2, 2] if level else rotation[:2, 0]
        yaw = float(atan2(ahead[1], ahead[0]))
        c, s = np.cos(yaw), np.sin(yaw)
        plane = np.array([[c, s], [-s, c]]) @ rotation[:2]
        exact = np.abs(plane - BODY).max() < 1e-12
        place = float(moved[0]), float(moved[1]), yaw
        return Mount(place, BODY if exact else plane, place)


def describe_misplacement(
    sensor: str, here: Sequence[float], configured: Sequence[float], remedy: str
) -> list[str]:
    """Warn if the frames and the scenario place a sensor differently: (x, y) or (x, y, yaw)."""
    apart = [a - b for a, b in zip(here, configured, strict=True)]
    apart[2:] = [remainder(each, 2.0 * pi) for each in apart[2:]]
    if max(map(abs, apart)) < SAME_PLACE:
        return []
    place, other = (", ".join(f"{value:.4g}" for value in each) for each in (here, configured))
    return [
        f"the {sensor} is at ({place}) on the base by its frames, and the scenario has it at "
        f"({other}), {remedy.format(place=place)}, and start the team again"
    ]


MOST_FRAMES = 10_000


class Owners:
    """The robot to whose base each frame is attached.

    trees: the transforms on each robot's topics. A frame is a robot's if `frames` lists it; else if
    the first of all robots' base and odometry frames above it is this robot's, or if its transform
    to this robot's base is rigid. A base or odometry frame of two robots decides nothing.
    """

    def __init__(self, robots: Mapping[str, RobotTopics], trees: Mapping[str, Frames]) -> None:
        self._robots = robots
        self._trees = trees
        self._bases = {name: {topics.base_frame} for name, topics in robots.items()}
        self._origins = {name: {topics.odometry_frame} for name, topics in robots.items()}
        self._found: dict[str, str | None] = {}
        listed = [topic for topics in robots.values() for topic in set(topics.detections)]
        self.shared = frozenset(topic for topic in listed if listed.count(topic) > 1)

    def add_odometry(self, robot: str, frame: str, child: str) -> None:
        """Add the frames of a robot's odometry message: `child`'s pose in `frame`."""
        child, frame = child.lstrip("/"), frame.lstrip("/")
        if child not in self._bases[robot] or frame not in self._origins[robot]:
            self._bases[robot].add(child)
            self._origins[robot].add(frame)
            self._found.clear()

    def add_links(self, robots: Iterable[str], links: Iterable[tuple[str, str]]) -> None:
        """Add transforms (parent, child), which may change with time, to robots' trees."""
        for robot in robots:
            moving = self._trees[robot].moving
            for parent, child in links:
                if moving.get(child) != parent and len(moving) < MOST_FRAMES:
                    moving[child] = parent
                    self._found.clear()

    def forget(self) -> None:
        """Clear the decisions after a change of a tree."""
        self._found.clear()

    def owner(self, frame: str) -> str | None:
        """Return the robot of a frame; None: undecided."""
        if frame not in self._found:
            if len(self._found) >= MOST_FRAMES:
                self._found.clear()
            claims = [name for name in self._robots if self._claims(name, frame)]
            self._found[frame] = claims[0] if len(claims) == 1 else None
        return self._found[frame]

    def _claims(self, robot: str, frame: str) -> bool:
        if self._robots[robot].frames:
            return frame in self._robots[robot].frames
        tree = self._trees[robot]
        anchors = self._only(self._bases) | self._only(self._origins)
        for above in tree.above(frame):
            if above in anchors:
                return anchors[above] == robot
        bases = [base for base, name in self._only(self._bases).items() if name == robot]
        return any(tree.base_from(frame, base) is not None for base in bases)

    def _only(self, frames: Mapping[str, set[str]]) -> dict[str, str]:
        found: dict[str, list[str]] = {}
        for name, each in frames.items():
            for frame in each - {""}:
                found.setdefault(frame, []).append(name)
        return {frame: names[0] for frame, names in found.items() if len(names) == 1}

    def question(self, robot: str, frames: Iterable[str]) -> str:
        """Describe detections in undecided frames, with the remedy."""
        named = ", ".join(frame or "(without a name)" for frame in sorted(frames))
        bases = "; ".join(
            f"{name}: {' or '.join(sorted(each))}" for name, each in self._bases.items()
        )
        listed = ", ".join(f'"{frame}"' for frame in sorted(frames))
        return (
            f"whose detections are those in the frames {named}? No transforms lead from them to "
            f"the base of one robot alone ({bases}). Give each robot its base_frame and the "
            f"transforms (/tf_static), or list in the file of topics the frames of its detections: "
            f"[robots.{robot}] frames = [{listed}]"
        )
