"""A ROS 2 robot's driver, with no ROS on our side: its topics on Zenoh become a robot's stream.

What comes is decoded, translated as a bag's messages are, and handed to the driver. Damaged
messages, and what the driver refuses, are counted and named; nothing of it ends the process.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Sequence
from decimal import Decimal
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from team.containment import place_of
from team.driver.measured import MeasurementError
from team.ros2.decoding import READERS, DamagedError, Record, TransformsRecord, decode
from team.ros2.keys import BRIDGE_TOKENS, expressions, of_rmw, of_token
from team.ros2.topics import RobotTopics
from team.ros2.translator import Measured, Pose, Seen, Speeds, Translator
from team.wire.zenoh.foreign import ForeignSample

STATIC = "/tf_static"
ODOMETRY = "nav_msgs/msg/Odometry"
HELD = 1000
"""Messages of a topic whose type no token has told yet."""
MOST_REASONS = 100
"""Reasons for which messages are dropped that are told apart: a key's type may be any text."""
WARN_S = 10.0
"""Between two words about what is dropped."""
NANO = Decimal(10) ** -9
_LOG = logging.getLogger("teamslam")


@runtime_checkable
class Robot(Protocol):
    """What is needed of a driver."""

    def odometry(self, t: Decimal, forward: float, yaw_rate: float) -> None:
        """Speeds since the last call."""

    def odometry_pose(self, t: Decimal, x: float, y: float, theta: float) -> None:
        """The pose in the odometry's frame."""

    def observe_points(
        self, t: Decimal, ids: ArrayLike, xy: ArrayLike, covariances: ArrayLike | None
    ) -> None:
        """Landmarks; covariances: of each its own 2 × 2."""

    def sight(
        self, t: Decimal, teammates: Sequence[str], ranges: ArrayLike, bearings: ArrayLike
    ) -> None:
        """Teammates."""


class Ros2Driver:
    """Takes what is published on a robot's topics, and hands it to its driver.

    taken: messages by topic; dropped: by reason.
    """

    def __init__(self, robot: Robot, topics: RobotTopics, domain: int = 0) -> None:
        self._robot = robot
        self._topics = topics
        self._domain = domain
        self._translator = Translator(topics)
        self._kinds = dict(topics.types)
        if topics.odometry:
            self._kinds.setdefault(topics.odometry, ODOMETRY)
        self._held: dict[str, deque[bytes]] = {}
        self._speeds: Speeds | None = None
        self._said: Counter[str] = Counter()
        self._said_at = float("-inf")
        self.taken: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._names = {topics.odometry, *topics.detections, STATIC} - {""}

    @property
    def keys(self) -> list[str]:
        """What to subscribe to."""
        return expressions(sorted(self._names), self._domain)

    tokens = (BRIDGE_TOKENS,)

    def take(self, sample: ForeignSample) -> None:
        """One publication, or a token that tells a topic's type."""
        if sample.token:
            told = of_token(sample.key)
            if told is not None and sample.alive:
                self._learn(*told)
            return
        named = of_rmw(sample.key, self._domain)
        if named is not None:
            topic, kind = named[0], named[1][:80]
        else:
            topic = "/" + sample.key.strip("/")
            kind = self._kinds.get(topic, "")
            if not kind:
                self._held.setdefault(topic, deque(maxlen=HELD)).append(sample.payload)
                self._note(f"{topic}: no bridge has told its type; give it in `types`")
                return
        self._decoded(topic, kind, sample.payload)

    def _learn(self, topic: str, kind: str) -> None:
        if topic in self._names and kind in READERS:
            self._kinds[topic] = kind
            for payload in self._held.pop(topic, ()):
                self._decoded(topic, kind, payload)

    def _decoded(self, topic: str, kind: str, payload: bytes) -> None:
        if topic not in self._names:
            return
        self.taken[topic] += 1
        if kind not in READERS:
            self._note(f"{topic}: messages of type {kind} are not read")
            return
        try:
            record = decode(kind, payload)
        except DamagedError as error:
            self._note(f"{topic}: damaged", str(error))
            return
        if topic.endswith(STATIC):
            if isinstance(record, TransformsRecord):
                for transform in record.transforms:
                    self._translator.frames.take(transform)
            return
        try:
            found = self._translator.take(topic, _stamped(record))
        except Exception as error:  # a sound message that the translation does not know how to take
            place = place_of(error.__traceback__)
            self._note(f"{topic}: set aside", f"{type(error).__name__} at {place}: {error}")
            return
        for measured in found:
            try:
                self._hand_over(measured)
            except (MeasurementError, OverflowError) as error:
                self._note(f"{topic}: refused", str(error))

    def _hand_over(self, measured: Measured) -> None:
        t = measured.stamp_ns * NANO
        match measured:
            case Pose(truth=False):
                self._robot.odometry_pose(t, measured.x, measured.y, measured.theta)
            case Speeds():
                held = self._speeds or measured
                self._robot.odometry(t, held.forward, held.yaw_rate)
                self._speeds = measured
            case Seen():
                points = np.array(measured.points, dtype=np.float64).reshape(-1, 2)
                teammates = [name for name in measured.names if isinstance(name, str)]
                if teammates:
                    x, y = points.T
                    self._robot.sight(t, teammates, np.hypot(x, y), np.arctan2(y, x))
                else:
                    ids = np.array(measured.names, dtype=np.int64)
                    blocks = [[[xx, xy], [xy, yy]] for xx, xy, yy in measured.covariances]
                    self._robot.observe_points(t, ids, points, blocks or None)
            case _:
                pass

    def _note(self, reason: str, detail: str = "") -> None:
        if reason not in self.dropped and len(self.dropped) >= MOST_REASONS:
            reason = "for other reasons"
        self.dropped[reason] += 1
        if reason not in self._said and detail:
            _LOG.warning("%s (first: %s)", reason, detail)
            self._said[reason] = self.dropped[reason]

    def report(self) -> None:
        """Say what was dropped since the last word, at most every WARN_S seconds."""
        now = time.monotonic()
        if now - self._said_at < WARN_S:
            return
        self._said_at = now
        both = self.dropped + self._translator.dropped
        for reason, count in both.items():
            if count > self._said[reason]:
                _LOG.warning("%s: %d messages so far", reason, count)
        self._said = Counter(both)
        for text in self._translator.said:
            _LOG.warning("%s", text)
        self._translator.said.clear()


def _stamped(record: Record) -> Record:
    """A message without a stamp has the time of its arrival."""
    if isinstance(record, TransformsRecord) or record.stamp_ns:
        return record
    return record._replace(stamp_ns=time.time_ns())
