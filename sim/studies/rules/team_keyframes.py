"""Merge all robots' raw measurements into one sequence of keyframes."""

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import NamedTuple

from teamslam.team import core, translate
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.models import Increment, segmenter_of
from teamslam.team.rejection import BY_CORE, UNMEASURED
from teamslam.team.robot.stream import Inbox
from teamslam.team.wire import messages as m


class RobotKeyframe(NamedTuple):
    """Motion and final measurements; number: of the last one."""

    stamp_ns: int
    robot: str
    number: int
    increment: Increment
    scan: core.Scan


@dataclass
class _Stream:
    """Measurements from the initial pose (measurement 0) on.

    covered_ns: no keyframe before this time can follow.
    """

    robot: str
    config: RobotConfig | None = None
    inbox: Inbox = field(default_factory=Inbox)
    segmenter: core.Segmenter | None = None
    start: m.InitialPose | None = None
    waiting: deque[RobotKeyframe] = field(default_factory=deque)
    covered_ns: float = float("-inf")
    broken: bool = False
    end: m.StreamEnd | None = None

    @property
    def complete(self) -> bool:
        end = self.end
        return self.broken or (end is not None and self.inbox.complete(end))

    def take(self) -> None:
        if self.config is None:
            return
        while (measurement := self.inbox.take_next()) is not None:
            if not self.broken:
                self._take(measurement, self.config)
        if self.complete and self.covered_ns != float("inf"):
            segmenter = self.segmenter
            if segmenter is not None and segmenter.now_ns is not None and not self.broken:
                segmenter.cut(segmenter.now_ns)
                self._file(segmenter.take_keyframes(), self.inbox.next_measurement - 1)
            self.covered_ns = float("inf")

    def _take(self, measurement: m.Measurement, config: RobotConfig) -> None:
        match measurement:
            case m.InitialPose() if self.start is None:
                self.start = measurement
                keyframe_s = config.front_end.keyframe_s
                self.segmenter = segmenter_of(
                    config.motion, config.sensor, keyframe_s, bounds=config.bounds
                )
            case m.InitialPose():
                self.broken = True  # a later incarnation begins at an unknown pose
            case m.Observations() | m.Points() if self.segmenter is not None:
                self.segmenter.observe(measurement.stamp_ns, translate.scan_of(measurement))
            case m.Odometry() | m.Increment() | m.Steering() if self.segmenter is not None:
                interval = translate.interval_of(measurement, config)
                outcome = self.segmenter.drive(interval)
                if BY_CORE[outcome % core.Segmenter.DUE] in UNMEASURED:
                    self._file(self.segmenter.take_keyframes(), measurement.number)
                    self.covered_ns = interval.end_ns
            case _:
                pass

    def _file(self, keyframes: Sequence[core.Keyframe], measurement: int) -> None:
        self.waiting += [
            RobotKeyframe(e.stamp_ns, self.robot, measurement, Increment(*e.motion), e.scan)
            for e in keyframes
        ]


class TeamKeyframes:
    """Keyframes of the team by (stamp, robot), as far as every stream is known.

    A stream ends where it restarts at an unknown pose; inter-robot measurements are not used.
    """

    def __init__(self, robots: Collection[str]) -> None:
        self._streams = {robot: _Stream(robot) for robot in sorted(robots)}

    def configure(self, robot: str, config: RobotConfig) -> None:
        """Set a robot's models."""
        if robot in self._streams and self._streams[robot].config is None:
            self._streams[robot].config = config

    def put(self, measurement: m.Measurement) -> None:
        """Add a measurement, in any order."""
        if measurement.robot in self._streams:
            self._streams[measurement.robot].inbox.put(measurement)

    def end(self, end: m.End) -> None:
        """Set the last counters of the streams."""
        for name, stream in self._streams.items():
            mine = [s for s in end.streams if s.robot == name]
            stream.end = (
                mine[0]
                if mine
                else m.StreamEnd(robot=name, incarnation=stream.inbox.incarnation, measurements=0)
            )

    @property
    def starts(self) -> dict[str, tuple[RobotConfig, m.InitialPose]] | None:
        """Every robot's models and initial pose, once complete."""
        found = {}
        for name, stream in self._streams.items():
            stream.take()
            if stream.config is not None and stream.start is not None:
                found[name] = (stream.config, stream.start)
            elif not stream.complete:
                return None
        return found

    @property
    def broken(self) -> list[str]:
        """Robots whose stream restarted."""
        return [name for name, stream in self._streams.items() if stream.broken]

    @property
    def complete(self) -> bool:
        """Whether all measurements have been used."""
        return all(stream.complete for stream in self._streams.values())

    def steps(self) -> Iterator[list[RobotKeyframe]]:
        """Yield complete keyframes by team time."""
        for stream in self._streams.values():
            stream.take()
        horizon = min(stream.covered_ns for stream in self._streams.values())
        ready: list[RobotKeyframe] = []
        for stream in self._streams.values():
            while stream.waiting and stream.waiting[0].stamp_ns < horizon:
                ready.append(stream.waiting.popleft())
        # The sort is stable: the keyframes of one robot keep their order.
        ready.sort(key=lambda each: (each.stamp_ns, each.robot))
        for _, step in groupby(ready, key=lambda each: each.stamp_ns):
            yield list(step)

    def requests(self, now_ns: int) -> list[m.MeasurementsRequest]:
        """Requests to the source for missing measurements."""
        found = []
        for name, stream in self._streams.items():
            missing = stream.inbox.missing(stream.end)
            if missing is not None and not stream.broken:
                incarnation, first, last = missing
                found.append(
                    m.MeasurementsRequest(
                        stamp_ns=now_ns, robot=name, incarnation=incarnation, first=first, last=last
                    )
                )
        return found
