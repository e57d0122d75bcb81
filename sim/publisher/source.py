"""A robot's stream as published messages, and the truth."""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from teamslam.sim.world import streams as s
from teamslam.sim.world.streams import Detections, Intervals, RobotStream
from teamslam.team.driver.source import FIRST_INCARNATION
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Outgoing

TRUTH_BATCH_NS = 1_000_000_000
_CHANNEL_OF_KIND = {
    s.START: ch.START,
    s.ODOMETRY: ch.ODOMETRY,
    s.OBSERVATIONS: ch.OBSERVATIONS,
    s.SIGHTINGS: ch.SIGHTINGS,
    s.FIXES: ch.FIXES,
}


class Name(TypedDict):
    """Common fields of measurements."""

    stamp_ns: int
    robot: str
    incarnation: int
    number: int


@dataclass
class Source:
    """A robot's stream; its incarnation began at measurement `base`."""

    stream: RobotStream
    incarnation: int = FIRST_INCARNATION
    base: int = 0
    published: int = 0
    consumed: int = 0
    truth_sent: int = 0
    alive: bool = False

    @property
    def counter(self) -> int:
        """Number of published measurements."""
        return self.published - self.base

    def outgoing(self, index: int) -> Outgoing:
        """Measurement at `index` of the stream, with its channel."""
        channel = _CHANNEL_OF_KIND[int(self.stream.kinds[index])]
        return Outgoing(channel, self.stream.robot, self.message(index))

    def message(self, index: int) -> m.Measurement:
        """Measurement at `index`, numbered in this incarnation."""
        stream = self.stream
        kind, row, stamp_ns = (int(a[index]) for a in (stream.kinds, stream.rows, stream.stamps_ns))
        name = Name(
            stamp_ns=stamp_ns - stream.clock_offset_ns if kind == s.ODOMETRY else stamp_ns,
            robot=stream.robot,
            incarnation=self.incarnation,
            number=index - self.base,
        )
        if index == self.base and self.incarnation > FIRST_INCARNATION:
            return _start(None, name | {"stamp_ns": stamp_ns})
        if kind == s.ODOMETRY:
            return _odometry(stream.intervals, row, name)
        if kind == s.OBSERVATIONS:
            return _observations(stream.landmark_detections, row, name)
        if kind == s.SIGHTINGS:
            seen = stream.teammate_detections
            at = seen.rows(row)
            return m.Sightings(
                **name,
                teammates=tuple(stream.teammates[i] for i in seen.ids[at]),
                ranges=from_floats(seen.ranges[at]),
                bearings=from_floats(seen.bearings[at]),
            )
        if kind == s.FIXES:
            position, covariance = np.split(stream.fixes[row], [2])
            return m.Fix(**name, position=from_floats(position), covariance=_stated(covariance))
        return _start(stream.start, name)

    def truth(self, until_ns: int, batch_ns: int = TRUTH_BATCH_NS) -> list[Outgoing]:
        """Unpublished true poses, once they span `batch_ns`."""
        stream = self.stream
        if stream.truth is None or stream.truth_ns is None:
            return []
        begin = self.truth_sent
        if begin >= len(stream.truth_ns) or until_ns - stream.truth_ns[begin] < batch_ns:
            return []
        end = int(np.searchsorted(stream.truth_ns, until_ns, side="right"))
        if end <= begin:
            return []
        self.truth_sent = end
        truth = m.Truth(
            stamp_ns=int(stream.truth_ns[end - 1]),
            robot=stream.robot,
            stamps=from_stamps(stream.truth_ns[begin:end]),
            poses=from_floats(stream.truth[begin:end]),
        )
        return [Outgoing(ch.TRUTH, stream.robot, truth)]


def _stated(values: np.ndarray | None) -> bytes:
    return b"" if values is None or np.isnan(values).any() else from_floats(values.ravel())


def _start(start: s.StartPose | None, name: Name) -> m.InitialPose:
    if start is None:
        return m.InitialPose(**name, pose=b"", covariance=b"")
    return m.InitialPose(**name, pose=from_floats(start.pose), covariance=_stated(start.covariance))


def _observations(
    seen: Detections, message: int, name: Name
) -> m.Observations | m.Points | m.Detections:
    at = seen.rows(message)
    points, covariances, signatures, classes = (
        _stated(None if values is None else values[at])
        for values in (seen.points, seen.covariances, seen.signatures, seen.classes)
    )
    ranges, bearings = from_floats(seen.ranges[at]), from_floats(seen.bearings[at])
    if seen.hidden is not None and seen.hidden[message]:
        return m.Detections(
            **name,
            ranges=ranges,
            bearings=bearings,
            covariances=covariances,
            signatures=signatures,
            classes=classes,
        )
    ids = from_ids(seen.ids[at])
    if seen.points is not None and (points or not ids):
        return m.Points(**name, ids=ids, positions=points, covariances=covariances)
    return m.Observations(
        **name, ids=ids, ranges=ranges, bearings=bearings, covariances=covariances
    )


def _odometry(intervals: Intervals, row: int, name: Name) -> m.AnyOdometry:
    duration_ns = int(intervals.duration_ns[row])
    if intervals.increments is not None and (increment := _stated(intervals.increments[row])):
        claims = intervals.covariances
        covariance = _stated(None if claims is None else claims[row])
        return m.Increment(
            **name, duration_ns=duration_ns, increment=increment, covariance=covariance
        )
    speed, turn = float(intervals.forward[row]), float(intervals.yaw_rate[row])
    if intervals.steered:
        return m.Steering(**name, duration_ns=duration_ns, wheel_speed=speed, steering=turn)
    return m.Odometry(**name, duration_ns=duration_ns, forward=speed, yaw_rate=turn)


def for_the_evaluator(stream: RobotStream) -> list[Outgoing]:
    """True identities, and another sensor's (GPS) path."""
    out, seen, first_ns = [], stream.landmark_detections, int(stream.stamps_ns[0])
    if seen.hidden is not None and seen.hidden.any():
        rows = np.repeat(seen.hidden, np.diff(seen.offsets))
        labels = m.TruthLabels(
            stamp_ns=first_ns,
            robot=stream.robot,
            stamps=from_stamps(seen.stamps_ns[seen.hidden]),
            counts=from_ids(np.diff(seen.offsets)[seen.hidden]),
            labels=from_ids(seen.ids[rows]),
        )
        out.append(Outgoing(ch.TRUTH_LABELS, stream.robot, labels))
    if stream.positions is not None and stream.positions_ns is not None:
        positions = m.TruthPositions(
            stamp_ns=first_ns,
            robot=stream.robot,
            stamps=from_stamps(stream.positions_ns),
            positions=from_floats(stream.positions),
        )
        out.append(Outgoing(ch.TRUTH_POSITIONS, stream.robot, positions))
    return out
