"""ROS 2 bags: .mcap and .db3 files, and folders with a metadata.yaml."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys.store import Typestore

from teamslam.team.ros2.decoding import types

SUFFIXES = (".mcap", ".db3")
VERSION: Final = 9  # version of a new bag's metadata, that of ROS 2 Jazzy


class BagError(ValueError):
    """A bag that cannot be read; the text has the remedy."""


class Topic(NamedTuple):
    """A topic of a bag: type, and number of messages."""

    name: str
    kind: str
    messages: int


class RawMessage(NamedTuple):
    """One encoded message of a bag."""

    topic: str
    kind: str
    arrival_ns: int
    data: bytes


class Bag:
    """An open bag."""

    def __init__(self, reader: AnyReader) -> None:
        self._reader = reader

    @property
    def store(self) -> Typestore:
        """The types' definitions: the bag's own, if it has some."""
        return self._reader.typestore

    @property
    def topics(self) -> list[Topic]:
        """Topics by name."""
        found = [Topic(c.topic, c.msgtype, c.msgcount) for c in self._reader.connections]
        return sorted(found)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in order of arrival; raises BagError."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        try:
            for connection, arrival_ns, data in self._reader.messages(chosen):
                yield RawMessage(connection.topic, connection.msgtype, arrival_ns, data)
        except _FAULTS as error:
            raise BagError(f"damaged: {error}; `ros2 bag reindex` may repair it") from None


_FAULTS = (AnyReaderError, OSError, ValueError, KeyError, AssertionError)


def is_bag(path: Path) -> bool:
    """Whether a file has the suffix of a bag, or a folder contains one."""
    return path.suffix in SUFFIXES or (path / "metadata.yaml").is_file() or bool(_parts(path))


def _parts(path: Path) -> list[Path]:
    """Files of a bag whose recorder was killed before it wrote metadata.yaml."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return []
    inside = sorted(path.iterdir())
    return inside if all(each.is_file() and each.suffix in SUFFIXES for each in inside) else []


@contextmanager
def opened_bag(path: Path) -> Iterator[Bag]:
    """Open a bag; raises BagError."""
    try:
        reader = AnyReader(_parts(path) or [path], default_typestore=types())
        reader.open()
    except Exception as error:  # the library passes on the exceptions of its own readers
        remedy = "`ros2 bag reindex` may repair it"
        there = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        files = [each for each in there if each.suffix == ".mcap"]
        if files:
            remedy = f"`teamslam repair {files[0]} -o WHOLE.mcap` takes what is whole out of it"
        raise BagError(f"{path}: no ROS 2 bag, or a damaged one ({error}); {remedy}") from None
    try:
        yield Bag(reader)
    except BagError as error:
        raise BagError(f"{path}: {error}") from None
    finally:
        reader.close()


class NewBag:
    """A bag that is being written; every topic is reliable."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections: dict[str, Connection] = {}

    def write(self, topic: str, kind: str, stamp_ns: int, data: bytes, latched: bool) -> None:
        """Write a message at a time [ns] of log and receipt."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=types(), offered_qos_profiles=[_quality(latched)]
            )
        self._writer.write(self._connections[topic], max(stamp_ns, 0), data)


@contextmanager
def new_bag(folder: Path) -> Iterator[NewBag]:
    """Write a bag (MCAP) into a folder that does not exist."""
    with Writer(folder, version=VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        yield NewBag(writer)


def _quality(latched: bool) -> Qos:
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    forever = QosTime(sec=9_223_372_036, nsec=854_775_807)
    return Qos(
        history=QosHistory.KEEP_LAST, depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE, durability=durability, deadline=forever,
        lifespan=forever, liveliness=QosLiveliness.AUTOMATIC, liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )  # fmt: skip
