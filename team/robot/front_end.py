"""The robot's estimator behind the bounds of its stream: measurements in, estimates out.

A measurement within the bounds goes to the estimator; for one beyond them the reason is returned.
An estimator of submaps can be reset to its last submap and the measurements of the open window.
"""

from typing import NamedTuple

import numpy as np

from team import translate
from team.config import RobotConfig
from team.door import another_time
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.plausible import start_beyond
from team.estimation.scans import sensible
from team.estimation.submap import LocalMap
from team.pairs import NEEDS_MAP, PAIRS
from team.rejection import UNMEASURED, Rejection
from team.robot.estimator import (
    AT_ORIGIN,
    NOTHING_KNOWN,
    NOTHING_NEW,
    Associates,
    Estimates,
    InitialPose,
    KnownMap,
    MakesSubmaps,
    RobotEstimator,
    estimator_of,
)
from team.stream.judge import StreamJudge
from team.wire import messages as m

MOST_SET_ASIDE = 8
"""After so many measurements of one window were set aside, the estimator is not reset for
further ones."""


class IntervalOutcome(NamedTuple):
    """What an odometry interval led to, and why its motion was rejected, if it was."""

    estimates: Estimates
    rejected: Rejection | None


class BoundedEstimator:
    """The estimators of one incarnation after the other: `begin`, then each measurement in its
    order.

    estimator: of this incarnation. submaps: of this incarnation, their landmarks with identities.
    gated: number of measurements that no others of their window confirmed. warnings: what is
    implausible, in words.
    """

    def __init__(self, config: RobotConfig, warnings: list[str]) -> None:
        self._config = config
        self._warnings = warnings
        self._known = NOTHING_KNOWN if config.estimator not in NEEDS_MAP else None
        self._known_ns: int | None = None
        self._keeps_window = PAIRS[config.estimator, config.fusion] == "submap"
        self.estimator: RobotEstimator
        self._windows: MakesSubmaps | None
        self._begin_estimator(0, AT_ORIGIN)
        self._judge = StreamJudge(config.bounds)
        self._start: m.InitialPose | None = None
        self._closed: list[ClosedWindow] = []
        self._window: list[m.Measurement] = []
        self._aside = 0
        self.submaps: list[LocalMap] = []
        self.gated = 0
        self.started = False

    @property
    def waits(self) -> bool:
        """Whether it waits for the map that it localises in."""
        return self._known is None

    def know(self, message: m.KnownMap) -> None:
        """Take the map to localise in; of two the newer one by its stamp."""
        if self._known_ns is None or message.stamp_ns > self._known_ns:
            self._known_ns = message.stamp_ns
            self._known = self._sensible(KnownMap(*translate.landmarks_of(message)))

    def _sensible(self, known: KnownMap) -> KnownMap:
        """A known map without the landmarks beyond the bounds."""
        bound = self._config.bounds.coordinate_m
        inside = np.abs(known.landmarks).max(axis=1, initial=0.0) <= bound
        if not inside.all():
            self._warnings.append(f"{np.count_nonzero(~inside)} known landmarks beyond the bounds")
        return KnownMap(known.ids[inside], known.landmarks[inside])

    # An incarnation, its windows, and the way back.

    def begin(self, start: m.InitialPose) -> None:
        """Begin a new incarnation, from its initial pose."""
        self._judge = StreamJudge(self._config.bounds)
        self._begin_from(start)
        self._start, self._closed, self._window, self._aside = start, [], [], 0
        self.submaps = []

    def _begin_from(self, start: m.InitialPose) -> None:
        initial = self._believed(start)
        self.started = initial.pose is not None
        self._begin_estimator(start.incarnation, initial)
        self._goes_in(start)

    def _believed(self, start: m.InitialPose) -> InitialPose:
        """The initial pose and its covariance; one beyond the bounds is taken as unknown."""
        value = translate.start_of(start)
        why = None if value is None else start_beyond(value, self._config.bounds)
        if why is not None:
            self._warnings.append(f"the initial pose is refused, taken as unknown: {why}")
            return InitialPose(None, None)
        return InitialPose(*translate.pose_of(start))

    def _begin_estimator(self, incarnation: int, initial: InitialPose) -> None:
        known = self._known or NOTHING_KNOWN
        self.estimator = estimator_of(self._config, incarnation, initial, known)
        self._windows = self.estimator if isinstance(self.estimator, MakesSubmaps) else None

    def resume(self, submap: m.Submap) -> None:
        """Continue behind the next submap of an earlier process. Raises ValueError where there
        are none.
        """
        closed = ClosedWindow(
            sequence=submap.sequence,
            first_measurement=submap.first_measurement,
            last_measurement=submap.last_measurement,
            start_ns=submap.start_ns,
            end_ns=submap.stamp_ns,
            local=translate.local_map_of(submap),
        )
        self._resume_behind(closed)
        self._close(closed)

    def _resume_behind(self, closed: ClosedWindow) -> None:
        if self._windows is None:
            name = self._config.estimator
            raise ValueError(f"the estimator {name} has no submaps to resume from")
        self._windows.resume(closed)

    def close(self, closed: ClosedWindow) -> None:
        """Note that the open window has become a submap and the next one begins."""
        self._window, self._aside = [], 0
        self.gated += closed.gated
        self._close(
            ClosedWindow(
                sequence=closed.sequence,
                first_measurement=closed.first_measurement,
                last_measurement=closed.last_measurement,
                start_ns=closed.start_ns,
                end_ns=closed.end_ns,
                local=closed.local,
            )
        )

    def _close(self, closed: ClosedWindow) -> None:
        self._closed.append(closed)
        self.submaps.append(closed.local.named)
        self._judge = StreamJudge(self._config.bounds, closed.end_ns)

    def keep(self, measurement: m.Measurement) -> None:
        """Keep a measurement of the open window: it is repeated if the estimator is reset."""
        if self._keeps_window:
            self._window.append(measurement)

    def put_back(self) -> None:
        """Reset the estimator to the state before a measurement whose handling raised an
        exception.
        """
        self._aside += 1
        if not self._keeps_window or self._start is None or self._aside > MOST_SET_ASIDE:
            return
        self._begin_from(self._start)
        for closed in self._closed:
            self._resume_behind(closed)
        end_ns = self._closed[-1].end_ns if self._closed else None
        self._judge = StreamJudge(self._config.bounds, end_ns)
        for measurement in self._window:
            match measurement:
                case m.Odometry() | m.Increment() | m.Steering():
                    self.drive(measurement)
                case m.Observations() | m.Points() | m.Detections():
                    self.observe(measurement)
                case m.Sightings():
                    self.sight(measurement)
                case _:
                    self._goes_in(measurement)

    def _goes_in(self, measurement: m.Measurement) -> None:
        """Note that the open window, if there is one, names the measurement among its inputs."""
        if self._windows is not None:
            self._windows.consumed(measurement.number)

    @property
    def makes_submaps(self) -> bool:
        """Whether the estimator cuts the stream into windows."""
        return self._windows is not None

    def open_window(self) -> LocalMap | None:
        """The Gaussian since the last submap, if there is one."""
        return None if self._windows is None else self._windows.open_window()

    # Measurements.

    def drive(self, measurement: m.AnyOdometry) -> IntervalOutcome:
        """Take one odometry interval, or only its duration where its motion is rejected."""
        self._goes_in(measurement)
        if self._is_of_another_time(measurement):
            return IntervalOutcome(NOTHING_NEW, Rejection.TIME)
        interval = translate.interval_of(measurement, self._config)
        rejected = self._judge.odometry(interval)
        if rejected not in UNMEASURED:
            return IntervalOutcome(NOTHING_NEW, rejected)
        return IntervalOutcome(self.estimator.drive(interval, measured=rejected is None), rejected)

    def observe(self, measurement: m.AnyScan | m.Detections) -> Rejection | None:
        """Take a scan of landmarks; returns the reason if it is rejected."""
        self._goes_in(measurement)
        if isinstance(measurement, m.Detections) and not self._associates:
            return Rejection.NO_ASSOCIATION
        scan = translate.scan_of(measurement)
        near = self._judge.near(scan.ranges)
        if scan.own.size:
            near &= sensible(scan.own, scan.ranges, self._config.bounds)
        accepted, rejected = np.count_nonzero(near), self._time(measurement)
        if rejected is None and len(near) and not accepted:
            rejected = Rejection.RANGE
        if rejected is None:
            scan = scan if accepted == len(near) else scan.only(near)
            rejected = self.estimator.observe(measurement.stamp_ns, scan)
        return rejected

    def sight(self, measurement: m.Sightings) -> Rejection | None:
        """Take inter-robot measurements; returns the reason if they are rejected."""
        self._goes_in(measurement)
        teammates, ranges, bearings = translate.detections_of(measurement)
        others = np.array([name != self._config.id for name in teammates], dtype=np.bool_)
        near = self._judge.near(ranges) & others
        rejected = self._time(measurement)
        if rejected is None and len(near) and not near.any():
            rejected = Rejection.RANGE if others.any() else Rejection.ITSELF
        if rejected is not None:
            return rejected
        if self._windows is None:
            return Rejection.NO_TEAMMATES
        seen = tuple(name for name, is_near in zip(teammates, near, strict=True) if is_near)
        looks = seen, ranges[near], bearings[near]
        return self._windows.sight(measurement.stamp_ns, measurement.number, looks)

    def _time(self, measurement: m.Measurement) -> Rejection | None:
        if self._is_of_another_time(measurement):
            return Rejection.TIME
        return self._judge.time(measurement.stamp_ns)

    def _is_of_another_time(self, measurement: m.Measurement) -> bool:
        """Whether its clock has leapt so far that no receiver takes a submap with such a stamp."""
        start = self._start
        return start is not None and bool(another_time(measurement.stamp_ns, start.stamp_ns))

    @property
    def _associates(self) -> bool:
        """Whether the estimator takes detections without identities."""
        return isinstance(self.estimator, Associates) and self.estimator.associates
