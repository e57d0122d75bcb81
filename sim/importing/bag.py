"""ROS 2 bags → tables: finds the topics, and converts their messages."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from sim.datasets.tables import DatasetError
from sim.importing.tables import RobotTables
from team.ros2.bags import Bag, Topic, opened_bag
from team.ros2.decoding import READERS, DamagedError, Record, TransformsRecord, decode
from team.ros2.frames import Frames
from team.ros2.topics import RobotTopics, Topics
from team.ros2.translator import TAG, Translator

ODOMETRY = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped")
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
STATIC = "tf_static"
TRUTH_WORDS = ("truth", "gt", "mocap", "vicon", "vrpn", "optitrack")
SAMPLED_MESSAGES = 2000
"""Number of messages of /tf that are searched for tags."""


class UndecidedError(DatasetError):
    """The names and types of a bag's topics do not decide which are used; the text says what to
    type.
    """


@dataclass
class Imported:
    """The tables of a bag's robots.

    notes: what was used, what was left out and why, in words. messages: number of messages that
    were read.
    """

    robots: list[RobotTables]
    notes: list[str] = field(default_factory=list)
    messages: int = 0


def imported_bag(path: Path, topics: Topics | None, robot: str | None) -> Imported:
    """The tables of a bag; raises BagError, UndecidedError.

    topics: each robot's topics; None: as their names and types propose them, if there is one way
    only. robot: the name of the bag's only robot.
    """
    with opened_bag(path) as bag:
        chosen = topics or decided(bag, path, robot)
        _check_present(chosen, bag, path)
        return _translated(bag, chosen)


def _check_present(topics: Topics, bag: Bag, path: Path) -> None:
    present = {topic.name for topic in bag.topics}
    for name, robot in topics.robots.items():
        for topic in (robot.odometry, *robot.detections, robot.truth):
            if topic and topic not in present:
                raise UndecidedError(
                    f"{path}: no topic {topic}, which {name} is to have; there are:\n"
                    + listing(bag.topics)
                )


def _translated(bag: Bag, topics: Topics) -> Imported:
    frames = _static_frames(bag)
    translators = {name: Translator(each, frames) for name, each in topics.robots.items()}
    tables = {name: RobotTables(name) for name in topics.robots}
    robots_by_topic: dict[str, list[str]] = {}
    for name, robot in topics.robots.items():
        for topic in {robot.odometry, *robot.detections, robot.truth} - {""}:
            robots_by_topic.setdefault(topic, []).append(name)
    damaged: Counter[str] = Counter()
    first: dict[str, str] = {}
    unstamped: Counter[str] = Counter()
    seen: Counter[str] = Counter()
    for raw in bag.messages(list(robots_by_topic)):
        seen[raw.topic] += 1
        try:
            record = decode(raw.kind, raw.data, bag.store)
        except (DamagedError, KeyError) as error:
            damaged[raw.topic] += 1
            first.setdefault(raw.topic, f"message {seen[raw.topic]}: {error}")
            continue
        if getattr(record, "stamp_ns", 1) == 0:
            record = _stamped(record, raw.arrival_ns)
            unstamped[raw.topic] += 1
        for name in robots_by_topic[raw.topic]:
            for measured in translators[name].take(raw.topic, record):
                tables[name].take(measured)
    notes = [
        f"{topic}: {count} of {seen[topic]} messages dropped: damaged (first: {first[topic]})"
        for topic, count in sorted(damaged.items())
    ]
    notes += [
        f"{topic}: {count} messages without a stamp: their time of arrival is taken"
        for topic, count in sorted(unstamped.items())
    ]
    for name, translator in translators.items():
        notes += [f"{name}: {note}" for note in translator.said]
        notes += [f"{name}: {count} dropped: {why}" for why, count in translator.dropped.items()]
        notes += _mounted(translator, tables[name])
    return Imported(list(tables.values()), notes, sum(seen.values()))


def _stamped(record: Record, arrival_ns: int) -> Record:
    return record if isinstance(record, TransformsRecord) else record._replace(stamp_ns=arrival_ns)


def _mounted(translator: Translator, tables: RobotTables) -> list[str]:
    """Takes the mount of the robot's sensor into the tables; of several, that of most frames.
    Returns notes.
    """
    poses = list(dict.fromkeys(mount.pose for mount in translator.mounts.values()))
    if not poses:
        return []
    tables.mount = poses[0]
    if len(poses) == 1:
        return []
    return [f"{tables.robot}: sensors at {len(poses)} places; all are taken to be at {poses[0]}"]


def _static_frames(bag: Bag) -> Frames:
    frames = Frames()
    static = [topic.name for topic in bag.topics if topic.name.rpartition("/")[2] == STATIC]
    for raw in bag.messages(static):
        try:
            record = decode(raw.kind, raw.data, bag.store)
        except (DamagedError, KeyError):
            continue
        if isinstance(record, TransformsRecord):
            for transform in record.transforms:
                frames.take(transform)
    return frames


def proposed_topics(path: Path) -> str:
    """A bag's topics, and a proposal for the file that assigns them; raises BagError."""
    with opened_bag(path) as bag:
        robots, warnings = _proposed(bag, None)
        return _question(path, bag, robots, warnings)


def decided(bag: Bag, path: Path, robot: str | None) -> Topics:
    """The topics of each robot by their names and types; raises UndecidedError where they do not
    decide.
    """
    robots, warnings = _proposed(bag, robot)
    if warnings:
        raise UndecidedError(_question(path, bag, robots, warnings))
    return Topics(robots=robots)


def _question(path: Path, bag: Bag, robots: dict[str, RobotTopics], warnings: list[str]) -> str:
    return (
        f"{path}: which topics are what?\n{listing(bag.topics)}\n"
        + "".join(f"{doubt}\n" for doubt in warnings)
        + "Write it into a file, as topics.toml, beginning with this:\n\n"
        + as_toml(robots)
        + f"\nand type: teamslam import {path} -o FOLDER --ros2 topics.toml\n"
    )


def _proposed(bag: Bag, robot: str | None) -> tuple[dict[str, RobotTopics], list[str]]:
    """The topics of each robot as their names and types propose them, and what is ambiguous."""
    found = bag.topics
    tagged = _tags_in(bag)
    robots: dict[str, RobotTopics] = {}
    warnings: list[str] = []
    spaces = sorted({_namespace(topic.name) for topic in found if topic.kind in ODOMETRY})
    for space in spaces:
        odometry, detections, truth = _candidates(found, tagged, space, alone=len(spaces) == 1)
        name = _robot_name(space, robot if len(spaces) == 1 else None)
        if len(odometry) != 1:
            warnings.append(f"{name}: {len(odometry)} topics may be its odometry")
        if not detections:
            warnings.append(f"{name}: no topic with detections of landmarks")
        if len(truth) > 1:
            warnings.append(f"{name}: {len(truth)} topics may be its truth")
        robots[name] = RobotTopics(
            odometry=odometry[0] if odometry else "/odom",
            detections=tuple(detections),
            truth=truth[0] if truth else "",
        )
    if not spaces:
        warnings.append("no topic with odometry")
        robots[robot or "r1"] = RobotTopics(odometry="/odom", detections=("/detections",))
    return robots, warnings


def _candidates(
    topics: list[Topic], tagged: set[str], space: str, *, alone: bool
) -> tuple[list[str], list[str], list[str]]:
    """The candidates for odometry, detections and truth in one namespace."""
    here = [topic for topic in topics if alone or _namespace(topic.name) == space]
    true = [topic.name for topic in here if _is_truth(topic) and topic.kind in (*ODOMETRY, *POSES)]
    odometry = [t.name for t in here if t.kind in ODOMETRY and t.name not in true]
    other = (*ODOMETRY, *POSES, TRANSFORMS, "geometry_msgs/msg/TransformStamped")
    detections = [t.name for t in here if t.kind in READERS and t.kind not in other]
    detections += [t.name for t in here if t.name in tagged]
    return odometry, detections, true


def _is_truth(topic: Topic) -> bool:
    words = topic.name.lower().replace("/", "_").split("_")
    return any(word in words for word in TRUTH_WORDS)


def _namespace(topic: str) -> str:
    """The first part of /r1/odom; empty for /odom and /odometry/filtered."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 and not parts[0].startswith("odom") else ""


def _robot_name(space: str, robot: str | None) -> str:
    cleaned = "".join(c if c.isalnum() else "_" for c in space.lower())[:32]
    usable = cleaned and cleaned[0].isalpha() and cleaned.isascii()
    return robot or (cleaned if usable else "r1")


def _tags_in(bag: Bag) -> set[str]:
    """The topics of transforms that contain tags."""
    found = set()
    for topic in bag.topics:
        if topic.kind != TRANSFORMS or topic.name.rpartition("/")[2] == STATIC:
            continue
        for number, raw in enumerate(bag.messages([topic.name])):
            if number == SAMPLED_MESSAGES:
                break
            try:
                record = decode(raw.kind, raw.data, bag.store)
            except DamagedError:
                continue
            assert isinstance(record, TransformsRecord)
            if any(TAG.match(transform.child) for transform in record.transforms):
                found.add(topic.name)
                break
    return found


def listing(topics: list[Topic]) -> str:
    """A bag's topics, one a line, with a remark where a topic can not be used."""
    lines = []
    for topic in topics:
        used = "" if topic.kind in READERS else "   (not read here)"
        lines.append(f"  {topic.name}   {topic.kind}   {topic.messages} messages{used}")
    return "\n".join(lines)


def as_toml(robots: dict[str, RobotTopics]) -> str:
    """The file that assigns topics to robots, in TOML."""
    lines = []
    for name, topics in robots.items():
        detections = ", ".join(f'"{topic}"' for topic in topics.detections)
        lines += [
            f"[robots.{name}]",
            f'odometry = "{topics.odometry}"',
            'use = "pose"           # or "twist": speeds that hold until the next message',
            f"detections = [{detections}]",
        ]
        lines += [f'truth = "{topics.truth}"'] if topics.truth else []
        lines += ['base_frame = "base_link"', ""]
    return "\n".join(lines)
