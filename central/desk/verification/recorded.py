"""Index a log by recorded inputs and recomputable outputs."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeVar

import msgspec

from teamslam.central.config import UNREADABLE, CentralConfig
from teamslam.central.desk.logged import Logged
from teamslam.central.desk.names import in_order
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.hybrid_slam.window_path import WindowPath
from teamslam.team.former_names import with_current_names
from teamslam.team.recording.reader import Log
from teamslam.team.store import Stream
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample

M = TypeVar("M", bound=m.Message)
T = TypeVar("T")
Identity = tuple[object, ...]  # message key and names of its inputs


class RerunError(ValueError):
    """Log that cannot be recomputed."""


class RecordedMeasurements(Mapping[int, m.Measurement]):
    """Measurements of one incarnation by number; the first of equal ones."""

    def __init__(self) -> None:
        self._messages: dict[int, m.Measurement] = {}
        self.contradicted: list[int] = []

    def put(self, message: m.Measurement) -> None:
        """Add a measurement unless its number is present."""
        known = self._messages.setdefault(message.number, message)
        if known is not message and known != message:
            self.contradicted.append(message.number)

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

    @property
    def last(self) -> int:
        """Greatest number."""
        return max(self._messages)

    def odometry(self) -> list[int]:
        """Numbers of the odometry intervals, ascending."""
        return sorted(number for number, x in self._messages.items() if type(x) in m.ODOMETRY)

    def consecutive(self, begin: int, end: int) -> Iterator[m.Measurement]:
        """Yield measurements begin … end − 1, up to the first gap."""
        get = self._messages.get
        for number in range(begin, end):
            message = get(number)
            if message is None:
                return
            yield message


@dataclass(frozen=True)
class RecordedOutput:
    """Recomputable message."""

    sample: Sample
    message: m.Message


class RecordedWindow(NamedTuple):
    """Start of a recomputed window, and its path if it was solved."""

    start_ns: int
    path: WindowPath | None


class RunAlone(NamedTuple):
    """Dispositions of the consumed measurements by number, and closed windows by end [ns]."""

    dispositions: Sequence[str]
    windows: Mapping[int, RecordedWindow]


class Recorded:
    """All node inputs and outputs in a log; each measurement once.

    outputs: recomputable messages by channel. reported: consumed by the robot's report. published:
    announced by the source. withdrawals: first order on each robot. alone: results of `run_alone`.
    """

    def __init__(self) -> None:
        self.measurements: dict[Stream, RecordedMeasurements] = defaultdict(RecordedMeasurements)
        self.configured: dict[str, m.Configuration] = {}
        self.outputs: dict[str, list[RecordedOutput]] = defaultdict(list)
        self.reported: dict[Stream, int] = {}
        self.published: dict[Stream, int] = {}
        self.known_map: m.KnownMap | None = None
        self.saved_maps: dict[str, m.SavedMap] = {}
        self.withdrawals: dict[str, m.Withdrawal] = {}
        self.alone: dict[Stream, RunAlone] = {}
        self.unsound = 0

    def take_all(self, samples: Iterable[Sample]) -> None:
        """Index samples in log order."""
        for sample in samples:
            self.take(Logged(sample))

    def take(self, each: Logged) -> None:
        """Index one sample; a viewer's samples are ignored."""
        if each.opened is None:
            self.unsound += ch.VIEW.owner(each.sample.key) is None
            return
        channel, _, message = each.opened
        if m.is_measurement(message):  # most messages are measurements
            self.measurements[message.robot, message.incarnation].put(message)
            return
        match message:
            case m.Configuration():
                of_a_fold = channel is ch.TEAM_CONFIG
                self.configured["central" if of_a_fold else message.node] = message
            case m.Progress():
                stream = (message.robot, message.incarnation)
                self.reported[stream] = max(self.reported.get(stream, 0), message.measurements)
            case m.KnownMap():
                self.known_map = message
            case m.SavedMap():
                self.saved_maps.setdefault(message.author, message)
            case m.Withdrawal():
                self.withdrawals.setdefault(message.robot, message)
            case m.StreamHead():
                stream = (message.robot, message.incarnation)
                self.published[stream] = max(self.published.get(stream, 0), message.measurements)
            case m.End():
                self.published |= {
                    (s.robot, s.incarnation): s.measurements for s in message.streams
                }
            case _ if channel.recomputable:
                self.outputs[channel.name].append(RecordedOutput(each.sample, message))

    def of(self, kind: type[M], *channels: ch.Channel) -> list[M]:
        """Recorded messages of a kind by channel, in log order."""
        outputs = (each for channel in channels for each in self.outputs_of(channel))
        return [each.message for each in outputs if isinstance(each.message, kind)]

    def outputs_of(self, channel: ch.Channel) -> Sequence[RecordedOutput]:
        """Recorded outputs on a channel, in log order."""
        return self.outputs.get(channel.name, ())

    @property
    def contradicted(self) -> list[m.Measurement]:
        """Measurements with two different contents."""
        streams = self.measurements.values()
        return [stream[number] for stream in streams for number in stream.contradicted]

    @property
    def robots(self) -> list[str]:
        """Robots with measurements or messages, by name."""
        names = {robot for robot, _ in self.measurements}
        names |= {each.robot for each in self.of(m.Submap, ch.SUBMAP)}
        return in_order(names | {each.robot for each in self.of(m.Done, ch.ROBOT_DONE)})

    def incarnations(self, robot: str) -> list[int]:
        """A robot's incarnations with measurements."""
        return sorted(incarnation for name, incarnation in self.measurements if name == robot)

    def submaps(self) -> Mapping[Stream, dict[int, m.Submap]]:
        """Recorded submaps by stream and sequence."""
        found: dict[Stream, dict[int, m.Submap]] = {}
        for submap in self.of(m.Submap, ch.SUBMAP):
            found.setdefault((submap.robot, submap.incarnation), {})[submap.sequence] = submap
        return found

    def sightings(self) -> Mapping[tuple[str, int, int], list[m.SightingFactor]]:
        """Inter-robot measurements by submap."""
        found: dict[tuple[str, int, int], list[m.SightingFactor]] = {}
        for sighting in self.of(m.SightingFactor, ch.SIGHTING_FACTOR):
            name = (sighting.robot, sighting.incarnation, sighting.sequence)
            found.setdefault(name, []).append(sighting)
        return found

    def robot_config(self, robot: str) -> tuple[RobotConfig, bytes]:
        """Configuration of a robot and its digest; raises RerunError."""
        return self._announced(ch.robot_node(robot), RobotConfig, f"the configuration of {robot}")

    def central_config(self) -> tuple[CentralConfig, bytes]:
        """Configuration of the centre and its digest; raises RerunError."""
        return self._announced("central", CentralConfig, "the centre's configuration")

    def _announced(self, node: str, kind: type[T], subject: str) -> tuple[T, bytes]:
        announced = self.configured.get(node)
        if announced is None:
            raise RerunError(
                f"the log has no configuration of {node}: nothing of it can be computed"
            )
        try:
            text = with_current_names(msgspec.json.decode(announced.configuration))
            return msgspec.convert(text, kind), announced.digest
        except UNREADABLE as error:
            raise RerunError(f"{subject} is not one of this version: {error}") from None


_CONFIGURING = (ch.KNOWN_MAP, ch.ROBOT_CONFIG, ch.CENTRAL_CONFIG, ch.TEAM_CONFIG, ch.ROBOT_PROGRESS,
         ch.END, ch.SAVED_MAP, ch.HEAD, ch.ROBOT_HEAD, ch.ORDER, ch.WITHDRAWAL)  # fmt: skip
INPUTS = tuple(c for c in ch.CHANNELS if c.recomputable or c in (*ch.SENSORS, *_CONFIGURING))


def index_log(log: Log) -> Recorded:
    """Index a log in one pass."""
    found = Recorded()
    found.take_all(log.samples(INPUTS))
    return found


@lru_cache(maxsize=4096)
def identity(key: str, message: m.Message) -> Identity:
    """Message key, and names of inputs."""
    match message:
        case m.Submap():
            span = message.first_measurement, message.last_measurement
            names: Identity = (message.incarnation, message.sequence, *span)
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
            of_set = message.members, message.withdrawn, message.verdicts
            names = (message.exchange, message.provisional, *of_set)
        case _:
            names = (message.stamp_ns,)
    return (key, *names)
