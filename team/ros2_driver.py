"""A ROS 2 robot's driver, without ROS: its topics on Zenoh become a robot's stream.

Damaged, refused and lost messages are counted and named; none ends the process.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from decimal import Decimal

import numpy as np

from teamslam.team.containment import place_of
from teamslam.team.datum import Datum
from teamslam.team.driver.driver import Driver
from teamslam.team.driver.measurement_messages import MeasurementError
from teamslam.team.ros2.arrivals import MOST_WAITING, Backlog, Lost
from teamslam.team.ros2.decoding import (
    READERS,
    DamagedError,
    OdometryRecord,
    Record,
    TransformsRecord,
    decode,
)
from teamslam.team.ros2.frames import Frames, Owners, describe_misplacement, planar
from teamslam.team.ros2.keys import BRIDGE_TOKENS, expressions, of_rmw, of_token, static_topics
from teamslam.team.ros2.topics import RobotTopics
from teamslam.team.ros2.translator import (
    NO_DATUM,
    Measured,
    Pose,
    Position,
    Seen,
    Speeds,
    Translator,
)
from teamslam.team.wire.zenoh.foreign_keys import ForeignSample

ODOMETRY = "nav_msgs/msg/Odometry"
FIX = "sensor_msgs/msg/NavSatFix"
HELD = 1000  # most waiting messages of a topic of unknown type
MOST_REASONS = 100  # most reasons for dropping that are told apart: a key's type may be any text
WARN_S = 10.0  # interval [s] between two reports of dropped messages
SILENT_S = 10.0  # time [s] after which missing odometry is reported
BEHIND_S = 1.0  # waiting time [s] of a message from which the driver is slower than its topics
NANO = Decimal(10) ** -9
_LOG = logging.getLogger("teamslam")
_MOUNT = (
    "so all landmarks are shifted: write mount = [{place}] into [defaults.sensor], or the robot's "
    "sensor"
)
_ANTENNA = (
    "so all fixes are shifted: write antenna = [{place}] into [defaults.gnss], or the robot's gnss"
)


OnOdometry = Callable[[int, tuple[float, float, float], str, str], None]
"""Called with (stamp [ns], pose (x, y, θ), odometry frame, base frame)."""


class Ros2Driver:
    """Passes the publications on a robot's topics to its driver, in the order of their stamps.

    taken: messages by topic; dropped: by reason; lost: published and never received. datum: origin
    of the plane of the team's fixes, which are dropped without one. name, others: the robot's name,
    and the topics of others, which may be its own, too.
    """

    def __init__(
        self,
        robot: Driver,
        topics: RobotTopics,
        domain: int = 0,
        *,
        name: str = "",
        others: Mapping[str, RobotTopics] | None = None,
        on_odometry: OnOdometry | None = None,
        datum: Datum | None = None,
    ) -> None:
        self._robot = robot
        self._on_odometry = on_odometry
        self._topics = topics
        self._domain = domain
        frames = Frames()
        robots = {**(others or {}), name: topics}
        owners = Owners(robots, dict.fromkeys(robots, frames))
        self._translator = Translator(topics, frames, name, owners, datum)
        self._kinds = dict(topics.types)
        if topics.odometry:
            self._kinds.setdefault(topics.odometry, ODOMETRY)
        if topics.fixes:
            self._kinds.setdefault(topics.fixes, FIX)
        self._held: dict[str, deque[bytes]] = {}
        self._backlog = Backlog()
        self._translated: dict[str, deque[Measured]] = {}
        self._speeds: Speeds | None = None
        self._said: Counter[str] = Counter()
        self._said_at = float("-inf")
        self.taken: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.lost = Lost()
        self._static = static_topics(topics.odometry)
        self._names = {topics.odometry, *topics.detections, topics.fixes, *self._static} - {""}
        self._silent = {topics.odometry} - {""}
        self._began_s = time.monotonic()
        self._undecided_at_s: float | None = None

    @property
    def keys(self) -> list[str]:
        """Key expressions to subscribe to."""
        return expressions(sorted(self._names - self._static), self._domain)

    @property
    def latched(self) -> list[str]:
        """Key expressions of latched topics (static transforms)."""
        return expressions(sorted(self._static), self._domain)

    tokens = (BRIDGE_TOKENS,)

    def take(self, sample: ForeignSample) -> None:
        """Pass on one publication, with all that waited."""
        self.put(sample)
        self.deliver()

    def put(self, sample: ForeignSample) -> None:
        """Queue one publication, or learn a topic's type from a token."""
        if sample.token:
            told = of_token(sample.key)
            if told is not None and sample.alive:
                self._learn(*told)
            return
        named = of_rmw(sample.key, self._domain)
        topic, kind = ("/" + sample.key.strip("/"), "") if named is None else named
        if topic not in self._names:
            return
        self._silent.discard(topic)
        kind = kind[:80] or self._kinds.get(topic, "")
        self.lost.take(topic, sample.attachment)
        if not kind:
            self._held.setdefault(topic, deque(maxlen=HELD)).append(sample.payload)
            self._note(f"{topic}: no bridge has told its type; give it in `types`")
        elif topic in self._static:
            self._translate(topic, kind, sample.payload)
        else:
            self._backlog.put(topic, kind, sample.payload)

    def _learn(self, topic: str, kind: str) -> None:
        if topic in self._names and kind in READERS:
            self._kinds[topic] = kind
            for payload in self._held.pop(topic, ()):
                self._backlog.put(topic, kind, payload)

    @property
    def waiting(self) -> int:
        """Number of waiting messages."""
        return len(self._backlog) + sum(map(len, self._translated.values()))

    def deliver(self, most: int | None = None) -> None:
        """Pass on at most `most` waiting measurements, by stamp; those of one topic as they
        arrived.
        """
        count = 0
        while most is None or count < most:
            earliest = self._earliest()
            if earliest is None:
                return
            count += 1
            try:
                self._hand_over(self._translated[earliest].popleft())
            except (MeasurementError, OverflowError) as error:
                self._note(f"{earliest}: refused", str(error))

    def _earliest(self) -> str | None:
        heads = []
        for topic in self._backlog.waiting:
            queue = self._translated.setdefault(topic, deque())
            while not queue and (arrived := self._backlog.next_of(topic)) is not None:
                queue.extend(self._translate(topic, arrived.kind, arrived.payload))
            if queue:
                heads.append((queue[0].stamp_ns, topic))
        return min(heads)[1] if heads else None

    def _translate(self, topic: str, kind: str, payload: bytes) -> list[Measured]:
        self.taken[topic] += 1
        if kind not in READERS:
            self._note(f"{topic}: messages of type {kind} are not read")
            return []
        try:
            record = decode(kind, payload)
        except DamagedError as error:
            self._note(f"{topic}: damaged", str(error))
            return []
        if topic in self._static:
            if isinstance(record, TransformsRecord):
                self._translator.take_static(record)
            return []
        if self._on_odometry is not None and topic == self._topics.odometry:
            self._report_odometry(_stamp(record))
        try:
            return self._translator.take(topic, _stamp(record))
        except Exception as error:  # a sound message that the translation does not know how to take
            place = place_of(error.__traceback__)
            self._note(f"{topic}: set aside", f"{type(error).__name__} at {place}: {error}")
            return []

    def _report_odometry(self, record: Record) -> None:
        assert self._on_odometry is not None
        if isinstance(record, OdometryRecord):
            self._on_odometry(record.stamp_ns, planar(record), record.frame, record.child)
        elif isinstance(record, TransformsRecord):
            frames = self._topics.odometry_frame, self._topics.base_frame
            for t in record.transforms:
                if (t.parent, t.child) == frames:
                    self._on_odometry(t.stamp_ns, planar(t), *frames)

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
            case Position():
                stated = measured.covariance
                P = None if stated is None else [stated[:2], stated[1:]]
                self._robot.fix(t, measured.x, measured.y, P)
            case _:
                pass

    @property
    def mounts(self) -> list[tuple[float, float, float]]:
        """Assumed poses of the sensor (x [m], y [m], yaw [rad]); empty before a detection."""
        return list(dict.fromkeys(mount.pose for mount in self._translator.mounts.values()))

    def _note(self, reason: str, detail: str = "") -> None:
        if reason not in self.dropped and len(self.dropped) >= MOST_REASONS:
            reason = "for other reasons"
        self.dropped[reason] += 1
        if reason not in self._said and detail:
            _LOG.warning("%s (first: %s)", reason, detail)
            self._said[reason] = self.dropped[reason]

    def figures(self) -> dict[str, float]:
        """Count received, lost, waiting and dropped messages."""
        return {
            "messages": float(self.taken.total()),
            "messages_lost": float(self.lost.count.total()),
            "messages_waiting": float(self.waiting),
            "messages_waiting_s": self._backlog.oldest_s,
            "messages_dropped": float(self.dropped.total() + self._backlog.dropped.total()),
        }

    @property
    def refusal(self) -> str:
        """Text and remedy if, after SILENT_S, no detection can be assigned to this robot; else
        empty.
        """
        question = self._translator.question()
        if not question or self._translator.has_detections:
            self._undecided_at_s = None
            return ""
        now = time.monotonic()
        if self._undecided_at_s is None:
            self._undecided_at_s = now
        return question if now - self._undecided_at_s > SILENT_S else ""

    def warnings(self) -> tuple[str, ...]:
        """Describe lost and late messages, with cause and remedy."""
        said = [
            f"{topic}: {count:,} messages were published and never came, "
            f"{100.0 * count / (count + self.lost.numbered[topic]):.1f} %: a queue of the "
            "publisher's or of a router was full. Free their CPU or link, or publish as reliable "
            "with the history keep_all: then Zenoh waits instead of dropping"
            for topic, count in self.lost.count.items()
        ]
        if time.monotonic() - self._began_s > SILENT_S:
            said += [
                f"{topic}: no message yet: look at its name, at `domain` in the file of topics "
                f"({self._domain} is listened to), and whether rmw_zenoh's router or the bridge is "
                "at --ros2-connect"
                for topic in self._silent
            ]
        configured = self._robot.sensor_mount
        if configured is not None and self.mounts:
            said += describe_misplacement("sensor", self.mounts[0], configured, _MOUNT)
        there, antenna = self._robot.antenna, self._translator.antenna
        if there is not None and antenna is not None:
            said += describe_misplacement("antenna", antenna, there, _ANTENNA)
        if self._translator.dropped[NO_DATUM]:
            said.append(f"{self._translator.dropped[NO_DATUM]:,} dropped: {NO_DATUM}")
        if question := self._translator.question():
            said.append(question)
        late_s = self._backlog.oldest_s
        if late_s > BEHIND_S:
            said.append(
                f"{self.waiting:,} messages wait, the oldest for {late_s:.0f} s: the topics are "
                "faster than this driver. Give it a free core, or throttle them"
            )
        said += [
            f"{topic}: {count:,} messages were dropped, since {MOST_WAITING:,} waited: the topic "
            "is faster than this driver. Give it a free core, or throttle it"
            for topic, count in self._backlog.dropped.items()
        ]
        return tuple(said)

    def report(self) -> None:
        """Log the messages dropped since the last report, at most every WARN_S seconds."""
        now = time.monotonic()
        if now - self._said_at < WARN_S:
            return
        self._said_at = now
        both = self.dropped + self._translator.dropped
        for reason, count in both.items():
            if count > self._said[reason]:
                _LOG.warning("%s: %d messages so far", reason, count)
        self._said = Counter(both)
        for text in self.warnings():
            _LOG.warning("%s", text)
        for text in self._translator.said:
            _LOG.warning("%s", text)
        self._translator.said.clear()


def _stamp(record: Record) -> Record:
    if isinstance(record, TransformsRecord) or record.stamp_ns:
        return record
    return record._replace(stamp_ns=time.time_ns())
