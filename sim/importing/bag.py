"""Import ROS 2 bags: convert their messages to tables."""

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.tables import FUSED_WORDS, TRUTH_WORDS, Report, RobotTables, has_word
from teamslam.team.datum import Datum
from teamslam.team.ros2.bags import Bag, Topic, opened_bag
from teamslam.team.ros2.decoding import (
    READERS,
    DamagedError,
    FixRecord,
    OdometryRecord,
    Record,
    TransformsRecord,
    decode,
)
from teamslam.team.ros2.frames import Frames, Owners
from teamslam.team.ros2.keys import STATIC, moving_topics, static_topics
from teamslam.team.ros2.topics import RobotTopics, Topics
from teamslam.team.ros2.translator import TAG, Translator

ODOMETRY = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped")
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIX = "sensor_msgs/msg/NavSatFix"
WHEEL_WORDS = ("wheel", "wheels", "encoder", "encoders", "raw", "controller", "drive")
FILTERED = ("filtered", "fused", "ekf", "ukf")  # words for fixes that contain odometry
PART_WORDS = (*FUSED_WORDS, *WHEEL_WORDS, "base")
"""Initial topic words that name a part of a robot, not a robot."""
SAMPLED_MESSAGES = 2000  # number of /tf messages searched for tags


class Proposal(NamedTuple):
    """Topics of each robot; others: further possible odometry; warnings: ambiguities."""

    robots: dict[str, RobotTopics]
    others: dict[str, list[str]]
    warnings: list[str]


def propose_topics(path: Path) -> str:
    """Describe a bag's topics, with a proposed assignment; raises BagError."""
    with opened_bag(path) as bag:
        return _question(path, bag, _proposed(bag, None))


def propose_assignment(path: Path) -> str:
    """Proposed assignment file; raises BagError."""
    with opened_bag(path) as bag:
        found = _proposed(bag, None)
        topics = [*_listing(bag.topics).splitlines(), *found.warnings]
        return "".join(f"# {line.strip()}\n" for line in topics) + _as_toml(found)


def _decide_topics(bag: Bag, path: Path, robot: str | None) -> Topics:
    found = _proposed(bag, robot)
    if found.warnings:
        raise DatasetError(_question(path, bag, found))
    return Topics(robots=found.robots)


def _question(path: Path, bag: Bag, found: Proposal) -> str:
    if found.warnings:
        head = f"{path}: the topics are ambiguous.\n"
    else:
        head = f"{path}: `teamslam import {path} -o FOLDER` imports these topics as below.\n"
    return (
        head
        + f"{_listing(bag.topics)}\n"
        + "".join(f"{doubt}\n" for doubt in found.warnings)
        + ("To decide" if found.warnings else "To change the roles")
        + ", write this into topics.toml:\n\n"
        + _as_toml(found)
        + f"\nand type: teamslam import {path} -o FOLDER --ros2 topics.toml (where there is no "
        "such file, this writes it)\n"
    )


def _proposed(bag: Bag, robot: str | None) -> Proposal:
    found = bag.topics
    tagged = _tags_in(bag)
    bases = {topic.name: _base_in(bag, topic) for topic in found if topic.kind in ODOMETRY}
    robots: dict[str, RobotTopics] = {}
    others: dict[str, list[str]] = {}
    warnings: list[str] = []
    spaces = _spaces(found, tagged, bases)
    everyones = [] if "" in spaces or None in spaces else _candidates(found, tagged, "")[1]
    for space in spaces:
        alone = space is None
        odometry, detections, truth = _candidates(found, tagged, space)
        detections = detections or everyones
        name = _robot_name(_only_space(found) if space is None else space, robot if alone else None)
        if len(odometry) != 1:
            warnings.append(
                f"{name}: {len(odometry)} topics may be its odometry" + _choice(odometry)
            )
        if not detections:
            warnings.append(f"{name}: no topic with detections of landmarks")
        fixes = [t.name for t in found if t.kind == FIX and (space in (None, _namespace(t.name)))]
        fixes = [each for each in fixes if not has_word(each, FILTERED)] or fixes
        if len(fixes) > 1:
            warnings.append(f"{name}: {len(fixes)} topics may be its fixes: {', '.join(fixes)}")
        if len(truth) > 1:
            warnings.append(f"{name}: {len(truth)} topics may be its truth")
        others[name] = odometry[1:]
        robots[name] = RobotTopics(
            odometry=odometry[0] if odometry else "/odom",
            detections=tuple(detections),
            fixes=fixes[0] if fixes else "",
            truth=truth[0] if truth else "",
            base_frame=(bases[odometry[0]] if odometry else "") or "base_link",
        )
    if not robots:
        warnings.append("no topic with odometry")
        robots[robot or "r1"] = RobotTopics(odometry="/odom", detections=("/detections",))
    return Proposal(robots, others, warnings)


def _spaces(topics: list[Topic], tagged: set[str], bases: dict[str, str]) -> list[str] | list[None]:
    """Namespaces that are robots; None: all topics are one robot's, without a namespace that has
    odometry and detections, and with one odometry frame.
    """
    spaces = sorted({_namespace(name) for name in bases})
    if len(spaces) < 2:
        return [None] if spaces else []
    whole = [space for space in spaces if all(_candidates(topics, tagged, space)[:2])]
    return [None] if not whole and len(set(bases.values())) == 1 else spaces


def _only_space(topics: list[Topic]) -> str:
    spaces = {_namespace(topic.name) for topic in topics if topic.kind in ODOMETRY}
    return spaces.pop() if len(spaces) == 1 else ""


def _base_in(bag: Bag, topic: Topic) -> str:
    for raw in bag.messages([topic.name]):
        try:
            record = decode(raw.kind, raw.data, bag.store)
        except DamagedError:
            continue
        return record.child.lstrip("/") if isinstance(record, OdometryRecord) else ""
    return ""


def _choice(odometry: list[str]) -> str:
    if len(odometry) < 2:
        return ""
    return (
        f", and one is used: {odometry[0]} is proposed. It should be the wheels' own: one that is "
        "fused with landmarks, GPS or a map (the frame `map`) would count them twice, and jumps"
    )


def _candidates(
    topics: list[Topic], tagged: set[str], space: str | None
) -> tuple[list[str], list[str], list[str]]:
    """Odometry (likeliest first), detections, truth; space None: all."""
    here = [topic for topic in topics if space is None or _namespace(topic.name) == space]
    placed = [topic.name for topic in here if topic.kind in (*ODOMETRY, *POSES)]
    true = [name for name in placed if has_word(name, TRUTH_WORDS)]
    odometry = [t.name for t in here if t.kind in ODOMETRY and t.name not in true]
    odometry.sort(
        key=lambda name: (has_word(name, FUSED_WORDS), not has_word(name, WHEEL_WORDS), name)
    )
    other = (*ODOMETRY, *POSES, TRANSFORMS, FIX, "geometry_msgs/msg/TransformStamped")
    detections = [t.name for t in here if t.kind in READERS and t.kind not in other]
    detections += [t.name for t in here if t.name in tagged]
    return odometry, detections, true


def _namespace(topic: str) -> str:
    """First part of /r1/odom; empty for /odom, /odometry/filtered and /wheel/odom."""
    parts = topic.strip("/").split("/")
    part = len(parts) > 1 and (parts[0].startswith("odom") or has_word(parts[0], PART_WORDS))
    return parts[0] if len(parts) > 1 and not part else ""


def _robot_name(space: str, robot: str | None) -> str:
    cleaned = "".join(c if c.isalnum() else "_" for c in space.lower())[:32]
    usable = cleaned and cleaned[0].isalpha() and cleaned.isascii()
    return robot or (cleaned if usable else "r1")


def _tags_in(bag: Bag) -> set[str]:
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


def _listing(topics: list[Topic]) -> str:
    lines = []
    for topic in topics:
        used = "" if topic.kind in READERS else "   (not read here)"
        lines.append(f"  {topic.name}   {topic.kind}   {topic.messages} messages{used}")
    return "\n".join(lines)


def _as_toml(found: Proposal) -> str:
    lines = []
    for name, topics in found.robots.items():
        either = "".join(f'   # or "{other}"' for other in found.others.get(name, ()))
        detections = ", ".join(f'"{topic}"' for topic in topics.detections)
        lines += [
            f"[robots.{name}]",
            f'odometry = "{topics.odometry}"{either}',
            'use = "pose"           # or "twist": speeds that hold until the next message',
            f"detections = [{detections}]",
        ]
        lines += [f'fixes = "{topics.fixes}"'] if topics.fixes else []
        lines += [f'truth = "{topics.truth}"'] if topics.truth else []
        lines += [f'base_frame = "{topics.base_frame}"', ""]
    return "\n".join(lines)


def import_bag(
    path: Path, topics: Topics | None, robot: str | None, datum: Datum | None = None
) -> Report:
    """Tables of a bag; raises BagError, DatasetError.

    topics: None: from names and types. datum: where the topics give none; None: the first fix.
    """
    with opened_bag(path) as bag:
        chosen = topics or _decide_topics(bag, path, robot)
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
                raise DatasetError(
                    f"{path}: {topic} is the {role} of both {of[topic]} and {name}: in the file of "
                    "topics (--ros2 FILE) give it to its robot alone"
                )
    for name, robot in topics.robots.items():
        for topic in (robot.odometry, *robot.detections, robot.fixes, robot.truth):
            if topic and topic not in present:
                raise DatasetError(
                    f"{path}: no topic {topic}, which {name} is to have; there are:\n"
                    + _listing(bag.topics)
                )


def _translated(bag: Bag, topics: Topics, path: Path) -> Report:
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
        raise DatasetError(f"{path}: {questions[0]}")
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
    return Report(list(tables), notes, sum(seen.values()), list(tables.values()), datum)


def _first_fix(bag: Bag, topics: Topics) -> Datum | None:
    """Datum at the first fix, rounded to 10⁻⁶ degrees."""
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
