"""A robot's stream as published messages, and the truth."""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from teamslam.sim.world import streams as s
from teamslam.sim.world.streams import RobotStream
from teamslam.team.driver.source import FIRST_INCARNATION
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
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
    """A robot's stream; its present incarnation began at measurement `base`."""

    stream: RobotStream
    incarnation: int = FIRST_INCARNATION
    base: int = 0
    published: int = 0
    consumed: int = 0
    truth_sent: int = 0
    alive: bool = False

    @property
    def counter(self) -> int:
        """Number of measurements published in this incarnation."""
        return self.published - self.base

    def outgoing(self, index: int) -> Outgoing:
        """Measurement at `index` of the whole stream, with its channel."""
        channel = _CHANNEL_OF_KIND[int(self.stream.kinds[index])]
        return Outgoing(channel, self.stream.robot, self.message(index))

    def message(self, index: int) -> m.Measurement:
        """Measurement at `index` of the whole stream, numbered in this incarnation."""
        stream, kind = self.stream, self.stream.kinds[index]
        stamp_ns = int(stream.stamps_ns[index])
        name = Name(
            stamp_ns=stamp_ns - stream.clock_offset_ns if kind == s.ODOMETRY else stamp_ns,
            robot=stream.robot,
            incarnation=self.incarnation,
            number=index - self.base,
        )
        if index == self.base and self.incarnation > FIRST_INCARNATION:
            return _start(None, name | {"stamp_ns": stamp_ns})
        if kind == s.ODOMETRY:
            return _odometry(stream.odometry(index), name)
        if kind == s.OBSERVATIONS:
            return _observations(stream.observations(index), name)
        if kind == s.SIGHTINGS:
            return _sightings(stream.sightings(index), name)
        if kind == s.FIXES:
            position, covariance = stream.fix(index)
            stated = b"" if covariance is None else from_floats(covariance)
            return m.Fix(**name, position=from_floats(position), covariance=stated)
        return _start(stream.start, name)

    def truth(self, until_ns: int, batch_ns: int = TRUTH_BATCH_NS) -> list[Outgoing]:
        """Unpublished true poses up to a time, once they span `batch_ns`."""
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


def _start(start: s.StartPose | None, name: Name) -> m.InitialPose:
    covariance = None if start is None else start.covariance
    return m.InitialPose(
        **name,
        pose=b"" if start is None else from_floats(start.pose),
        covariance=b"" if covariance is None else from_floats(covariance),
    )


def _observations(
    z: s.ObservationMeasurement, name: Name
) -> m.Observations | m.Points | m.Detections:
    """A scan in its form: without identities, points, or ranges and bearings."""
    covariances = b"" if z.covariances is None else from_floats(z.covariances)
    if z.hidden:
        return m.Detections(
            **name,
            ranges=from_floats(z.ranges),
            bearings=from_floats(z.bearings),
            covariances=covariances,
            signatures=b"" if z.signatures is None else from_floats(z.signatures),
            classes=b"" if z.classes is None else from_floats(z.classes.ravel()),
        )
    if z.points is not None:
        return m.Points(
            **name,
            ids=from_ids(z.ids),
            positions=from_floats(z.points),
            covariances=covariances,
        )
    return m.Observations(
        **name,
        ids=from_ids(z.ids),
        ranges=from_floats(z.ranges),
        bearings=from_floats(z.bearings),
        covariances=covariances,
    )


def _sightings(t: s.SightingMeasurement, name: Name) -> m.Sightings:
    return m.Sightings(
        **name,
        teammates=t.teammates,
        ranges=from_floats(t.ranges),
        bearings=from_floats(t.bearings),
    )


def _odometry(odometry: s.OdometryMeasurement, name: Name) -> m.AnyOdometry:
    if odometry.increment is not None:
        return m.Increment(
            **name,
            duration_ns=odometry.duration_ns,
            increment=from_floats(odometry.increment),
            covariance=b"" if odometry.covariance is None else from_floats(odometry.covariance),
        )
    if odometry.steered:
        return m.Steering(
            **name,
            duration_ns=odometry.duration_ns,
            wheel_speed=odometry.forward,
            steering=odometry.yaw_rate,
        )
    return m.Odometry(
        **name,
        duration_ns=odometry.duration_ns,
        forward=odometry.forward,
        yaw_rate=odometry.yaw_rate,
    )


def for_the_evaluator(stream: RobotStream) -> list[Outgoing]:
    """True identities of unidentified detections, and another sensor's (GPS) path."""
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
