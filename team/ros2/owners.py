"""Assign the frames of detections to robots, for topics that several robots share."""

from collections.abc import Iterable, Mapping

from teamslam.team.ros2.frames import Frames
from teamslam.team.ros2.topics import RobotTopics

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
