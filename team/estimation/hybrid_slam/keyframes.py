"""Keyframes from a stream of odometry intervals and scans."""

import math
from bisect import insort
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import force_setattr, replace

from teamslam.team import core
from teamslam.team.config import MotionModel, Sensor
from teamslam.team.estimation.hybrid_slam.pose_grid import PoseGrid
from teamslam.team.estimation.hybrid_slam.reduction import KeyframeScan, reduced
from teamslam.team.estimation.models import Increment, model_of, scanned
from teamslam.team.estimation.odometry import STANDING, OdometryInterval
from teamslam.team.estimation.scans import Own, calibrated, unclaimed
from teamslam.team.rejection import Rejection
from teamslam.team.shapes import Bool, Float, UInt32

NOTHING = np.empty(0, np.uint32), np.empty(0), np.empty(0), unclaimed(0)
"""The measurements of a keyframe without any."""
UNMEASURED = (1.0, 0.5)
"""Least standard deviation [m/s, rad/s] of a motion that was not measured; otherwise it is as
large as the motion itself."""


class Keyframe(msgspec.Struct, frozen=True, gc=False):
    """The sensor's motion since the last keyframe and the measurements at its end (accepted and
    calibrated).

    own: claimed noises (`teamslam.team.estimation.scans`), without rows if none. looks: the scans
    without identities since the last keyframe. rest: the motion since the last of them. is_node:
    the pose at stamp_ns is a pose node of the submap. forward: the motion's shift by an error of
    the scale of speed, and its duration (`core.Odometry`).
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
    forward: Float[np.ndarray, "4"] = msgspec.field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        if len(self.own) != len(self.ids):
            force_setattr(self, "own", unclaimed(len(self.ids)))

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The arguments of `core.OpenWindow.admit` and `take`."""
        motion, node_ns = self.increment, self.stamp_ns if self.is_node else None
        seen = self.ids, self.ranges, self.bearings, self.own
        return motion.mean, motion.covariance, self.forward, *seen, node_ns

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
    """Integrates odometry between keyframes; an observation splits an interval.

    With keyframe_s = 0 every observation message is a keyframe. Otherwise the scans within
    keyframe_s are reduced to the median range and bearing per landmark, moved by the odometry to
    the end of the interval that closes the keyframe. Each grid time is a keyframe without
    measurements. Scans without identities are kept until the window's end.
    """

    def __init__(
        self,
        motion: MotionModel,
        sensor: Sensor,
        keyframe_s: float,
        grid: PoseGrid | None = None,
    ) -> None:
        self._sensor = sensor
        self._keyframe_ns = round(keyframe_s * 1e9)
        self._grid = grid
        self._here_ns = 0
        self._odometry = core.Odometry(
            model_of(motion), sensor.mount if sensor.is_mounted else None
        )
        self._waiting: list[KeyframeScan] = []
        self._keyframe: list[KeyframeScan] = []
        self._keyframe_start_ns = 0
        self.rest_forward = np.zeros(4)
        self._last = STANDING
        self._unmeasured: tuple[float, float, float] | None = None
        self.now_ns: int | None = None

    def begin(self, stamp_ns: int) -> None:
        """Begin a stream or a window at this team time."""
        self.now_ns = stamp_ns
        self._keyframe_start_ns = stamp_ns
        self._last = STANDING  # a submap depends on its window's measurements alone
        if self._grid is not None:
            self._grid.begin(stamp_ns)
            self._odometry.forget_sightings()

    def observe(
        self,
        stamp_ns: int,
        ids: UInt32[np.ndarray, " n"],
        ranges: Float[np.ndarray, " n"],
        bearings: Float[np.ndarray, " n"],
        own: Own | None = None,
    ) -> Rejection | None:
        """Keep a scan until the odometry covers its time, or return the reason to reject it."""
        if self.now_ns is not None and stamp_ns < self.now_ns:
            return Rejection.OLDER
        mask, r, b = scanned(self._sensor, ranges, bearings)
        noises = unclaimed(len(r)) if own is None else own
        if not all(mask.tolist()):  # so few are tested sooner as a list
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
        """Integrate one odometry interval; return its keyframes in order.

        An unmeasured motion has the last speeds, with standard deviations as large as the motion,
        at least UNMEASURED, and below a full rotation in heading.
        """
        stamp_ns, duration_ns = interval.end_ns, interval.duration_ns
        grid, keyframes = self._grid, []
        if measured:
            self._unmeasured = None
            over = self._last = interval
        else:
            over = self._last.gone_on(stamp_ns, duration_ns)
            self._unmeasured = _unmeasured(duration_ns * 1e-9, over.speed, over.yaw_rate)
        self._here_ns = stamp_ns - duration_ns
        while self._waiting and self._waiting[0].stamp_ns <= stamp_ns:
            scan = self._waiting.pop(0)
            if grid is not None:
                keyframes += self._nodes(scan.stamp_ns - 1, over, grid)
            at_ns = self._go_on_to(scan.stamp_ns, over)
            if scan.is_unnamed:
                keyframes += self._look(scan, at_ns)
            elif self._keyframe_ns:
                self._keep(scan)
            else:
                seen = scan.ids, scan.ranges, scan.bearings
                keyframes.append(self._keyframe_at(at_ns, *seen, scan.own))
        if grid is not None and grid.next_ns <= stamp_ns:
            keyframes += self._nodes(stamp_ns, over, grid)
        self._go_on_to(stamp_ns, over)
        self.now_ns = stamp_ns
        if self._keyframe and stamp_ns - self._keyframe_start_ns >= self._keyframe_ns:
            keyframes.append(self._close_keyframe(stamp_ns))
        return keyframes

    def _look(self, scan: KeyframeScan, at_ns: int) -> list[Keyframe]:
        """Keep a scan without identities; return its keyframe, if any."""
        motion = Increment(*self._odometry.pass_unnamed_scan())
        scan = replace(scan, at_ns=at_ns, motion=motion)
        if self._keyframe_ns:
            self._keep(scan)
            return []
        return [replace(self._keyframe_at(at_ns, *NOTHING), looks=(scan,))]

    def _keep(self, scan: KeyframeScan) -> None:
        self._keyframe.append(scan)
        self._odometry.mark_scan()

    def cut(self, stamp_ns: int) -> tuple[list[Keyframe], Increment]:
        """Close the window: return its last open keyframe, and the later motion (`rest_forward`:
        its `Keyframe.forward`).
        """
        keyframes = [self._close_keyframe(stamp_ns)] if self._keyframe else []
        rest, self.rest_forward, _ = self._odometry.end_keyframe()
        self._odometry.end_scans()
        self._keyframe_start_ns = stamp_ns
        return keyframes, Increment(*rest)

    def leave(self) -> int:
        """End the window: drop the scans stamped behind it; return their number.

        Their counters lie in this window's interval of measurements: a robot restarted behind it
        would lack them.
        """
        left, self._waiting = len(self._waiting), []
        return left

    @property
    def uncovered(self) -> int:
        """Number of scans that wait for odometry to cover their time."""
        return len(self._waiting)

    def _nodes(self, until_ns: int, over: OdometryInterval, grid: PoseGrid) -> list[Keyframe]:
        """The grid times up to until_ns as keyframes."""
        keyframes = []
        while (next_ns := grid.next_ns) <= until_ns:
            self._go_on_to(next_ns, over)
            if grid.reach(self._odometry, over):
                keyframes.append(replace(self._keyframe_at(next_ns, *NOTHING), is_node=True))
        return keyframes

    def _go_on_to(self, stamp_ns: int, over: OdometryInterval) -> int:
        duration_ns = stamp_ns - self._here_ns
        if duration_ns <= 0:
            return self._here_ns
        self._here_ns = stamp_ns
        part_s, added = duration_ns * 1e-9, self._unmeasured
        if over.moved is None:
            self._odometry.drive(part_s, over.forward, over.yaw_rate, added)
            return stamp_ns
        interval_s, rest_ns = over.duration_ns * 1e-9, over.end_ns - stamp_ns
        share, rest = duration_ns / over.duration_ns, rest_ns / over.duration_ns
        self._odometry.move(*over.moved, interval_s, part_s, share, rest, added)
        return stamp_ns

    def _keyframe_at(
        self,
        stamp_ns: int,
        ids: UInt32[np.ndarray, " n"],
        ranges: Float[np.ndarray, " n"],
        bearings: Float[np.ndarray, " n"],
        own: Own,
    ) -> Keyframe:
        motion, forward, rest = self._odometry.end_keyframe()
        return Keyframe(
            stamp_ns=stamp_ns,
            increment=Increment(*motion),
            ids=ids,
            ranges=ranges,
            bearings=bearings,
            own=own,
            rest=None if rest is None else Increment(*rest),
            forward=forward,
        )

    def _close_keyframe(self, stamp_ns: int) -> Keyframe:
        placed = list(zip(self._keyframe, self._odometry.end_scans(), strict=True))
        seen = reduced([each for each in placed if not each[0].is_unnamed])
        looks = tuple(replace(scan, back=back) for scan, back in placed if scan.is_unnamed)
        self._keyframe = []
        self._keyframe_start_ns = stamp_ns
        return replace(self._keyframe_at(stamp_ns, *seen), looks=looks)


def nearest_landmarks(keyframe: Keyframe, known: UInt32[np.ndarray, " L"], most: int) -> Keyframe:
    """Drop the farthest new landmarks beyond a submap's limit."""
    ids, ranges = keyframe.ids, keyframe.ranges
    if len(known) + len(ids) <= most:
        return keyframe
    unknown = ~np.isin(ids, known)
    new, first = np.unique(ids[unknown], return_index=True)
    nearest = new[np.argsort(ranges[unknown][first], kind="stable")[: max(most - len(known), 0)]]
    taken = ~unknown | np.isin(ids, nearest)
    return keyframe.only(taken)


def _unmeasured(duration_s: float, forward: float, yaw_rate: float) -> tuple[float, float, float]:
    """Variances per second of an unmeasured motion; errors of the speeds sum up."""
    way = max(abs(forward), UNMEASURED[0]) * duration_s
    turn = min(max(abs(yaw_rate), UNMEASURED[1]) * duration_s, math.pi)
    return way * way / duration_s, 0.01 * way * way / duration_s, turn * turn / duration_s
