"""Keyframes from a stream of odometry intervals and scans."""

from bisect import insort

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt32
from msgspec.structs import force_setattr, replace

from team.config import MotionModel, Sensor
from team.estimation import dense, se2
from team.estimation.hybrid_slam.odometry_run import OdometryRun
from team.estimation.hybrid_slam.pose_grid import PoseGrid
from team.estimation.hybrid_slam.reduction import KeyframeScan, all_between, reduced
from team.estimation.hybrid_slam.sensitivity_kernel import carried_on
from team.estimation.models import Increment, scanned
from team.estimation.mount import of_sensor
from team.estimation.odometry import STANDING, OdometryInterval
from team.estimation.scans import Own, calibrated, unclaimed
from team.estimation.se2 import Pose, adjoint, inverse
from team.rejection import Rejection

NOTHING = np.empty(0, np.uint32), np.empty(0), np.empty(0), unclaimed(0)
"""The measurements of a keyframe without any."""
UNMEASURED = (1.0, 0.5)
"""Least standard deviation [m/s, rad/s] of a motion that was not measured; otherwise it is as
large as the motion itself."""


class Keyframe(msgspec.Struct, frozen=True, gc=False):
    """The motion since the last keyframe and the measurements at its end (accepted and calibrated).

    own: the noises that the measurements claim (`team.estimation.scans`); without rows: none do.
    Poses and motions are those of the sensor, wherever on the base it is mounted.
    looks: the scans without identities since the last keyframe, as they came. rest: the motion
    since the last of them; None: there is none.
    is_node: the pose at stamp_ns, a time of the team's grid, is a pose node of the submap.
    forward: the motion's shift by an error of the scale of speed (`odometry.forward_column`).
    """

    stamp_ns: int
    increment: Increment
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own = msgspec.field(default_factory=lambda: unclaimed(0))
    looks: tuple[KeyframeScan, ...] = ()
    rest: Increment | None = None
    is_node: bool = False
    forward: Float[np.ndarray, "3"] = msgspec.field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if len(self.own) != len(self.ids):
            force_setattr(self, "own", unclaimed(len(self.ids)))

    def only(self, taken: Bool[np.ndarray, " n"]) -> "Keyframe":
        """The keyframe with only these of its measurements."""
        return replace(
            self,
            ids=self.ids[taken],
            ranges=self.ranges[taken],
            bearings=self.bearings[taken],
            own=self.own[taken],
        )


class Segmenter:
    """Integrates odometry between keyframes; an interval is split where an observation falls into
    it.

    With keyframe_s = 0 every observation message is a keyframe. Otherwise the scans within
    keyframe_s are reduced to one range and bearing per landmark (the median, each scan first moved
    by the odometry to the end of the interval that closes the keyframe). With a grid each of its
    times is a keyframe without measurements. Scans without identities are kept as they are: which
    of their detections are of one landmark is known at the window's end.
    """

    def __init__(
        self,
        motion: MotionModel,
        sensor: Sensor,
        keyframe_s: float,
        grid: PoseGrid | None = None,
    ) -> None:
        self._motion = motion
        self._sensor = sensor
        self._keyframe_ns = round(keyframe_s * 1e9)
        self._grid = grid
        self._here_ns = 0
        self._increment = Increment.identity()
        self._forward = np.zeros(3)
        self._waiting: list[KeyframeScan] = []
        self._keyframe: list[KeyframeScan] = []
        self._scan_poses: list[Pose] = []
        self._keyframe_start_ns = 0
        self._scan_motion = np.zeros(3)
        self._since_look: Increment | None = None
        self.rest_forward = np.zeros(3)
        self._is_mounted, self._mount = sensor.is_mounted, np.array(sensor.mount)
        self._unmount = adjoint(inverse(self._mount))
        self._last = STANDING
        self._unmeasured: Float[np.ndarray, "3 3"] | None = None
        self._run = OdometryRun(motion)
        self.now_ns: int | None = None

    def begin(self, stamp_ns: int) -> None:
        """Begin a stream or a window at this team time."""
        self.now_ns = stamp_ns
        self._keyframe_start_ns = stamp_ns
        self._last = STANDING  # a submap depends on its window's measurements alone
        if self._grid is not None:
            self._grid.begin(stamp_ns)

    def observe(
        self,
        stamp_ns: int,
        ids: UInt32[np.ndarray, " n"],
        ranges: Float[np.ndarray, " n"],
        bearings: Float[np.ndarray, " n"],
        own: Own | None = None,
    ) -> Rejection | None:
        """Keep a scan until the odometry covers its time; returns the reason if it is rejected
        instead.
        """
        if self.now_ns is not None and stamp_ns < self.now_ns:
            return Rejection.OLDER
        mask, r, b = scanned(self._sensor, ranges, bearings)
        noises = unclaimed(len(r)) if own is None else own
        if not mask.all():
            if not mask.any():
                return Rejection.SENSOR_LIMITS
            ids, r, b, noises = ids[mask], r[mask], b[mask], noises[mask]
        noises = calibrated(noises, self._sensor)
        scan = KeyframeScan(stamp_ns, ids, r, b, noises)
        if self._waiting:
            insort(self._waiting, scan, key=lambda each: each.stamp_ns)
        else:
            self._waiting.append(scan)
        return None

    def drive(self, interval: OdometryInterval, *, measured: bool = True) -> list[Keyframe]:
        """Integrate one odometry interval; returns the keyframes in it, in order.

        Where its motion could not be measured, the last speeds are assumed, with standard
        deviations as large as the motion, at least UNMEASURED, and below a full rotation in
        heading.
        """
        stamp_ns, duration_ns = interval.end_ns, interval.duration_ns
        if measured:
            self._last, self._unmeasured = interval, None
            over = interval
        else:
            over = self._last.gone_on(stamp_ns, duration_ns)
            self._unmeasured = _unmeasured(duration_ns * 1e-9, over.speed, over.yaw_rate)
        keyframes = []
        self._here_ns = stamp_ns - duration_ns
        while self._waiting and self._waiting[0].stamp_ns <= stamp_ns:
            scan = self._waiting.pop(0)
            if self._grid is not None:
                keyframes += self._nodes(scan.stamp_ns - 1, over, self._grid)
            at_ns = self._go_on_to(scan.stamp_ns, over)
            if scan.is_unnamed:
                keyframes += self._look(scan, at_ns)
            elif self._keyframe_ns:
                self._keep(scan)
            else:
                self._settle()
                seen = scan.ids, scan.ranges, scan.bearings
                keyframes.append(self._keyframe_at(at_ns, *seen, scan.own))
        if self._grid is not None:
            keyframes += self._nodes(stamp_ns, over, self._grid)
        self._go_on_to(stamp_ns, over)
        self.now_ns = stamp_ns
        if self._keyframe and stamp_ns - self._keyframe_start_ns >= self._keyframe_ns:
            self._settle()
            keyframes.append(self._close_keyframe(stamp_ns))
        return keyframes

    def _look(self, scan: KeyframeScan, at_ns: int) -> list[Keyframe]:
        """Keep a scan without identities with the motion since the one before; returns its
        keyframe, if it is one.
        """
        self._settle()
        motion = self._increment if self._since_look is None else self._since_look
        scan = replace(scan, at_ns=at_ns, motion=motion)
        self._since_look = Increment.identity()
        if self._keyframe_ns:
            self._keep(scan)
            return []
        return [replace(self._keyframe_at(at_ns, *NOTHING), looks=(scan,))]

    def _keep(self, scan: KeyframeScan) -> None:
        """Keep a scan of the keyframe, here; its pose is known once the motion up to it is."""
        self._keyframe.append(scan)
        if self._run.is_pending:
            self._run.mark()
        else:
            self._scan_poses.append(self._scan_motion)

    def cut(self, stamp_ns: int) -> tuple[list[Keyframe], Increment]:
        """Close the window here: returns its last keyframe, if one is open, and the motion after
        it.

        The shift of that motion by an error of the scale of speed is `rest_forward`.
        """
        self._settle()
        keyframes = [self._close_keyframe(stamp_ns)] if self._keyframe else []
        rest, self.rest_forward = self._increment, self._forward
        self._increment, self._forward = Increment.identity(), np.zeros(3)
        self._keyframe_start_ns = stamp_ns
        self._scan_motion, self._since_look = np.zeros(3), None
        return keyframes, rest

    def leave(self) -> int:
        """End the window: drop the scans that are stamped behind it; returns their number.

        Their counters lie in the window's interval of measurements, so no later window may use
        them: a robot that is started again behind this window would not have them.
        """
        left, self._waiting = len(self._waiting), []
        return left

    @property
    def uncovered(self) -> int:
        """Number of scans that wait for odometry to cover their time."""
        return len(self._waiting)

    def _nodes(self, until_ns: int, over: OdometryInterval, grid: PoseGrid) -> list[Keyframe]:
        """The grid times up to until_ns as keyframes; inter-robot measurements up to there reach
        their node.
        """
        keyframes = []
        while (next_ns := grid.next_ns) is not None and next_ns <= until_ns:
            self._go_on_to(next_ns, over)
            self._settle()
            if grid.reach():
                keyframes.append(replace(self._keyframe_at(next_ns, *NOTHING), is_node=True))
        return keyframes

    def _go_on_to(self, stamp_ns: int, over: OdometryInterval) -> int:
        """Integrate up to a stamp; a stamp before the interval's start is taken as its start."""
        if stamp_ns <= self._here_ns:
            return self._here_ns
        self._integrate(stamp_ns - self._here_ns, over.end_ns - stamp_ns, over)
        self._here_ns = stamp_ns
        return stamp_ns

    def _integrate(self, duration_ns: int, rest_ns: int, over: OdometryInterval) -> None:
        if over.moved is None and self._unmeasured is None and not self._is_mounted:
            self._run.add(over, duration_ns)
            return
        self._settle()
        step = over.part(self._motion, duration_ns, rest_ns)
        if self._unmeasured is not None:
            added = step.covariance + duration_ns * 1e-9 * self._unmeasured
            step = Increment(step.mean, added)
        if self._grid is not None:
            self._grid.moved(step)
        if self._is_mounted:
            step = of_sensor(step, self._mount)
        self._increment = self._increment.then(step)
        if self._motion.calibrated_speed is not None:
            column = over.forward_column(self._motion, duration_ns)
            if self._is_mounted:
                column = dense.product(self._unmount, column)
            self._forward = carried_on(self._forward, step.mean) + column
        if self._keyframe_ns:
            self._scan_motion = se2.compose(self._scan_motion, step.mean)
        if self._since_look is not None:
            self._since_look = self._since_look.then(step)

    def _settle(self) -> None:
        """Bring the motions up to date with the intervals driven since the last call."""
        if not self._run.is_pending:
            return
        if self._since_look is not None:
            self._since_look = self._run.append_to(self._since_look)
        if self._grid is not None:
            self._grid.carry(self._run.append_to)
        node = Increment.identity() if self._grid is None else self._grid.since_node
        after, poses = self._run.compose(self._increment, node, self._forward, self._scan_motion)
        self._scan_poses += list(poses)
        self._increment = Increment(after.motion, after.covariance)
        if self._motion.calibrated_speed is not None:
            self._forward = after.shift
        if self._keyframe_ns:
            self._scan_motion = after.of_scan
        if self._grid is not None:
            self._grid.since_node = Increment(after.node_motion, after.node_covariance)

    def _keyframe_at(
        self,
        stamp_ns: int,
        ids: UInt32[np.ndarray, " n"],
        ranges: Float[np.ndarray, " n"],
        bearings: Float[np.ndarray, " n"],
        own: Own,
    ) -> Keyframe:
        motion = self._increment
        keyframe = Keyframe(
            stamp_ns=stamp_ns,
            increment=motion,
            ids=ids,
            ranges=ranges,
            bearings=bearings,
            own=own,
            rest=self._since_look,
            forward=self._forward,
        )
        self._increment, self._since_look = Increment.identity(), None
        self._forward = np.zeros(3)
        return keyframe

    def _close_keyframe(self, stamp_ns: int) -> Keyframe:
        backs = all_between(self._scan_motion, np.array(self._scan_poses))
        placed = list(zip(self._keyframe, backs, strict=True))
        seen = reduced([each for each in placed if not each[0].is_unnamed])
        looks = tuple(replace(scan, back=back) for scan, back in placed if scan.is_unnamed)
        self._keyframe, self._scan_poses = [], []
        self._keyframe_start_ns = stamp_ns
        self._scan_motion = np.zeros(3)
        return replace(self._keyframe_at(stamp_ns, *seen), looks=looks)


def nearest_landmarks(keyframe: Keyframe, known: UInt32[np.ndarray, " L"], most: int) -> Keyframe:
    """The keyframe without the new landmarks beyond a submap's limit; the nearest ones stay."""
    ids, ranges = keyframe.ids, keyframe.ranges
    if len(known) + len(ids) <= most:
        return keyframe
    unknown = ~np.isin(ids, known)
    new, first = np.unique(ids[unknown], return_index=True)
    nearest = new[np.argsort(ranges[unknown][first], kind="stable")[: max(most - len(known), 0)]]
    taken = ~unknown | np.isin(ids, nearest)
    return keyframe.only(taken)


def _unmeasured(duration_s: float, forward: float, yaw_rate: float) -> Float[np.ndarray, "3 3"]:
    """Variance per second of an unmeasured motion, such that errors of the speeds sum up."""
    way = max(abs(forward), UNMEASURED[0]) * duration_s
    turn = min(max(abs(yaw_rate), UNMEASURED[1]) * duration_s, np.pi)
    return np.diag([way * way, 0.01 * way * way, turn * turn]) / duration_s
