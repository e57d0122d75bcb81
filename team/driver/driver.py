"""The driver: a program hands over what its robot measures; everything else is done here.

Whatever is handed over is judged, written to the robot's file, and then goes out, on a thread of
its own: a call never waits for the network. What a robot's process or the recorder has missed they
ask for, and get from the file.
"""

import logging
import threading
import time
import warnings
from collections.abc import Collection, Iterable, Sequence
from decimal import Decimal
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from team.config import Bounds
from team.driver import journal as j
from team.driver import measured
from team.driver.link import Link
from team.driver.measured import DriverWarning, MeasurementError
from team.driver.motion import Interval, Odometer
from team.driver.node import SourceNode
from team.keys.roster import KeysError
from team.wire import messages as m
from team.wire.arrays import from_floats
from team.wire.bus import BusError
from team.wire.codec import encoded

CONNECT = "tcp/127.0.0.1:7447"
REMIND_S = 10.0
GAP_S = 1.0
"""Odometry without a duration covers no more than this."""
AWAY_S = 60.0
"""A difference of poses is believed over no more than this: the odometry may have begun anew."""
AHEAD_S = 10.0
"""What is seen may be stamped so far ahead of the odometry; beyond it they have two clocks."""
_LOG = logging.getLogger("teamslam")


class DriverError(RuntimeError):
    """The driver can not go on: why, and what to do."""


class Driver:
    """One robot's measurements on their way to its team; `with Driver(…) as robot`.

    robot: its name. team: the team's, a scenario's `team` or name. connect: where the router is.
    keys: a folder with the certificate `source-<robot>`. file: where all measurements are kept;
    default: `<robot>.stream` in the working folder. Started again with the same file the driver
    goes on where it was. start: (x [m], y [m], theta [rad]) in the team's frame, None where nobody
    knows; start_covariance: 3 × 3, None where it is exactly known. landmarks: their numbers, if
    they are known beforehand. latency_s: what is seen may come so much later than newer odometry.
    patience_s: how long to wait for the router; 0: not at all, it may come later. bounds: what is
    physically sensible.

    Times `t` are seconds of one clock for the whole team, as of Unix time. Raises DriverError where
    it can not begin; each call raises MeasurementError for what can not be a measurement.
    """

    def __init__(
        self,
        robot: str,
        *,
        team: str,
        connect: str = CONNECT,
        keys: Path | str | None = None,
        file: Path | str | None = None,
        start: Sequence[float] | None = None,
        start_covariance: ArrayLike | None = None,
        landmarks: Collection[int] | None = None,
        latency_s: float = 0.2,
        patience_s: float = 10.0,
        bounds: Bounds | None = None,
    ) -> None:
        self.robot = robot
        self._bounds = Bounds() if bounds is None else bounds
        self._start = _start_of(robot, start, start_covariance)
        self._known = None if landmarks is None else frozenset(landmarks)
        self._lock = threading.Lock()
        self._warned: set[str] = set()
        path = Path(f"{robot}.stream" if file is None else file)
        try:
            self._journal, said = j.opened(path, robot, round(1e9 * latency_s))
        except (j.JournalError, OSError) as error:
            raise DriverError(str(error)) from None
        if said:
            _LOG.info("%s", said)
        self._odometer = Odometer(robot, self._bounds)
        self._incarnation = 0
        self._again: int | None = None if self._journal.calls else -1
        self._node = SourceNode(self._journal)
        self._link = Link(self._node, team=team, connect=connect, keys=keys, lock=self._lock)
        try:
            self._link.open(patience_s)
        except (BusError, KeysError) as error:
            self._journal.close()
            raise DriverError(str(error)) from None
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the stream; where the block raised, leave only: it goes on with the next start."""
        if kind is None and not self._closed:
            self.end()
        self.close()

    # What is measured.

    def odometry(
        self,
        t: float | Decimal,
        forward: float,
        yaw_rate: float,
        duration: float | None = None,
    ) -> None:
        """Mean speed [m/s] and yaw rate [rad/s] over the `duration` seconds until t.

        Without a duration: since the last call; the first such call says when the robot begins.
        """
        stamp_ns = measured.stamp_of(t, "odometry")
        length_ns = None if duration is None else measured.stamp_of(duration, "a duration")
        with self._lock:
            self._resume(stamp_ns)
            end_ns = self._odometer.end_ns
            if length_ns is None and end_ns is not None and stamp_ns - end_ns > GAP_S * 1e9:
                self._begin_anew(end_ns, stamp_ns)
            interval = self._odometer.speeds(stamp_ns, forward, yaw_rate, length_ns)
            self._drive(stamp_ns, interval)

    def odometry_pose(self, t: float | Decimal, x: float, y: float, theta: float) -> None:
        """The pose in the odometry's own frame at t [m, rad]; its differences count."""
        stamp_ns = measured.stamp_of(t, "odometry_pose")
        pose = measured.pose_of((x, y, theta), f"odometry_pose at {float(t):.3f} s")
        with self._lock:
            self._resume(stamp_ns)
            end_ns = self._odometer.end_ns
            if end_ns is not None and stamp_ns - end_ns > AWAY_S * 1e9:
                self._begin_anew(end_ns, stamp_ns)
            interval = self._odometer.posed(stamp_ns, pose)
            if interval is None:
                self._drive(stamp_ns, None)
            self._put(j.POSE, stamp_ns, j.pose_payload(pose))
            if interval is not None:
                self._drive(stamp_ns, interval)

    def observe(
        self, t: float | Decimal, ids: ArrayLike, ranges: ArrayLike, bearings: ArrayLike
    ) -> None:
        """Landmarks seen at t: numbers, ranges [m] and bearings [rad] from the robot's heading."""
        stamp_ns = measured.stamp_of(t, "observe")
        seen = measured.observations(self.robot, stamp_ns, ids, ranges, bearings)
        self._judge_ids(np.asarray(ids).reshape(-1))
        self._see(j.OBSERVATIONS, seen)

    def observe_points(self, t: float | Decimal, ids: ArrayLike, xy: ArrayLike) -> None:
        """Landmarks seen at t: numbers, and points (ahead [m], left [m]) in the robot's frame."""
        ranges, bearings = measured.range_bearing_of(xy, f"observe_points at {float(t):.3f} s")
        self.observe(t, ids, ranges, bearings)

    def sight(
        self, t: float | Decimal, teammates: Iterable[str], ranges: ArrayLike, bearings: ArrayLike
    ) -> None:
        """Teammates seen at t: names, ranges [m] and bearings [rad]."""
        stamp_ns = measured.stamp_of(t, "sight")
        seen = measured.sightings(self.robot, stamp_ns, teammates, ranges, bearings)
        self._see(j.SIGHTINGS, seen)

    # What a program may want to know.

    @property
    def last_time(self) -> float | None:
        """The newest time that the file has [s]; None: nothing was measured."""
        return 1e-9 * self._journal.newest_ns if self._journal.incarnation else None

    @property
    def team_has_ended(self) -> bool:
        """The team's final map is out, or an operator has ended it: nothing more is taken."""
        return self._node.finished or self._node.told_to_end

    @property
    def team_pose(self) -> tuple[float, tuple[float, float, float]] | None:
        """(t, (x, y, theta)): where the robot was in the team's frame, as its process said last."""
        return self._node.team_pose

    def status(self) -> m.Status:
        """How far the stream is, who has it, and what is wrong."""
        return self._link.status()

    # The end.

    def end(self, patience_s: float | None = None) -> bool:
        """Nothing more is measured: wait until the robot's process and a recorder have all of it.

        False if that took longer than patience_s; the file has it all, and a driver that is started
        again delivers it.
        """
        self._check_open()
        with self._lock:
            if self._journal.state != "ended":
                self._journal.mark("ended")
        deadline = None if patience_s is None else time.monotonic() + patience_s
        remind = time.monotonic() + REMIND_S
        while not (self._node.is_delivered or self._node.finished):
            now = time.monotonic()
            if deadline is not None and now >= deadline:
                self.close()
                return False
            if now >= remind:
                remind = now + REMIND_S
                _LOG.info("%s", self._link.why_it_waits())
            self._check_open()
            self._link.wait(0.05)
        with self._lock:
            self._journal.mark("ended", delivered=True)
        self.close()
        return True

    def close(self) -> None:
        """Leave the team for now: who starts with the same file goes on from here."""
        if self._closed:
            return
        self._closed = True
        with self._lock:
            if self._journal.state == "open":
                self._journal.mark("left")
        self._link.close()
        self._journal.close()

    # How it is kept.

    def _check_open(self) -> None:
        if self._closed:
            raise DriverError(f"the driver of {self.robot} is closed: make another one")
        if self._link.failure is not None:
            raise DriverError(
                f"the driver of {self.robot} says nothing any more, {self._link.failure}: start it "
                f"again; {self._journal.path} has what was measured"
            )

    def _resume(self, stamp_ns: int) -> None:
        """At the first call after a start with an old file: the same once more, or what follows."""
        self._check_open()
        if self.team_has_ended:
            raise DriverError(
                f"{self.robot}: the team has ended, so nothing more is measured; for another run "
                "start its processes and a driver"
            )
        if self._again is not None:
            return
        if stamp_ns <= self._journal.newest_ns:
            self._again = 0
            return
        self._again = -1
        self._incarnation = self._journal.incarnation
        if self._journal.state == "ended":  # it comes back before anybody had the end
            self._journal.mark("open")
            self._begin(stamp_ns, known=False)
            return
        self._odometer.end_ns = self._journal.driven_ns
        self._odometer.pose = self._journal.pose

    def _put(self, kind: int, stamp_ns: int, payload: bytes) -> None:
        """Into the file, unless it is there already: a program may hand over all once more."""
        if self._again is not None and self._again >= 0:
            calls = self._journal.calls
            if self._again < len(calls):
                if self._journal.payload(calls[self._again]) != payload:
                    raise MeasurementError(
                        f"{self.robot} at {1e-9 * stamp_ns:.3f} s: time goes back behind "
                        f"{self.last_time:.3f} s, and {self._journal.path} has something else of "
                        "that time: go on behind `last_time`, or give another file"
                    )
                self._again += 1
                return
            self._again = -1
        if self._journal.state == "ended":
            raise DriverError(
                f"{self._journal.path}: {self.robot} has ended its stream at "
                f"{self.last_time:.3f} s: give another file"
            )
        if kind in (j.OBSERVATIONS, j.SIGHTINGS, j.ODOMETRY) and self._journal.too_late(
            stamp_ns, kind
        ):
            late_s = 1e-9 * (self._journal.newest_ns - stamp_ns)
            raise MeasurementError(
                f"{self.robot} at {1e-9 * stamp_ns:.3f} s: it comes when there is something "
                f"{late_s:.3f} s newer, and its turn is over: give a latency_s above {late_s:.2f}"
            )
        self._journal.append(kind, stamp_ns, payload)

    def _message(self, kind: int, message: m.Measurement) -> None:
        named = msgspec.structs.replace(message, incarnation=self._incarnation)
        self._put(kind, message.stamp_ns, encoded(named))

    def _begin(self, stamp_ns: int, *, known: bool) -> None:
        """The stream begins, or begins anew, at this time."""
        first = self._journal.first_incarnation
        self._incarnation = self._incarnation + 1 if self._incarnation else first
        pose, covariance = self._start if known else (b"", b"")
        start = m.InitialPose(
            stamp_ns=stamp_ns,
            robot=self.robot,
            incarnation=self._incarnation,
            number=0,
            pose=pose,
            covariance=covariance,
        )
        self._put(j.START, stamp_ns, encoded(start))

    def _begin_anew(self, end_ns: int, stamp_ns: int) -> None:
        """No odometry says how the robot moved: what follows is tied to it by landmarks alone."""
        self._warn(
            f"gap{stamp_ns}",
            f"{self.robot}: no odometry from {1e-9 * end_ns:.3f} to {1e-9 * stamp_ns:.3f} s: its "
            "stream begins anew at an unknown pose, and the landmarks have to place it; odometry "
            "should cover all of the time",
        )
        self._begin(stamp_ns, known=False)
        self._odometer = Odometer(self.robot, self._bounds)

    def _drive(self, stamp_ns: int, interval: Interval | None) -> None:
        if interval is None:
            if not self._incarnation:
                self._begin(stamp_ns, known=True)
            return
        begin_ns = interval.stamp_ns - interval.duration_ns
        if not self._incarnation:
            self._begin(begin_ns, known=True)
        elif self._odometer.gap_ns:
            self._begin_anew(begin_ns - self._odometer.gap_ns, begin_ns)
            self._odometer.end_ns = stamp_ns
        odometry = m.Odometry(
            stamp_ns=stamp_ns,
            robot=self.robot,
            incarnation=self._incarnation,
            number=0,
            duration_ns=interval.duration_ns,
            forward=interval.forward,
            yaw_rate=interval.yaw_rate,
        )
        self._message(j.ODOMETRY, odometry)

    def _see(self, kind: int, seen: m.Measurement) -> None:
        with self._lock:
            self._resume(seen.stamp_ns)
            if not self._incarnation:
                self._begin(seen.stamp_ns, known=True)
            driven_ns = self._odometer.end_ns
            ahead_s = 0.0 if driven_ns is None else 1e-9 * (seen.stamp_ns - driven_ns)
            if ahead_s > AHEAD_S:
                raise MeasurementError(
                    f"{self.robot} saw something at {1e-9 * seen.stamp_ns:.3f} s, {ahead_s:.0f} s "
                    "after its last odometry: both need one clock"
                )
            self._message(kind, seen)

    def _judge_ids(self, ids: np.ndarray) -> None:
        unknown = [] if self._known is None else sorted({int(i) for i in ids} - self._known)
        for each in unknown:
            self._warn(
                f"id{each}", f"{self.robot} saw landmark {each}, which is not in `landmarks`"
            )
        if len(ids) > 1 and not (ids[1:] > ids[:-1]).all():
            self._warn(
                "order",
                f"{self.robot}: ids are not ascending, or one occurs twice; they are taken as they "
                "are: each has the range and bearing in its own place",
            )

    def _warn(self, what: str, text: str) -> None:
        if what not in self._warned:
            self._warned.add(what)
            warnings.warn(text, DriverWarning, stacklevel=4)


def _start_of(
    robot: str, start: Sequence[float] | None, covariance: ArrayLike | None
) -> tuple[bytes, bytes]:
    """The initial pose as the message has it."""
    if start is None:
        return b"", b""
    pose = measured.pose_of(start, f"the start of {robot}")
    if covariance is None:
        return from_floats(pose), b""
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise MeasurementError(f"the start of {robot}: its covariance is 3 × 3, not {matrix.shape}")
    return from_floats(pose), from_floats(matrix.ravel())
