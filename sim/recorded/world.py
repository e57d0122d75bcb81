"""A world from a log."""

from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import msgspec

from teamslam.central.desk.verification.recorded import RerunError
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, loads
from teamslam.sim.scenarios.source import open_data_set
from teamslam.team.pairs import NEEDS_MAP
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_floats
from teamslam.team.wire.bus import Outgoing, Sample, opened
from teamslam.team.wire.channels import Channel, channel_of
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.digest import announce_configuration

STEP_NS = 1_000_000_000  # team time between two checks of the nodes' answers
_TRUTH = (ch.TRUTH, ch.TRUTH_LANDMARKS, ch.TRUTH_LABELS, ch.TRUTH_POSITIONS)
_SOURCE = (*ch.SENSORS, *_TRUTH, ch.WORLD_CONFIG, ch.SAVED_MAP, ch.END)


@runtime_checkable
class Samples(Protocol):
    """A source of a run's samples: a log, or a run in memory."""

    def samples(self, channels: Collection[ch.Channel] | None = None) -> Iterable[Sample]:
        """Samples of these channels; None: all."""


def _without(measurement: m.Measurement, robots: Collection[str]) -> m.Measurement:
    if not isinstance(measurement, m.Sightings) or not {*measurement.teammates} & {*robots}:
        return measurement
    kept = [k for k, teammate in enumerate(measurement.teammates) if teammate not in robots]
    return msgspec.structs.replace(
        measurement,
        teammates=tuple(measurement.teammates[k] for k in kept),
        ranges=from_floats(floats(measurement.ranges, "ranges")[kept]),
        bearings=from_floats(floats(measurement.bearings, "bearings")[kept]),
    )


class RecordedWorld:
    """Messages of a log's world, for some robots, by team time.

    Raises RerunError for a missing measurement.
    """

    listens: ClassVar[tuple[ch.Channel, ...]] = ()

    def __init__(self, log: Samples, without: Collection[str] = ()) -> None:
        self._configured: m.Configuration | None = None
        self._outgoing: list[Outgoing] = []
        self._notes: tuple[str, ...] = ()
        published: dict[tuple[str, int, int], tuple[int, Outgoing]] = {}
        truths: list[tuple[int, Outgoing]] = []
        for sample in log.samples(_SOURCE):
            try:
                channel, name, message = opened(sample)
            except WireError:
                continue
            match message:
                case m.Measurement() | m.Truth() if name in without:
                    pass
                case m.Measurement():
                    place = (message.robot, message.incarnation, message.number)
                    out = Outgoing(channel, name, _without(message, without))
                    published.setdefault(place, (message.stamp_ns, out))
                case m.Truth():
                    truths.append((message.stamp_ns, Outgoing(channel, name, message)))
                case m.TruthLabels() | m.TruthPositions() if name not in without:
                    self._outgoing.append(Outgoing(channel, name, message))
                case m.SavedMap() if message.author not in without:
                    self.load_maps([message])
                case m.TruthLandmarks():
                    self._outgoing.append(Outgoing(channel, "", message))
                case m.Configuration():
                    self._configured = message
                case m.End():
                    self._notes = message.notes
        self._end = _ends(published)
        ordered = [*(published[place] for place in sorted(published)), *truths]
        self._waiting = deque(sorted(ordered, key=lambda each: each[0]))
        self.first_ns = self._waiting[0][0] if self._waiting else 0
        self.last_ns = self._waiting[-1][0] if self._waiting else 0
        self.now_ns = self.first_ns
        self._ended = False

    def load_maps(self, maps: Iterable[m.SavedMap]) -> None:
        """Publish saved maps of earlier days with the first messages."""
        self._outgoing += [Outgoing(ch.SAVED_MAP, saved.author, saved) for saved in maps]

    @property
    def scenario(self) -> Scenario:
        """Recorded scenario; raises RerunError, ScenarioError."""
        if self._configured is None:
            raise RerunError("the log has no scenario: its world was not recorded")
        return loads(self._configured.configuration)

    def announce(self, scenario: Scenario) -> None:
        """Set the scenario for `begin`; raises RerunError for a missing known map."""
        if scenario.estimator in NEEDS_MAP:
            truth = [o.message for o in self._outgoing if isinstance(o.message, m.TruthLandmarks)]
            if not truth:
                raise RerunError(
                    f"the estimator {scenario.estimator} needs a map of the landmarks, "
                    "and the log has none"
                )
            true = truth[0]
            known = m.KnownMap(stamp_ns=true.stamp_ns, ids=true.ids, positions=true.positions)
            self._outgoing.append(Outgoing(ch.KNOWN_MAP, "", known))
        announced = announce_configuration("world", 0, 0, scenario)
        self._outgoing.insert(0, Outgoing(ch.WORLD_CONFIG, "", announced))

    def begin(self) -> list[Outgoing]:
        """First messages: scenario, true landmarks, and known map."""
        return self._outgoing

    def publish(self, clock_s: float) -> list[Outgoing]:
        """Publish the next STEP_NS of team time, and the end."""
        if self._ended:
            return []
        until_ns = self.now_ns + STEP_NS
        out = []
        while self._waiting and self._waiting[0][0] < until_ns:
            out.append(self._waiting.popleft()[1])
        self.now_ns = until_ns
        if not self._waiting:
            self._ended = True
            self.now_ns = self.last_ns
            end = m.End(stamp_ns=self.last_ns, streams=self._end, notes=self._notes)
            out.append(Outgoing(ch.END, "", end))
        return out or self.publish(clock_s)

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Ignore a message: a log's measurements do not depend on it."""
        return []


def _ends(published: Collection[tuple[str, int, int]]) -> tuple[m.StreamEnd, ...]:
    counts = Counter[tuple[str, int]]()
    last: dict[str, m.StreamEnd] = {}
    for robot, incarnation, number in sorted(published):
        count = counts[robot, incarnation]
        if number != count:
            raise RerunError(
                f"measurement {count} of {robot}, incarnation {incarnation} "
                "is not in the log: under other conditions the robot could not go on behind it"
            )
        counts[robot, incarnation] += 1
        last[robot] = m.StreamEnd(robot=robot, incarnation=incarnation, measurements=count + 1)
    return tuple(last.values())


class DataSetRun:
    """All messages of a team on a data set; raises DatasetError, ScenarioError."""

    def __init__(self, path: Path) -> None:
        streams, scenario, missing = open_data_set(path)
        if missing is not None:
            streams = replace(streams, notes=(missing, *streams.notes))
        self.path = path
        self._samples = list(run_team(scenario, streams))

    def samples(self, channels: Collection[Channel] | None = None) -> Iterator[Sample]:
        """Samples of these channels; None: all."""
        for sample in self._samples:
            found = channel_of(sample.key)
            if channels is None or (found is not None and found[0] in channels):
                yield sample


def log_or_run(path: Path) -> Samples:
    """A log, or the run on a data set."""
    if path.suffix == ".mcap" or (path.is_file() and path.suffix != ".zip"):
        return open_log(path)
    return DataSetRun(path)
