"""Import ROS 2 bags: convert their messages to tables."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from teamslam.sim.importing.bag_topics import UndecidedError, decide_topics, listing
from teamslam.sim.importing.tables import RobotTables
from teamslam.team.datum import Datum
from teamslam.team.ros2.bags import Bag, opened_bag
from teamslam.team.ros2.decoding import (
    DamagedError,
    FixRecord,
    OdometryRecord,
    Record,
    TransformsRecord,
    decode,
)
from teamslam.team.ros2.frames import Frames
from teamslam.team.ros2.keys import moving_topics, static_topics
from teamslam.team.ros2.owners import Owners
from teamslam.team.ros2.topics import Topics
from teamslam.team.ros2.translator import Translator


@dataclass
class Imported:
    """Tables of a bag's robots.

    notes: topics used and omitted, with reasons. messages: number read. datum: origin of fixes.
    """

    robots: list[RobotTables]
    notes: list[str] = field(default_factory=list)
    messages: int = 0
    datum: Datum | None = None


def import_bag(
    path: Path, topics: Topics | None, robot: str | None, datum: Datum | None = None
) -> Imported:
    """Tables of a bag; raises BagError, UndecidedError.

    topics: of each robot; None: from names and types if unambiguous. datum: where the topics give
    none; None: the first fix.
    """
    with opened_bag(path) as bag:
        chosen = topics or decide_topics(bag, path, robot)
        chosen = msgspec.structs.replace(
            chosen, datum=chosen.datum or datum or _first_fix(bag, chosen)
        )
        _check_present(chosen, bag, path)
        return _translated(bag, chosen, path)


def _check_present(topics: Topics, bag: Bag, path: Path) -> None:
    present = {topic.name for topic in bag.topics}
    for role in ("odometry", "truth"):
        of: dict[str, str] = {}
        for name, robot in topics.robots.items():
            topic = getattr(robot, role)
            if topic and of.setdefault(topic, name) != name:
                raise UndecidedError(
                    f"{path}: {topic} is the {role} of both {of[topic]} and {name}: in the file of "
                    "topics (--ros2 FILE) give it to its robot alone"
                )
    for name, robot in topics.robots.items():
        for topic in (robot.odometry, *robot.detections, robot.fixes, robot.truth):
            if topic and topic not in present:
                raise UndecidedError(
                    f"{path}: no topic {topic}, which {name} is to have; there are:\n"
                    + listing(bag.topics)
                )


def _translated(bag: Bag, topics: Topics, path: Path) -> Imported:
    translators = _translators(bag, topics)
    tables = {name: RobotTables(name) for name in topics.robots}
    robots_by_topic: dict[str, list[str]] = {}
    for name, robot in topics.robots.items():
        for topic in {robot.odometry, *robot.detections, robot.fixes, robot.truth} - {""}:
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
    questions = [text for each in translators.values() if (text := each.question())]
    if questions:
        raise UndecidedError(f"{path}: {questions[0]}")
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
        notes += _add_mount(translator, tables[name])
        tables[name].antenna = translator.antenna or (0.0, 0.0)
    has_fixes = any("fixes" in each.rows for each in tables.values())
    datum = topics.datum if has_fixes else None
    return Imported(list(tables.values()), notes, sum(seen.values()), datum)


def _first_fix(bag: Bag, topics: Topics) -> Datum | None:
    """Datum at the first fix of any robot, rounded to 10⁻⁶ degrees."""
    for record in _records(bag, {each.fixes for each in topics.robots.values()} - {""}):
        if isinstance(record, FixRecord) and record.degrees is not None:
            latitude, longitude = (round(each, 6) for each in record.degrees)
            return Datum(latitude, longitude)
    return None


def _translators(bag: Bag, topics: Topics) -> dict[str, Translator]:
    frames = {name: _static_frames(bag, each.odometry) for name, each in topics.robots.items()}
    owners = Owners(topics.robots, frames)
    translators = {
        name: Translator(each, frames[name], name, owners, topics.datum)
        for name, each in topics.robots.items()
    }
    if owners.shared:
        for name, each in topics.robots.items():
            for record in _records(bag, {each.odometry}):
                if isinstance(record, OdometryRecord):
                    owners.add_odometry(name, record.frame, record.child)
                    break
            moving = moving_topics(each.odometry) | owners.shared
            for record in _records(bag, moving):
                if isinstance(record, TransformsRecord):
                    owners.add_links([name], translators[name].links(record))
    return translators


def _stamped(record: Record, arrival_ns: int) -> Record:
    return record if isinstance(record, TransformsRecord) else record._replace(stamp_ns=arrival_ns)


def _add_mount(translator: Translator, tables: RobotTables) -> list[str]:
    if not translator.mounts:
        return []
    tables.mount = next(iter(translator.mounts.values())).pose
    if len({mount.place for mount in translator.mounts.values()}) == 1:
        return []
    return [
        f"{tables.robot}: {len(translator.mounts)} sensors ({', '.join(translator.mounts)}) at "
        f"several places: what they saw is given as seen from the first one's, {tables.mount}"
    ]


def _static_frames(bag: Bag, odometry: str) -> Frames:
    frames = Frames()
    for record in _records(bag, static_topics(odometry)):
        if isinstance(record, TransformsRecord):
            for transform in record.transforms:
                frames.take(transform)
    return frames


def _records(bag: Bag, topics: Collection[str]) -> Iterator[Record]:
    for raw in bag.messages(topics):
        try:
            yield decode(raw.kind, raw.data, bag.store)
        except (DamagedError, KeyError):
            continue
