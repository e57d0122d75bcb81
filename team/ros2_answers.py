"""A robot's results for ROS 2: transform, pose, path, landmark map, diagnostics.

Frames follow REP 105. The ROS 2 robot itself publishes odom → base; `Answers` adds

  map_from_odom(t) = map_from_base(t) · odom_from_base(t)⁻¹,

with the robot's pose in the team's frame (`map`) and the odometry's pose at the same time. Once the
robot has left the team's frame, the last transform stays valid.
"""

import hashlib
import time
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from teamslam.team.config import UNNAMED
from teamslam.team.ros2 import encoding as ros
from teamslam.team.ros2.arrivals import attachment
from teamslam.team.ros2.decoding import types
from teamslam.team.ros2.encoding import Names, Pose, compose, inverse, names_of
from teamslam.team.ros2.keys import publication
from teamslam.team.ros2.topics import RobotTopics
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids, landmark_blocks, stamps
from teamslam.team.wire.zenoh.foreign_keys import ForeignKeys

MOST_PATH = 2000  # most poses of a path; a longer one keeps every second pose
PATH_GROWTH, PATH_S = 1.02, 1.0
"""A path is published again once it has grown by this factor, at most every PATH_S of team time."""
MOST_WAITING = 1000  # most messages that wait for `LiveAnswers.publish`
TRANSFORM_S = 0.1
"""Period [s] at which the newest map → odom is repeated with the odometry's newest stamp."""
HELD_S = 30.0
"""Time [s] for which odometry poses are kept, to pair one with a pose in the team's frame."""


class Answer(NamedTuple):
    """One message for a topic; latched: a late subscriber receives the newest one."""

    topic: str
    kind: str
    stamp_ns: int
    data: bytes
    latched: bool = False


@dataclass
class Answers:
    """Converts one robot's results to ROS 2 messages."""

    names: Names
    _odometry: deque[tuple[int, Pose]] = field(default_factory=deque)
    _path: list[tuple[int, Pose]] = field(default_factory=list)
    _spacing: int = 1
    _count: int = 0
    _shown: tuple[int, int] = (0, -(2**62))
    """Length of the newest published path, and its time [ns]."""
    _map_from_odom: Pose | None = None

    def add_odometry(self, stamp_ns: int, pose: Pose) -> None:
        """Add a pose in the odometry's frame; stamps ascend."""
        if self._odometry and stamp_ns <= self._odometry[-1][0]:
            return
        self._odometry.append((stamp_ns, pose))
        while self._odometry[0][0] < stamp_ns - HELD_S * 1e9:
            self._odometry.popleft()

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry pose; None before the first one."""
        return self._odometry[-1][0] if self._odometry else None

    def convert(self, message: m.Message) -> list[Answer]:
        """Convert one of the team's messages; empty where ROS 2 has no counterpart."""
        match message:
            case m.PoseEstimate() if message.in_team_frame:
                return self._pose(message)
            case m.FusedMap():
                return self._map(message)
            case m.Trajectory():
                return self._trajectory(message)
            case m.Status():
                content = ros.diagnostics(
                    message.stamp_ns, message.node, message.state, message.warnings, message.figures
                )
                return [_answer("/diagnostics", message.stamp_ns, content)]
            case _:
                return []

    def _pose(self, message: m.PoseEstimate) -> list[Answer]:
        x, y, theta = floats(message.pose, "pose").tolist()
        pose, P = (x, y, theta), floats(message.covariance, "covariance").reshape(3, 3)
        stamp_ns, names = message.stamp_ns, self.names
        self._extend_path(stamp_ns, pose)
        content = ros.pose_with_covariance(stamp_ns, names.map_frame, pose, P)
        out = [_answer(names.topic("team_pose"), stamp_ns, content), *self._path_if_due(stamp_ns)]
        odom = self._odometry_at(stamp_ns)
        if odom is not None:
            self._map_from_odom = compose(pose, inverse(odom))
        return out + self.transform(stamp_ns)

    def _path_if_due(self, stamp_ns: int) -> list[Answer]:
        length, shown_ns = self._shown
        if self._count < PATH_GROWTH * length or stamp_ns - shown_ns < PATH_S * 1e9:
            return []
        self._shown = self._count, stamp_ns
        content = ros.path(stamp_ns, self.names.map_frame, self._path)
        return [_answer(self.names.topic("team_path"), stamp_ns, content, latched=True)]

    def transform(self, stamp_ns: int) -> list[Answer]:
        """Return the newest map → odom, valid at a time; empty before the first pose in the map."""
        if self._map_from_odom is None:
            return []
        names = self.names
        one = ros.transform(stamp_ns, names.map_frame, names.odometry_frame, self._map_from_odom)
        return [_answer(names.tf, stamp_ns, ros.transforms(one))]

    def _odometry_at(self, stamp_ns: int) -> Pose | None:
        held = self._odometry
        if not held or not held[0][0] <= stamp_ns <= held[-1][0]:
            return None
        k = bisect_left(held, stamp_ns, key=lambda each: each[0])
        after_ns, after = held[k]
        if after_ns == stamp_ns:
            return after
        before_ns, before = held[k - 1]
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        x, y, turn = compose(inverse(before), after)
        return compose(before, (share * x, share * y, share * turn))

    def _extend_path(self, stamp_ns: int, pose: Pose) -> None:
        if self._path and stamp_ns <= self._path[-1][0]:
            return
        if self._count % self._spacing == 0:
            self._path.append((stamp_ns, pose))
        self._count += 1
        if len(self._path) > MOST_PATH:
            self._path, self._spacing = self._path[::2], 2 * self._spacing

    def _trajectory(self, message: m.Trajectory) -> list[Answer]:
        poses = floats(message.poses, "poses").reshape(-1, 3).tolist()
        times = stamps(message.stamps, "stamps").tolist()
        smoothed = [(t, (x, y, theta)) for t, (x, y, theta) in zip(times, poses, strict=True)]
        content = ros.path(message.stamp_ns, self.names.map_frame, smoothed)
        topic = self.names.topic("smoothed_path")
        return [_answer(topic, message.stamp_ns, content, latched=True)]

    def _map(self, message: m.FusedMap) -> list[Answer]:
        numbers = ids(message.ids, "ids").tolist()
        means = floats(message.means, "means").reshape(-1, 2)
        blocks = landmark_blocks(message.covariance, len(numbers), joint=message.joint)
        stamp_ns, frame = message.stamp_ns, self.names.map_frame
        named = [number < UNNAMED for number in numbers]
        labels = [str(n if n < UNNAMED else n - UNNAMED) for n in numbers]
        drawn = ros.markers(stamp_ns, frame, labels, means, blocks, named)
        listed = ros.detections(stamp_ns, frame, [str(n) for n in numbers], means, blocks)
        return [
            _answer(self.names.topic("team_landmarks"), stamp_ns, drawn, latched=True),
            _answer(self.names.topic("team_map"), stamp_ns, listed, latched=True),
        ]


def _answer(topic: str, stamp_ns: int, message: Any, *, latched: bool = False) -> Answer:
    return Answer(topic, message.__msgtype__, stamp_ns, ros.encode(message), latched)


class RosPublisher:
    """Publishes answers on the keys of rmw_zenoh and of the bridge, announced to the ROS graph."""

    def __init__(self, session: ForeignKeys, node: str, domain: int) -> None:
        self._session = session
        self._node = node
        self._domain = domain
        self._keys: dict[str, tuple[str, str, bytes]] = {}
        self._number = 0
        self.published = 0  # number of published messages

    def publish(self, answer: Answer) -> None:
        """Publish one message; the topic is announced with its first one."""
        found = self._keys.get(answer.topic)
        if found is None:
            found = self._keys[answer.topic] = self._announce(answer)
        rmw, bridge, gid = found
        self._number += 1
        attached = attachment(self._number, answer.stamp_ns, gid)
        self._session.publish(rmw, answer.data, attached, latched=answer.latched)
        self._session.publish(bridge, answer.data, latched=answer.latched)
        self.published += 1

    def _announce(self, answer: Answer) -> tuple[str, str, bytes]:
        keys = publication(
            answer.topic,
            answer.kind,
            types().hash_rihs01(answer.kind),
            latched=answer.latched,
            domain=self._domain,
            node=self._node,
            session=self._session.identity,
            entity=len(self._keys) + 1,
        )
        for token in keys.tokens:
            self._session.announce(token)
        return keys.rmw, keys.bridge, hashlib.sha256(keys.tokens[1].encode()).digest()[:16]


class LiveAnswers:
    """Publishes one robot's results to ROS 2 while it drives; has_tf: also map → odom.

    `add_odometry` is called by the reader of the robot's topics, `add_message` by the driver's
    thread; `publish` runs where the session is.
    """

    def __init__(self, robot: str, topics: RobotTopics, *, has_tf: bool = True) -> None:
        self._robot, self._topics, self._has_tf = robot, topics, has_tf
        self._answers = Answers(
            names_of(robot, topics.odometry, topics.odometry_frame, topics.base_frame)
        )
        self._waiting: deque[m.Message] = deque(maxlen=MOST_WAITING)
        self._transformed_s = 0.0

    def add_odometry(self, stamp_ns: int, pose: Pose, frame: str, child: str) -> None:
        """Add a pose in the odometry's frame; the first one determines the frames' names."""
        names = self._answers.names
        if (frame, child) != (names.odometry_frame, names.base_frame) and frame:
            self._answers.names = names_of(self._robot, self._topics.odometry, frame, child)
        self._answers.add_odometry(stamp_ns, pose)

    def add_message(self, message: m.Message) -> None:
        """Add one of the team's messages; the oldest of MOST_WAITING makes room."""
        self._waiting.append(message)

    def publish(self, publisher: RosPublisher) -> None:
        """Publish the answers to all messages that wait, and the newest transform again."""
        while self._waiting:
            for answer in self._answers.convert(self._waiting.popleft()):
                if self._has_tf or answer.kind != "tf2_msgs/msg/TFMessage":
                    publisher.publish(answer)
        now = time.monotonic()
        newest_ns = self._answers.newest_ns
        if self._has_tf and newest_ns is not None and now - self._transformed_s > TRANSFORM_S:
            self._transformed_s = now
            for answer in self._answers.transform(newest_ns):
                publisher.publish(answer)
