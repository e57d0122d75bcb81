"""Index a log by recorded inputs and recomputable outputs."""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import TypeVar

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.desk.names import in_order
from teamslam.team.config import RobotConfig
from teamslam.team.former_names import with_current_names
from teamslam.team.recording.reader import Log, LogError
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import WireError

T = TypeVar("T")
Identity = tuple[object, ...]
"""Message key and names of its inputs."""


class RerunError(ValueError):
    """Log that cannot be recomputed, for want of the named input."""


class RecordedMeasurements(Mapping[int, m.Measurement]):
    """Measurements of one incarnation by number.

    contradicted: numbers with two different contents; the first one counts.
    """

    def __init__(self) -> None:
        self._messages: dict[int, m.Measurement] = {}
        self._odometry: list[int] | None = None
        self.contradicted: list[int] = []

    def put(self, message: m.Measurement) -> None:
        """Add a measurement unless its number is present."""
        known = self._messages.setdefault(message.number, message)
        if known is not message and known != message:
            self.contradicted.append(message.number)
        self._odometry = None

    def __getitem__(self, number: int) -> m.Measurement:
        return self._messages[number]

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(self._messages))

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Least and greatest stamp."""
        stamps = [each.stamp_ns for each in self._messages.values()]
        return min(stamps), max(stamps)

    def intervals(self, begin: int, end: int) -> int:
        """Number of odometry intervals numbered begin … end − 1."""
        if self._odometry is None:
            numbers = (n for n, x in self._messages.items() if isinstance(x, m.AnyOdometry))
            self._odometry = sorted(numbers)
        return bisect_left(self._odometry, end) - bisect_left(self._odometry, begin)

    def consecutive(self, begin: int, end: int) -> Iterator[m.Measurement]:
        """Yield measurements begin … end − 1, up to the first gap."""
        for number in range(begin, end):
            if number not in self._messages:
                return
            yield self._messages[number]


@dataclass(frozen=True)
class RecordedOutput:
    """Recorded message that can be recomputed, as sample and decoded."""

    sample: Sample
    channel: ch.Channel
    message: m.Message


@dataclass
class Recorded:
    """All node inputs and outputs in a log; each measurement once.

    configured: last announcement of each node. outputs: recomputable messages in log order.
    reported: consumed by the robot's report. published: announced by the source. known_map: prior
    map for localisation. saved_maps: by author. withdrawals: first order on each robot. unsound:
    number of invalid samples.
    """

    measurements: dict[Stream, RecordedMeasurements] = field(
        default_factory=partial(defaultdict, RecordedMeasurements)
    )
    configured: dict[str, m.Configuration] = field(default_factory=dict)
    outputs: list[RecordedOutput] = field(default_factory=list)
    reported: dict[Stream, int] = field(default_factory=dict)
    published: dict[Stream, int] = field(default_factory=dict)
    known_map: m.KnownMap | None = None
    saved_maps: dict[str, m.SavedMap] = field(default_factory=dict)
    withdrawals: dict[str, m.Withdrawal] = field(default_factory=dict)
    unsound: int = 0
    _indexed: int = 0
    _by_channel: dict[str, list[RecordedOutput]] = field(default_factory=dict)

    def take_all(self, samples: Sequence[Sample]) -> None:
        """Index samples in log order."""
        for sample in samples:
            self.take(sample)

    def take(self, sample: Sample) -> None:
        """Index one sample; a viewer's samples are ignored."""
        try:
            channel, _, message = opened(sample)
        except WireError:
            self.unsound += ch.VIEW.owner(sample.key) is None
            return
        if m.is_measurement(message):  # most messages are measurements
            self.measurements[message.robot, message.incarnation].put(message)
            return
        match message:
            case m.Configuration():
                of_a_fold = channel is ch.TEAM_CONFIG
                self.configured["central" if of_a_fold else message.node] = message
            case m.Progress():
                consumed = self.reported.get((message.robot, message.incarnation), 0)
                self.reported[message.robot, message.incarnation] = max(
                    consumed, message.measurements
                )
            case m.KnownMap():
                self.known_map = message
            case m.SavedMap():
                self.saved_maps.setdefault(message.author, message)
            case m.Withdrawal():
                self.withdrawals.setdefault(message.robot, message)
            case m.StreamHead():
                self._count(message)
            case m.End():
                self.published |= {
                    (s.robot, s.incarnation): s.measurements for s in message.streams
                }
            case _ if channel.recomputable:
                self.outputs.append(RecordedOutput(sample, channel, message))
            case _:
                pass

    def _count(self, head: m.StreamHead) -> None:
        stream = (head.robot, head.incarnation)
        self.published[stream] = max(self.published.get(stream, 0), head.measurements)

    def of(self, channel: ch.Channel) -> list[m.Message]:
        """Recorded messages of a channel, in log order."""
        return [each.message for each in self.outputs_of(channel)]

    def outputs_of(self, channel: ch.Channel) -> Sequence[RecordedOutput]:
        """Recorded outputs on a channel, in log order."""
        for each in self.outputs[self._indexed :]:
            self._by_channel.setdefault(each.channel.name, []).append(each)
        self._indexed = len(self.outputs)
        return self._by_channel.get(channel.name, ())

    @property
    def contradicted(self) -> list[m.Measurement]:
        """First copies of measurements with two different contents."""
        streams = self.measurements.values()
        return [stream[number] for stream in streams for number in stream.contradicted]

    @property
    def robots(self) -> list[str]:
        """Robots with measurements or messages, by name."""
        names = {robot for robot, _ in self.measurements}
        names |= {s.message.robot for s in self.outputs if isinstance(s.message, m.Submap | m.Done)}
        return in_order(names)

    def incarnations(self, robot: str) -> list[int]:
        """A robot's incarnations with measurements, in order."""
        return sorted(incarnation for name, incarnation in self.measurements if name == robot)

    def submaps(self) -> Mapping[Stream, dict[int, m.Submap]]:
        """Recorded submaps by stream and sequence."""
        found: dict[Stream, dict[int, m.Submap]] = {}
        for submap in self.of(ch.SUBMAP):
            assert isinstance(submap, m.Submap)
            found.setdefault((submap.robot, submap.incarnation), {})[submap.sequence] = submap
        return found

    def sightings(self) -> Mapping[tuple[str, int, int], list[m.SightingFactor]]:
        """Inter-robot measurements by (robot, incarnation, sequence) of their submap."""
        found: dict[tuple[str, int, int], list[m.SightingFactor]] = {}
        for sighting in self.of(ch.SIGHTING_FACTOR):
            assert isinstance(sighting, m.SightingFactor)
            name = (sighting.robot, sighting.incarnation, sighting.sequence)
            found.setdefault(name, []).append(sighting)
        return found

    def robot_config(self, robot: str) -> tuple[RobotConfig, bytes]:
        """Announced configuration of a robot, and its digest; raises RerunError."""
        announced = self._announced(ch.robot_node(robot))
        subject = f"the configuration of {robot}"
        return _parsed(announced.configuration, RobotConfig, subject), announced.digest

    def central_config(self) -> tuple[CentralConfig, bytes]:
        """Configuration of the centre and its digest; raises RerunError."""
        announced = self._announced("central")
        subject = "the centre's configuration"
        return _parsed(announced.configuration, CentralConfig, subject), announced.digest

    def _announced(self, node: str) -> m.Configuration:
        if node not in self.configured:
            raise RerunError(
                f"the log has no configuration of {node}: nothing of it can be computed"
            )
        return self.configured[node]


def _parsed(text: str, kind: type[T], subject: str) -> T:
    try:
        return msgspec.convert(with_current_names(msgspec.json.decode(text)), kind)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise RerunError(f"{subject} is not one of this version: {error}") from None


_CONFIGURING = (ch.KNOWN_MAP, ch.ROBOT_CONFIG, ch.CENTRAL_CONFIG, ch.TEAM_CONFIG, ch.ROBOT_PROGRESS,
         ch.END, ch.SAVED_MAP, ch.HEAD, ch.ROBOT_HEAD, ch.ORDER, ch.WITHDRAWAL)  # fmt: skip
INPUTS = tuple(c for c in ch.CHANNELS if c.recomputable or c in (*ch.SENSORS, *_CONFIGURING))


def index_log(log: Log) -> Recorded:
    """Index a log in one pass."""
    found = Recorded()
    for chunk in log.chunks(INPUTS):
        if isinstance(chunk, LogError):
            raise chunk
        found.take_all(chunk)
    return found


@lru_cache(maxsize=4096)
def identity(key: str, message: m.Message) -> Identity:
    """Message key, followed by the names of its inputs."""
    match message:
        case m.Submap():
            names: Identity = (
                message.incarnation,
                message.sequence,
                message.first_measurement,
                message.last_measurement,
            )
        case m.Association():
            names = (message.incarnation, message.sequence, message.stamps)
        case m.SightingFactor():
            names = (message.incarnation, message.sequence, message.stamp_ns, message.teammate)
        case m.MapEstimate():
            names = (message.incarnation, message.stamp_ns, message.sequence, message.exchange)
        case m.PoseEstimate():
            names = (message.incarnation, message.stamp_ns, message.sequence, message.map_digest)
        case m.Done():
            names = (message.incarnation, message.measurements, message.steps)
        case m.Prior() | m.Trajectory():
            names = (message.incarnation, message.digest)
        case m.FusedMap():
            names = (
                message.exchange,
                message.provisional,
                message.members,
                message.withdrawn,
                message.verdicts,
            )
        case _:
            names = (message.stamp_ns,)
    return (key, *names)
