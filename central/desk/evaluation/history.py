"""History of a run over team time."""

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import TypeVar

import numpy as np

from teamslam.central.desk.evaluation.events import MOST, Event, EventDetector
from teamslam.central.desk.evaluation.running import TeamTruth
from teamslam.central.desk.logged import Logged, read_logged
from teamslam.central.desk.names import in_order
from teamslam.central.desk.peers_as_centre import PeersAsCentre
from teamslam.team.shapes import Float, Int64
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample

S = TypeVar("S")
T = TypeVar("T")
_NO_SPAN = (2**63 - 1, -(2**63))
_CHANNELS = (
    ch.START, ch.SUBMAP, ch.FUSED_MAP, ch.FINAL_MAP, ch.INNOVATION, ch.TRUTH_LANDMARKS, ch.STATUS,
    ch.ALIVE, ch.ROBOT_CONFIG, ch.ROBOT_DONE, ch.WITHDRAWAL, ch.END,
)  # fmt: skip
_COST = "joint_cost_per_dof."


@dataclass(frozen=True)
class Series:
    """Values by ascending team time [ns]."""

    stamps_ns: Int64[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Innovations:
    """Σ νᵀ S⁻¹ ν and degrees of freedom by window."""

    stamps_ns: Int64[np.ndarray, " n"]
    squared: Float[np.ndarray, " n"]
    dof: Int64[np.ndarray, " n"]

    @property
    def per_dof(self) -> float | None:
        """NIS per degree of freedom."""
        total = self.total_dof
        return float(self.squared.sum()) / total if total else None

    @property
    def total_dof(self) -> int:
        """Degrees of freedom of all windows."""
        return int(self.dof.sum())


@dataclass(frozen=True)
class Latencies:
    """Wall time [s] from a submap's first, last measurement to its first map."""

    first_s: Float[np.ndarray, " n"]
    last_s: Float[np.ndarray, " n"]


@dataclass(frozen=True, kw_only=True)
class History:
    """History of a run by team time.

    start_ns, end_ns: span of the measurements, else of all messages. map_nees: per degree of
    freedom.
    """

    start_ns: int
    end_ns: int
    innovations: Mapping[str, Innovations]
    map_nees: Series
    map_cost: Series
    robot_cost: Mapping[str, Series]
    latencies: Mapping[str, Latencies]
    events: tuple[Event, ...]

    def seconds(self, stamps_ns: Int64[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Team time since the first measurement [s]."""
        elapsed: Float[np.ndarray, " n"] = np.maximum(stamps_ns - self.start_ns, 0) * 1e-9
        return elapsed


class _Clocks:
    """Wall clocks [ns] of a stream's measurements, in order; 16 bytes each."""

    def __init__(self) -> None:
        self._measurements = array("q")
        self._clocks = array("q")

    def take(self, measurement: int, wall_ns: int) -> None:
        if abs(measurement) < 2**63 and (
            not self._measurements or measurement > self._measurements[-1]
        ):
            self._measurements.append(measurement)
            self._clocks.append(min(wall_ns, 2**63 - 1))

    def of(self, measurement: int) -> int | None:
        k = bisect_left(self._measurements, measurement)
        known = k < len(self._measurements) and self._measurements[k] == measurement
        return self._clocks[k] if known else None


_Rows = list[tuple[int, float]]  # stamps [ns] and values


class HistoryReader:
    """Gather the history of a run, sample by sample."""

    def __init__(self) -> None:
        self.innovations: dict[str, dict[tuple[int, int], m.Innovation]] = defaultdict(dict)
        """By (incarnation, window): a resumed robot repeats some."""
        self.map_nees: _Rows = []
        self.map_cost: _Rows = []
        self.robot_cost: dict[str, _Rows] = defaultdict(list)
        self.detector = EventDetector()
        self.events: list[Event] = []
        self.published: dict[tuple[str, int], _Clocks] = defaultdict(_Clocks)
        self.unused: dict[tuple[str, int], dict[int, tuple[int, int]]] = defaultdict(dict)
        """First and last measurement of submaps that no map has used, by stream and sequence."""
        self.latencies: dict[str, list[tuple[float, float]]] = defaultdict(list)
        self.truth = TeamTruth()
        self.measured_ns = self.logged_ns = _NO_SPAN

    def take(self, each: Logged, as_centre: Logged | None) -> None:
        """Process a sample, and the same as a centre's."""
        sample = each.sample
        self.logged_ns = _extend(self.logged_ns, sample.stamp_ns)
        if ch.row_of(sample.key) in ch.SENSORS and (numbered := each.numbered) is not None:
            stream = numbered.robot, numbered.incarnation
            self.published[stream].take(numbered.number, sample.wall_ns)
            self.measured_ns = _extend(self.measured_ns, sample.stamp_ns)
        self._take_contents(each)
        if as_centre is not None:
            self._take_contents(as_centre)

    def _take_contents(self, each: Logged) -> None:
        sample = each.sample
        # Invalid samples are counted by the evaluation.
        if ch.row_of(sample.key) not in _CHANNELS or each.opened is None:
            return
        _, name, message = each.opened
        self.truth.take(message)
        self.events += self.detector.take(message, sample.stamp_ns)
        del self.events[MOST:]
        match message:
            case m.Submap():
                span = message.first_measurement, message.last_measurement
                self.unused[message.robot, message.incarnation][message.sequence] = span
            case m.FusedMap():
                self._take_map(message, sample.wall_ns)
            case m.Innovation():
                window = message.incarnation, message.sequence
                self.innovations[message.robot][window] = message
            case m.Status() if name == "central":
                for figure, value in message.figures.items():
                    if figure.startswith(_COST):
                        row = message.stamp_ns, value
                        self.robot_cost[figure.removeprefix(_COST)].append(row)

    def _take_map(self, fused: m.FusedMap, wall_ns: int) -> None:
        if fused.dof > 0:
            self.map_cost.append((fused.stamp_ns, fused.chi2 / fused.dof))
        if (fit := self.truth.fit(fused)) is not None:
            of_blocks, of_map = float(fit.nees.mean()) / 2.0, fit.nees_per_dof
            self.map_nees.append((fused.stamp_ns, of_blocks if of_map is None else of_map))
        for member in fused.members:
            waiting = self.unused[member.robot, member.incarnation]
            for sequence in [k for k in waiting if k <= member.sequence]:
                clocks = self.published[member.robot, member.incarnation]
                first_ns, last_ns = map(clocks.of, waiting.pop(sequence))
                # Without one the log is partial; 0: recomputed, without wall time.
                if first_ns and last_ns:
                    latency = (wall_ns - first_ns) * 1e-9, (wall_ns - last_ns) * 1e-9
                    self.latencies[member.robot].append(latency)

    def history(self) -> History:
        """History up to the last sample."""
        spans = (self.measured_ns, self.logged_ns, (0, 0))
        span = next(each for each in spans if each != _NO_SPAN)
        return History(
            start_ns=span[0],
            end_ns=span[1],
            innovations=_by_robot(self.innovations, _innovations),
            map_nees=_series(self.map_nees),
            map_cost=_series(self.map_cost),
            robot_cost=_by_robot(self.robot_cost, _series),
            latencies=_by_robot(self.latencies, lambda of: Latencies(*np.array(of).T)),
            events=tuple(sorted(self.events, key=lambda event: event.stamp_ns)),
        )


def history(samples: Iterable[Sample]) -> History:
    """Compute the history of a run."""
    found = HistoryReader()
    for each, as_centre in read_logged(samples, PeersAsCentre()):
        found.take(each, as_centre)
    return found.history()


def _extend(span_ns: tuple[int, int], stamp_ns: int) -> tuple[int, int]:
    return min(span_ns[0], stamp_ns), max(span_ns[1], stamp_ns)


def _by_robot(found: Mapping[str, S], convert: Callable[[S], T]) -> dict[str, T]:
    return {robot: convert(found[robot]) for robot in in_order(found)}


def _series(rows: _Rows) -> Series:
    ordered = sorted(rows, key=itemgetter(0))
    stamps, values = ([row[k] for row in ordered] for k in (0, 1))
    return Series(np.array(stamps, np.int64), np.array(values, np.float64))


def _innovations(of: Mapping[tuple[int, int], m.Innovation]) -> Innovations:
    ordered = [of[window] for window in sorted(of)]
    return Innovations(
        np.array([each.stamp_ns for each in ordered], np.int64),
        np.array([each.squared for each in ordered]),
        np.array([each.dof for each in ordered], np.int64),
    )
