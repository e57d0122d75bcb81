"""Deliver a program's measurements to the robot's process.

Each is checked, written to the robot's file and published by a separate thread, so a call never
waits for the network. Missed measurements are sent from the file.
"""

import logging
import re
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from teamslam.team.config import Bounds
from teamslam.team.driver import journal as j, measurement_messages as make
from teamslam.team.driver.link import Link
from teamslam.team.driver.measurement_messages import (
    DriverWarning,
    MeasurementError,
    Odometer,
    Pose,
    relative_pose,
)
from teamslam.team.driver.node import SourceNode
from teamslam.team.keys.roster import KeysError
from teamslam.team.saved_map import SavedMapError, read_map
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.bus import BusError
from teamslam.team.wire.codec import encoded

CONNECT = "tcp/127.0.0.1:7447"
REMIND_S = 10.0
GAP_S = 2.0
"""Longest interval [s] that odometry without a duration covers."""
BRIDGE_S = 5.0
"""Longest gap [s] between intervals that a motion with a large covariance bridges."""
AWAY_S = 60.0
"""Longest interval [s] over which two odometry poses are differenced; a reset may be within a
longer one.
"""
JUMP_S = 86_400.0
"""A stamp later than this [s] after the last odometry is from another clock."""
AHEAD_S = 10.0
"""A landmark measurement stamped further [s] ahead of the odometry is from another clock."""
LIKELY_RAD_S = 4.0 * np.pi
"""A faster yaw rate is refused as one in degrees, unless bounds are given."""
_LOG = logging.getLogger("teamslam")


class DriverError(RuntimeError):
    """The driver cannot continue; the text has reason and remedy."""


class Driver:
    """Deliver one robot's measurements to its team; use as `with Driver(…) as robot`.

    team: as in the scenario. connect: endpoint of the router. keys: folder with the certificate
    `source-<robot>`. file: of all measurements, default `<robot>.stream`; a driver started again
    with the same file continues its stream. start: (x [m], y [m], theta [rad]) in the team's frame;
    None: unknown. start_covariance: 3 × 3; None: exact. landmarks: all landmark ids, if known.
    latency_s: longest delay of a detection behind the odometry of its time. patience_s: time to
    wait for the router with a new file; 0: connect later. bounds: physical limits of the robot;
    without them a yaw rate beyond LIKELY_RAD_S is refused, too. on_message: called in another
    thread with each message of the team for this robot (`PoseEstimate` in the team's frame,
    `FusedMap`, smoothed `Trajectory`, `Status`); it has to return at once. map: file of a saved map
    that the team's map joins, as by `teamslam central --map`; one driver of the team is enough.

    Times `t` are seconds on one clock for the whole team, such as Unix time. Raises DriverError if
    the driver cannot start; each call raises MeasurementError for an impossible value.
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
        on_message: Callable[[m.Message], None] | None = None,
        map: Path | str | None = None,  # noqa: A002
    ) -> None:
        if not re.fullmatch(make.NAME, robot):
            raise DriverError(f"{robot!r} is no robot's name: {make.NAMED}")
        self.robot = robot
        self._bounds = Bounds() if bounds is None else bounds
        self._fastest_turn = LIKELY_RAD_S if bounds is None else self._bounds.yaw_rate_rad_s
        self._start = _start_of(robot, start, start_covariance)
        self._known = None if landmarks is None else frozenset(landmarks)
        self._lock = threading.Lock()
        self._warned: set[str] = set()
        saved = None if map is None else _read_map(Path(map), with_keys=keys is not None)
        path = Path(f"{robot}.stream" if file is None else file)
        try:
            journal, said, left = j.open_journal(
                path, robot, round(1e9 * latency_s), team, self._start
            )
        except (j.JournalError, OSError) as error:
            raise DriverError(str(error)) from None
        if said:
            _LOG.log(logging.WARNING if journal.calls else logging.INFO, "%s", said)
        if left:
            warnings.warn(left, DriverWarning, stacklevel=2)
        self._odometer = Odometer(robot, self._bounds)
        self._incarnation = 0
        self._node = SourceNode(journal)
        self._node.on_message = on_message
        self._node.maps = () if saved is None else (saved,)
        self._link = Link(self._node, team=team, connect=connect, keys=keys, lock=self._lock)
        try:
            left = self._link.open(0.0 if journal.calls else patience_s)
        except (BusError, KeysError) as error:
            self._journal.close()
            raise DriverError(str(error)) from None
        if left:
            warnings.warn(left, DriverWarning, stacklevel=2)
        self._continued = self._journal
        self._again: int | None = None if self._journal.calls else -1
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the stream; after an exception only leave, so that the next start continues it."""
        if kind is None and not self._closed:
            self.end()
        self.close()

    # Measurements.

    def odometry(
        self,
        t: float | Decimal,
        forward: float,
        yaw_rate: float,
        duration: float | Decimal | None = None,
    ) -> None:
        """Add odometry: mean speed [m/s] and yaw rate [rad/s] over the `duration` seconds until t.

        Without a duration: since the last call; the first such call sets the start time.
        """
        stamp_ns, length_ns = _times(t, duration, "odometry")
        what = f"odometry of {self.robot} at {t} s"
        v, w = make.check_speeds(forward, yaw_rate, what)
        if abs(w) > self._fastest_turn:
            raise MeasurementError(
                f"{what}: a yaw rate of {w:g} rad/s is {abs(w) / (2.0 * np.pi):.1f} turns a "
                f"second: yaw rates are in radians, and {w:g} degrees are {np.radians(w):.3g}; for "
                "a robot that does turn so give bounds=Bounds(yaw_rate_rad_s=…)"
            )
        with self._lock:
            lasts_ns = self._until(stamp_ns, length_ns, "odometry")
            seconds = 1e-9 * (lasts_ns or 10**9)
            step = v * seconds, 0.0, w * seconds
            self._odometer.judge(step, lasts_ns or 10**9, "odometry", stamp_ns)
            interval = None
            if lasts_ns is not None:
                call = make.Call(self.robot, stamp_ns, f"odometry of {self.robot}")
                interval = call.message(m.Odometry, duration_ns=lasts_ns, forward=v, yaw_rate=w)
            self._drive(stamp_ns, interval, step)

    def odometry_increment(
        self,
        t: float | Decimal,
        increment: Sequence[float],
        covariance: ArrayLike | None = None,
        duration: float | Decimal | None = None,
    ) -> None:
        """Add odometry: a motion (ahead [m], left [m], turn [rad]) over `duration` seconds until t.

        The motion is in the frame of its start pose; covariance (3 × 3) in that of its end pose.
        """
        stamp_ns, length_ns = _times(t, duration, "odometry_increment")
        step = make.pose_of(increment, f"odometry_increment of {self.robot} at {t} s")
        with self._lock:
            lasts_ns = self._until(stamp_ns, length_ns, "odometry_increment")
            interval = None
            if lasts_ns is not None:
                self._odometer.judge(step, lasts_ns, "odometry_increment", stamp_ns)
                interval = self._increment(stamp_ns, lasts_ns, step, covariance)
            self._drive(stamp_ns, interval, step)

    def odometry_pose(
        self,
        t: float | Decimal,
        x: float,
        y: float,
        theta: float,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Add odometry: the pose at t in the odometry's own frame [m, rad]; differences are used.

        covariance: 3 × 3, of the motion since the last call, in the frame of its end.
        """
        stamp_ns = make.stamp_of(t, "odometry_pose")
        pose = make.pose_of((x, y, theta), f"odometry_pose of {self.robot} at {t} s")
        with self._lock:
            lasts_ns = self._until(stamp_ns, None, "odometry_pose", longest_s=AWAY_S)
            before, interval, step = self._odometer.pose, None, (0.0, 0.0, 0.0)
            if lasts_ns is not None and before is None:  # by speeds before, or a stream anew
                self._begin_anew(stamp_ns - lasts_ns, stamp_ns)
            elif lasts_ns is not None and before is not None:
                step = self._bridge_reset(relative_pose(before, pose), lasts_ns, stamp_ns, pose)
                self._odometer.judge(step, lasts_ns, "odometry_pose", stamp_ns)
                interval = self._increment(stamp_ns, lasts_ns, step, covariance)
            if not self._incarnation:
                self._begin(stamp_ns, known=True)
            self._put(j.POSE, stamp_ns, j.pose_payload(pose))
            self._drive(stamp_ns, interval, step, pose)

    def observe(
        self,
        t: float | Decimal,
        ids: ArrayLike,
        ranges: ArrayLike,
        bearings: ArrayLike,
        covariances: ArrayLike | None = None,
    ) -> None:
        """Add a scan of landmarks at t: ids, ranges [m] and bearings [rad] from the sensor's axis.

        covariances: L × 2 × 2 of (range, bearing); None: the sensor's noise.
        """
        call = self._call(t, "observe")
        seen = make.observations(call, ids, (ranges, bearings), covariances)
        self._judge_ids(np.asarray(ids).reshape(-1))
        self._see(j.OBSERVATIONS, seen)

    def observe_points(
        self,
        t: float | Decimal,
        ids: ArrayLike,
        xy: ArrayLike,
        covariances: ArrayLike | None = None,
    ) -> None:
        """Add a scan of landmarks at t: ids and points (ahead [m], left [m]) in the sensor's frame.

        covariances: L × 2 × 2; None: the sensor's noise of range and bearing.
        """
        call = self._call(t, "observe_points")
        seen = make.points(call, ids, xy, covariances)
        self._judge_ids(np.asarray(ids).reshape(-1))
        self._see(j.OBSERVATIONS, seen)

    def detect(
        self,
        t: float | Decimal,
        ranges: ArrayLike,
        bearings: ArrayLike,
        covariances: ArrayLike | None = None,
        classes: ArrayLike | None = None,
    ) -> None:
        """Add a scan of landmarks without identities at t: ranges [m] and bearings [rad].

        classes: a row P(its reported class | class c) for each landmark.
        """
        call = self._call(t, "detect")
        seen = make.detections(call, (ranges, bearings), covariances, classes)
        self._see(j.OBSERVATIONS, seen)

    def sight(
        self, t: float | Decimal, teammates: Iterable[str], ranges: ArrayLike, bearings: ArrayLike
    ) -> None:
        """Add inter-robot measurements at t: teammates' names, ranges [m] and bearings [rad]."""
        call = self._call(t, "sight")
        seen = make.sightings(call, teammates, ranges, bearings)
        self._see(j.SIGHTINGS, seen)

    def fix(
        self, t: float | Decimal, x: float, y: float, covariance: ArrayLike | None = None
    ) -> None:
        """Add an absolute position of the antenna at t: (x, y) [m] in the frame of the survey.

        covariance: 2 × 2 [m²]; None: `gnss.sigma_m` of the robot's configuration.
        """
        call = self._call(t, "fix")
        self._see(j.SIGHTINGS, make.fix(call, (x, y), covariance))

    # State.

    @property
    def path(self) -> Path:
        """File of all measurements."""
        return self._journal.path

    @property
    def last_time(self) -> float | None:
        """Newest time in the file [s]; None: the file is empty."""
        return 1e-9 * self._journal.newest_ns if self._journal.incarnation else None

    @property
    def team_has_ended(self) -> bool:
        """Whether the final map is published or an operator has ended the team."""
        return self._node.finished or self._node.ordered_to_end

    @property
    def team_pose(self) -> tuple[float, tuple[float, float, float]] | None:
        """The last (t, (x, y, theta)) in the team's frame; None: not joined."""
        return self._node.team_pose

    @property
    def sensor_mount(self) -> tuple[float, float, float] | None:
        """The sensor's pose (x [m], y [m], yaw [rad]) on the robot; None: not yet announced."""
        models = self._node.models
        return None if models is None else models.sensor.mount

    @property
    def antenna(self) -> tuple[float, float] | None:
        """The GNSS antenna's place (ahead, left) [m] on the robot; None: not yet announced."""
        models = self._node.models
        return None if models is None else models.gnss.antenna

    def status(self) -> m.Status:
        """Return counts, receivers' progress and problems of the stream."""
        return self._link.status()

    def tell(self, figures: Mapping[str, float], warnings: Iterable[str]) -> None:
        """Add the figures and warnings of this driver's input to its status."""
        self._node.fed = dict(figures), tuple(warnings)

    # The end.

    def end(self, patience_s: float | None = None) -> bool:
        """End the stream and wait until the robot's process and a recorder have all of it.

        Returns False after patience_s; a driver started again with the file delivers the rest.
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
        """Leave the team; a driver started with the same file continues the stream."""
        if self._closed:
            return
        self._closed = True
        with self._lock:
            if self._journal.state == "open":
                self._journal.mark("left")
        self._link.close()
        self._journal.close()

    # The stream and its file.

    @property
    def _journal(self) -> j.Journal:
        return self._node.journal

    def _check_open(self) -> None:
        if self._closed:
            raise DriverError(f"the driver of {self.robot} is closed: make another one")
        if self._link.failure is not None:
            raise DriverError(
                f"the driver of {self.robot} has stopped, {self._link.failure}: start it again; "
                f"all measurements are in {self._journal.path}"
            )

    def _resume(self, stamp_ns: int) -> None:
        """Decide at the first call with an old file whether the program repeats or continues it."""
        self._check_open()
        if self.team_has_ended:
            raise DriverError(
                f"{self.robot}: the team has ended, so nothing more is measured; for another run "
                "start its processes and a driver"
            )
        if self._continued is not self._journal:
            self._begin_again()
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

    def _begin_again(self) -> None:
        """Begin the empty stream of a later run at an unknown pose: the robot may have moved."""
        self._continued, self._start = self._journal, (b"", b"")
        self._again, self._incarnation = -1, 0
        self._odometer = Odometer(self.robot, self._bounds)
        self._warn(self._link.left, f"{self._link.left} at an unknown pose")

    def _put(self, kind: int, stamp_ns: int, payload: bytes) -> None:
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
            remedy = f"give a latency_s above {late_s:.2f}"
            if late_s > AWAY_S:
                remedy = "all that a robot measures needs one clock"
            raise MeasurementError(
                f"{self.robot} at {1e-9 * stamp_ns:.3f} s: too late, measurements up to "
                f"{late_s:.3f} s newer have been published: {remedy}"
            )
        self._journal.append(kind, stamp_ns, payload)

    def _message(self, kind: int, message: m.Measurement) -> None:
        named = msgspec.structs.replace(message, incarnation=self._incarnation)
        self._put(kind, message.stamp_ns, encoded(named))

    def _begin(self, stamp_ns: int, *, known: bool) -> None:
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
        self._warn(
            f"gap{stamp_ns}",
            f"{self.robot}: no odometry from {1e-9 * end_ns:.3f} to {1e-9 * stamp_ns:.3f} s: its "
            "stream begins again at an unknown pose, which the landmarks have to determine; "
            "odometry should cover all of the time",
        )
        self._begin(stamp_ns, known=False)
        self._odometer = Odometer(self.robot, self._bounds)

    def _bridge_reset(self, step: Pose, lasts_ns: int, stamp_ns: int, pose: Pose) -> Pose:
        if not self._odometer.was_reset(step, lasts_ns, pose):
            return step
        self._warn(
            f"reset{stamp_ns}",
            f"{self.robot}: the odometry's pose jumps by {np.hypot(*step[:2]):.1f} m at "
            f"{1e-9 * stamp_ns:.3f} s: a reset; the robot is assumed to have moved as before",
        )
        return self._odometer.as_before(lasts_ns)

    def _increment(
        self, stamp_ns: int, lasts_ns: int, step: Pose, covariance: ArrayLike | None
    ) -> m.Increment:
        call = make.Call(self.robot, stamp_ns, f"the covariance of {self.robot}")
        return call.message(
            m.Increment,
            duration_ns=lasts_ns,
            increment=from_floats(step),
            covariance=make.square(covariance, call.what),
        )

    def _until(
        self, stamp_ns: int, length_ns: int | None, call: str, longest_s: float = GAP_S
    ) -> int | None:
        """Return the length [ns] of the interval that ends now; None: a gap to bridge, or a new
        start.
        """
        self._resume(stamp_ns)
        end_ns = self._odometer.end_ns
        away_ns = 0 if end_ns is None else stamp_ns - end_ns
        if end_ns is not None and away_ns > JUMP_S * 1e9:
            raise MeasurementError(
                f"{call} of {self.robot} at {1e-9 * stamp_ns:.3f} s: {away_ns * 1e-9:.0f} s after "
                f"the last odometry, {1e-9 * end_ns:.3f} s: another clock. Use one clock for all "
                "times, in seconds; use another file for a stream on another clock"
            )
        if length_ns is None and end_ns is not None and away_ns > longest_s * 1e9:
            if away_ns <= BRIDGE_S * 1e9:
                self._odometer.gap_ns = away_ns
                return None
            self._begin_anew(end_ns, stamp_ns)
        return self._odometer.until(stamp_ns, length_ns, call)

    def _drive(
        self, stamp_ns: int, interval: m.AnyOdometry | None, step: Pose, pose: Pose | None = None
    ) -> None:
        """Append an odometry interval, after one that bridges the gap before it."""
        lasts_ns = 0 if interval is None else interval.duration_ns
        begin_ns = stamp_ns - lasts_ns
        gap_ns = self._odometer.gap_ns
        if not self._incarnation:
            self._begin(begin_ns, known=True)
        elif gap_ns > BRIDGE_S * 1e9:
            self._begin_anew(begin_ns - gap_ns, begin_ns)
        elif gap_ns:
            self._warn(
                f"gap{begin_ns}",
                f"{self.robot}: no odometry from {1e-9 * (begin_ns - gap_ns):.3f} to "
                f"{1e-9 * begin_ns:.3f} s: the robot is assumed to have moved as before, with a "
                "large covariance; odometry should cover all of the time",
            )
            over, covariance = self._odometer.bridge()
            bridged = self._increment(begin_ns, gap_ns, over, np.reshape(covariance, (3, 3)))
            self._message(j.ODOMETRY, bridged)
        if interval is not None:
            self._message(j.ODOMETRY, interval)
        self._odometer.add(stamp_ns, step, lasts_ns, pose)

    def _see(self, kind: int, seen: m.Measurement) -> None:
        with self._lock:
            self._resume(seen.stamp_ns)
            if not self._incarnation:
                self._begin(seen.stamp_ns, known=True)
            driven_ns = self._odometer.end_ns
            ahead_s = 0.0 if driven_ns is None else 1e-9 * (seen.stamp_ns - driven_ns)
            if ahead_s > AHEAD_S:
                raise MeasurementError(
                    f"{self.robot}: a detection at {1e-9 * seen.stamp_ns:.3f} s, {ahead_s:.0f} s "
                    "after the last odometry: both need one clock"
                )
            self._message(kind, seen)

    def _call(self, t: float | Decimal, name: str) -> make.Call:
        return make.Call(self.robot, make.stamp_of(t, name), name)

    def _judge_ids(self, ids: np.ndarray) -> None:
        unknown = [] if self._known is None else sorted({int(i) for i in ids} - self._known)
        for each in unknown:
            self._warn(
                f"id{each}", f"{self.robot} saw landmark {each}, which is not in `landmarks`"
            )
        if len(ids) > 1 and not (ids[1:] > ids[:-1]).all():
            self._warn(
                "order",
                f"{self.robot}: ids are not ascending, or one occurs twice; each is used with the "
                "range and bearing at its index",
            )

    def _warn(self, what: str, text: str) -> None:
        if what not in self._warned:
            self._warned.add(what)
            warnings.warn(text, DriverWarning, stacklevel=4)


def _times(
    t: float | Decimal, duration: float | Decimal | None, call: str
) -> tuple[int, int | None]:
    length_ns = None if duration is None else make.stamp_of(duration, "a duration")
    return make.stamp_of(t, call), length_ns


def _read_map(path: Path, *, with_keys: bool) -> m.SavedMap:
    if with_keys:
        raise DriverError(
            f"{path}: with keys a driver may not publish a map: give it to `teamslam central --map`"
        )
    try:
        return read_map(path)
    except SavedMapError as error:
        raise DriverError(str(error)) from None


def _start_of(
    robot: str, start: Sequence[float] | None, covariance: ArrayLike | None
) -> tuple[bytes, bytes]:
    if start is None:
        return b"", b""
    what = f"the start of {robot}"
    pose = make.pose_of(start, what)
    if abs(pose[2]) > 2.0 * np.pi:
        raise MeasurementError(f"{what}: theta is {pose[2]:g}; it is in radians, in one turn")
    packed = make.square(covariance, what)
    if covariance is not None:
        make.check_definite(np.asarray(covariance, dtype=np.float64)[np.newaxis], what)
    return from_floats(pose), packed
