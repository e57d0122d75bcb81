"""Translate a robot's ROS 2 messages, of a bag or live, into its measurements."""

import re
from collections import Counter
from typing import NamedTuple

import numpy as np

from teamslam.team.datum import Datum
from teamslam.team.geodesy import local_from_geodetic
from teamslam.team.ros2.decoding import (
    FixRecord,
    OdometryRecord,
    PoseRecord,
    Record,
    SpeedRecord,
    Tag,
    TagsRecord,
    Transform,
    TransformsRecord,
)
from teamslam.team.ros2.frames import BODY, OPTICAL, Frames, Mount, Owners, planar
from teamslam.team.ros2.topics import RobotTopics

TAG = re.compile(r"^(?:[^:]*:)?(\d{1,10})$")
"""A tag's name: its number, alone or after its family (tag36h11:7)."""

NO_DATUM = (
    "a fix, since there is no datum: give [datum] with latitude_deg and longitude_deg in the file "
    "of topics, the same for all robots"
)
MOST_NAMED = 20  # most undecided frames that are named


class Pose(NamedTuple):
    """Odometry as its accumulated pose (x, y, θ); truth: a true pose."""

    stamp_ns: int
    x: float
    y: float
    theta: float
    truth: bool = False


class Speeds(NamedTuple):
    """Odometry as speeds that hold until the next message."""

    stamp_ns: int
    forward: float
    yaw_rate: float


class Seen(NamedTuple):
    """Landmarks (numbers) or teammates (names) at points (ahead, left) of the sensor.

    covariances: (xx, xy, yy) of each; empty: none are stated.
    """

    stamp_ns: int
    names: tuple[int, ...] | tuple[str, ...]
    points: tuple[tuple[float, float], ...]
    covariances: tuple[tuple[float, float, float], ...] = ()


class Position(NamedTuple):
    """A fix of the antenna: (x, y) [m] east and north of the datum, covariance (xx, xy, yy)."""

    stamp_ns: int
    x: float
    y: float
    covariance: tuple[float, float, float] | None


Measured = Pose | Speeds | Seen | Position


class Translator:
    """Takes one robot's messages in order of arrival; counts those dropped, by reason.

    mounts: of sensors by frame. antenna: its place (ahead, left) on the base. owners: of the frames
    of shared topics. datum: of fixes, which are dropped without one.
    """

    def __init__(
        self,
        topics: RobotTopics,
        frames: Frames | None = None,
        robot: str = "",
        owners: Owners | None = None,
        datum: Datum | None = None,
    ) -> None:
        self.topics = topics
        self.datum = datum
        self.antenna: tuple[float, float] | None = None
        self.frames = Frames() if frames is None else frames
        self.robot = robot
        self.owners = Owners({robot: topics}, {robot: self.frames}) if owners is None else owners
        self._unclaimed: set[str] = set()
        self._some_decided = False
        self._is_shared = False
        self.dropped: Counter[str] = Counter()
        self.mounts: dict[str, Mount] = {}
        self.said: list[str] = []
        self._two_names = False
        self._guessed: set[str] = set()

    def take(self, topic: str, record: Record) -> list[Measured]:
        """Return the measurements of one message of a topic."""
        topics = self.topics
        found: list[Measured] = []
        if topic == topics.odometry:
            found += self._odometry(record)
        if topic in topics.detections:
            if isinstance(record, TransformsRecord):
                self.owners.add_links([self.robot], self.links(record))
            found += self._detections(topic, record)
        if topic == topics.fixes:
            found += self._fix(record)
        if topic == topics.truth:
            found += self._truth(record)
        return found

    def links(self, record: TransformsRecord) -> list[tuple[str, str]]:
        """Return the (parent, child) of transforms that are no tags'."""
        return [(t.parent, t.child) for t in record.transforms if not self._is_tag(t)]

    def take_static(self, record: TransformsRecord) -> None:
        """Take static transforms; a guessed mount is determined again."""
        for transform in record.transforms:
            self.frames.take(transform)
        self.owners.forget()
        for frame in self._guessed & self.mounts.keys():
            if self.frames.mount(frame, self.topics.base_frame) is not None:
                self._guessed.discard(frame)
                del self.mounts[frame]
                self.said.append(
                    f"the transform from {frame} to {self.topics.base_frame} is here now; what was "
                    "seen before is taken as seen from the base"
                )

    def _odometry(self, record: Record) -> list[Measured]:
        match record:
            case OdometryRecord():
                self.owners.add_odometry(self.robot, record.frame, record.child)
                if self.topics.use == "twist":
                    return [Speeds(record.stamp_ns, record.forward, record.yaw_rate)]
                return [Pose(record.stamp_ns, *planar(record))]
            case SpeedRecord():
                return [Speeds(record.stamp_ns, record.forward, record.yaw_rate)]
            case TransformsRecord():
                ours = (self.topics.odometry_frame, self.topics.base_frame)
                driven = [t for t in record.transforms if (t.parent, t.child) == ours]
                return [Pose(t.stamp_ns, *planar(t)) for t in driven]
            case _:
                self.dropped["no odometry in a message of the odometry topic"] += 1
                return []

    def _truth(self, record: Record) -> list[Measured]:
        match record:
            case OdometryRecord() | PoseRecord():
                return [Pose(record.stamp_ns, *planar(record), truth=True)]
            case TransformsRecord():
                base = [t for t in record.transforms if t.child == self.topics.base_frame]
                return [Pose(t.stamp_ns, *planar(t), truth=True) for t in base]
            case _:
                self.dropped["no pose in a message of the truth topic"] += 1
                return []

    def _fix(self, record: Record) -> list[Measured]:
        if not isinstance(record, FixRecord):
            self.dropped["no fix in a message of the fixes topic"] += 1
            return []
        if record.degrees is None:
            self.dropped["a message of a receiver without a fix"] += 1
            return []
        if self.datum is None:
            self.dropped[NO_DATUM] += 1
            return []
        if self.antenna is None:
            self.antenna = self._antenna_at(record.frame)
        ((x, y),) = local_from_geodetic(self.datum, np.array([record.degrees])).tolist()
        return [Position(record.stamp_ns, x, y, record.covariance)]

    def _antenna_at(self, frame: str) -> tuple[float, float]:
        topics = self.topics
        if topics.antenna is not None:
            return topics.antenna
        found = self.frames.base_from(frame, topics.base_frame)
        if found is not None:
            return float(found[1][0]), float(found[1][1])
        self.said.append(
            f"no transform from {frame or 'the frame without a name'} to {topics.base_frame}: the "
            "antenna is taken to be at the base; give `antenna` if it is not"
        )
        return 0.0, 0.0

    def _detections(self, topic: str, record: Record) -> list[Measured]:
        shared: bool | None = topic in self.owners.shared
        match record:
            case TagsRecord():
                scans = [record]
            case TransformsRecord():
                shared = shared or None
                tags = [t for t in record.transforms if self._is_tag(t)]
                scans = [
                    TagsRecord(t.stamp_ns, t.parent, (Tag(t.child, t.position, None),))
                    for t in tags
                ]
            case _:
                self.dropped["no detection in a message of a detections topic"] += 1
                return []
        ours = (scan for scan in scans if self._is_ours(scan.frame, shared))
        return [seen for scan in ours for seen in self._make_scans(scan)]

    def _is_tag(self, transform: Transform) -> bool:
        return transform.child in self.topics.landmarks or bool(TAG.match(transform.child))

    def _is_ours(self, frame: str, shared: bool | None) -> bool:
        """Whether detections in a frame are this robot's.

        shared: whether other robots have the topic; None: it has transforms, perhaps of unlisted
        robots.
        """
        owner = self.owners.owner(frame)
        if owner == self.robot:
            self._some_decided = True
            return True
        if owner is not None:
            self.dropped[f"a detection in a frame of {owner}"] += 1
            return False
        if self.topics.frames:
            self.dropped["a detection in a frame that `frames` does not list"] += 1
            return False
        if shared is False:
            return True
        self._is_shared |= shared is True
        if len(self._unclaimed) < MOST_NAMED:
            self._unclaimed.add(frame)
        if self.undecided:
            self.dropped["a detection in a frame that hangs from no robot's base"] += 1
        return not self.undecided

    @property
    def undecided(self) -> set[str]:
        """Frames that nothing assigns to a robot, whose detections are dropped."""
        alone = len(self._unclaimed) == 1 and not (self._is_shared or self._some_decided)
        return set() if alone else self._unclaimed

    @property
    def has_detections(self) -> bool:
        """Whether a detection was assigned to this robot by its frame."""
        return self._some_decided

    def question(self) -> str:
        """Describe the undecided frames, with the remedy, or ""."""
        frames = {frame for frame in self._unclaimed if self.owners.owner(frame) is None}
        return self.owners.question(self.robot, frames) if frames and self.undecided else ""

    def _make_scans(self, scan: TagsRecord) -> list[Measured]:
        mount = self._mount(scan.frame)
        numbers, points, claimed = [], [], []
        teammates, places = [], []
        for tag in scan.tags:
            number = self._number(self._name(tag))
            if number is None:
                self.dropped["a detection whose name is no number and not in `landmarks`"] += 1
            elif str(number) in self.topics.teammates:
                teammates.append(self.topics.teammates[str(number)])
                places.append(mount.point(tag.position))
            else:
                numbers.append(number)
                points.append(mount.point(tag.position))
                claimed += [] if tag.covariance is None else [mount.covariance(tag.covariance)]
        found: list[Measured] = []
        if numbers or not teammates:
            covariances = tuple(claimed) if len(claimed) == len(numbers) else ()
            found.append(Seen(scan.stamp_ns, tuple(numbers), tuple(points), covariances))
        if teammates:
            found.append(Seen(scan.stamp_ns, tuple(teammates), tuple(places)))
        return found

    def _name(self, tag: Tag) -> str:
        if not tag.kind or self.topics.names == "class":
            return tag.kind or tag.name
        if not self._two_names and self._number(tag.name) != self._number(tag.kind) is not None:
            self._two_names = True
            self.said.append(
                f"a detection has the id {tag.name} and the class {tag.kind}: its id is taken for "
                'the landmark; give names = "class" if that is the tag\'s number'
            )
        return tag.name

    def _number(self, name: str) -> int | None:
        if name in self.topics.landmarks:
            return self.topics.landmarks[name]
        match = TAG.match(name)
        return int(match[1]) if match and int(match[1]) < 2**31 else None

    def _mount(self, frame: str) -> Mount:
        if frame in self.mounts:
            return self.mounts[frame]
        topics = self.topics
        found = None if topics.mount or topics.optical is not None else self.frames.mount(
            frame, topics.base_frame
        )  # fmt: skip
        if found is None:
            optical = "optical" in frame if topics.optical is None else topics.optical
            place = topics.mount or (0.0, 0.0, 0.0)
            found = Mount(place, OPTICAL if optical else BODY, place)
            if topics.mount is None and frame != topics.base_frame:
                self._guessed.add(frame)
                axes = "z ahead" if optical else "x ahead"
                self.said.append(
                    f"no transform from {frame or 'the frame without a name'} to "
                    f"{topics.base_frame}: the sensor is taken to be at the base with {axes}; "
                    "give `mount` (and `optical`) if it is not"
                )
        for first in self.mounts.values():
            found = found.seen_from(first)
            break
        self.mounts[frame] = found
        return found
