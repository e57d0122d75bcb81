"""Hybrid-SLAM on one robot's measurements (Brooks and Bailey 2009, HybridSLAM).

    a measurement arrives                         observe, sight, drive
    particles move and are weighed                advance (OpenWindow.advance)
    the window closes                             _is_full, _close
    landmarks are solved again along the paths    window.gaussian
    moments are matched                           window.gaussian
    a submap is returned                          _close

A window begins at zero where the last one ended, so a submap depends on its own measurements, the
configuration and (seed, robot, incarnation, sequence) alone.

In an open window a measurement is accepted if it agrees with the earlier ones of its landmark under
the odometry; at its end a smoother compares all with all. A window without a solution becomes a
submap of the odometry's motion alone.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from teamslam.team import core
from teamslam.team.config import RobotConfig
from teamslam.team.core import Scan
from teamslam.team.estimation.gaussian import NotACovarianceError
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.pose_grid import PoseGrid, TeammateScan
from teamslam.team.estimation.hybrid_slam.redrawing import redraw_paths
from teamslam.team.estimation.hybrid_slam.unnamed_detections import (
    AssociatedKeyframes,
    associate_keyframes,
)
from teamslam.team.estimation.hybrid_slam.window import (
    NOTHING,
    ClosedWindow,
    Innovation,
    RunningWindow,
    Window,
    random_numbers,
)
from teamslam.team.estimation.inter_robot import CarriedPoint
from teamslam.team.estimation.models import Increment, nanoseconds, noise_of, segmenter_of
from teamslam.team.estimation.plausibility import submap_beyond
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.rejection import BY_CORE, Rejection

OUTLIER_SHARE = 0.01
"""Prior probability of an outlier. A landmark measurement is rejected where it is this much less
likely given the others than anywhere in view; ten times the share needs a tenth of the same
likelihood, so the value hardly matters.
"""
DEPLETED = 10.0
"""Effective number of particles below which their scatter does not estimate the uncertainty: in one
of a thousand windows of `thesis`, whose submap is then far off and overconfident (decision 20).
"""
AGAIN = 8  # factor on the number of particles when the window is computed again


UNSOLVED = (core.MotionError, core.NotFiniteError, NotACovarianceError, np.linalg.LinAlgError)
"""Errors of a window that has no solution."""
Solved = TypeVar("Solved")
DUE = core.Segmenter.DUE


class OpenWindow:
    """The particles since the window's start, and the keyframes.

    core: receives keyframes and motions. Random numbers are keyed by (seed, robot, incarnation,
    sequence).
    """

    def __init__(self, config: RobotConfig, incarnation: int, sequence: int) -> None:
        self._config = config
        self.settled = AssociatedKeyframes(())
        front, sensor = config.front_end, config.sensor
        self.core = core.OpenWindow(
            front.particles,
            noise_of(sensor),
            front.proposal == "fastslam2",
            sensor.mount,
            front.resample_below,
            sensor.max_range,
            sensor.field_of_view,
            OUTLIER_SHARE,
            random_numbers(config.seed, config.id, incarnation, sequence),
            config.bounds.submap_landmarks,
        )
        self.particles = Window(front, sensor, self.core.window)

    @property
    def gated(self) -> int:
        """Number of measurements that others of the window contradicted."""
        return self.core.rejected + self.settled.gated

    def confirm(self) -> None:
        """Compute the window again without outliers, and with associated detections.

        Depleted particles are computed with more of them (with identities and white errors:
        decision 20).
        """
        if self.core.is_solvable:
            try:
                self._settle()
            except UNSOLVED:
                self.core.give_up()

    def solve(self, step: Callable[[Window], Solved]) -> Solved | None:
        """Make the window's Gaussian by `step`; None without a solution."""
        if not self.core.is_solvable:
            return None
        try:
            return step(self.particles)
        except UNSOLVED:
            return None

    def _settle(self) -> None:
        has_others = self.core.confirm()
        if self.core.has_unnamed:
            with np.errstate(all="ignore"):
                self._associate()
            return
        particles = self._config.front_end.particles
        if has_others:
            self.core.restart(self.core.accepted(), particles)
        if self._is_depleted:
            self.core.restart(self.core.accepted(), AGAIN * particles)

    def _associate(self) -> None:
        front, most = self._config.front_end, self._config.bounds.submap_landmarks
        self.settled = associate_keyframes(
            self.core.accepted(), front.association, self._config.sensor, most
        )
        self.core.restart(self.settled.keyframes, front.particles)
        redraw_paths(self.particles, self.settled.keyframes, self.core.random)

    @property
    def _is_depleted(self) -> bool:
        sensor = self._config.sensor
        white = sensor.range_white == sensor.bearing_white == 1.0
        return white and self.core.least_effective < DEPLETED


class HybridSlam:
    """One incarnation of a robot's stream, from its beginning or last submap.

    segmenter: receives the odometry; when it returns DUE, call `advance`. sequence: of the open
    window. last_measurement: its newest, with rejected ones; set by the caller.
    """

    def __init__(self, config: RobotConfig, incarnation: int) -> None:
        front = config.front_end
        with_nodes = front.node_s > 0.0 and config.fusion == "join"
        self._config, self._incarnation = config, incarnation
        self.segmenter = segmenter_of(
            config.motion, config.sensor, front.keyframe_s, front.window_s, config.bounds
        )
        self._grid = None
        if with_nodes:
            self._grid = PoseGrid(self.segmenter, config.sensor, front, config.gnss, config.motion)
        self._window_ns = nanoseconds(front.window_s)
        self._standing_ns = nanoseconds(front.standing_s)
        self._innovation, self._scans = NOTHING, 0
        self._open: OpenWindow
        self._begin_window(0, 0)

    def resume(self, sequence: int, last_measurement: int, end_ns: int) -> None:
        """Continue after an earlier submap."""
        self.segmenter.resume(end_ns)
        if self._grid is not None:
            self._grid.begin(end_ns)
        self._begin_window(sequence + 1, last_measurement + 1)

    # A measurement comes in.

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Add a scan of landmarks, or return the reason to reject it."""
        verdict = self.segmenter.observe(stamp_ns, scan)
        self._scans += not verdict
        return BY_CORE[verdict]

    def sight(self, stamp_ns: int, measurement: int, looks: TeammateScan) -> Rejection | None:
        """Add inter-robot measurements, or return the reason to reject them."""
        if self._grid is None:
            return Rejection.NO_NODES
        if self._is_late(stamp_ns):
            return Rejection.OLDER
        return self._grid.observe(stamp_ns, measurement, looks)

    def fix(self, stamp_ns: int, measurement: int, position: CarriedPoint) -> Rejection | None:
        """Add a fix of the antenna, or return the reason to reject it."""
        if self._grid is None:
            return Rejection.NO_NODES
        if self._is_late(stamp_ns):
            return Rejection.OLDER
        return self._grid.fix(stamp_ns, measurement, position)

    def _is_late(self, stamp_ns: int) -> bool:
        now_ns = self.segmenter.now_ns
        return now_ns is None or stamp_ns < now_ns

    def drive(self, interval: core.OdometryInterval) -> ClosedWindow | None:
        """Process one odometry interval; return the window that it closes, if any."""
        return self.advance() if self.segmenter.drive(interval) >= DUE else None

    def advance(self) -> ClosedWindow | None:
        """Process the keyframes of the last interval; return the window that it closes, if any."""
        segmenter, grid = self.segmenter, self._grid
        if grid is not None:
            grid.pass_stops()
        self._open.core.advance_by(segmenter)
        start_ns, now_ns = segmenter.start_ns, segmenter.now_ns
        assert start_ns is not None
        assert now_ns is not None
        if self._is_full(now_ns - start_ns):
            return self._close(start_ns, now_ns, segmenter.leave())
        if grid is not None:
            grid.go_on(now_ns)
        return None

    def finish(self) -> tuple[ClosedWindow | None, int]:
        """End the stream; return the last submap and the number of uncovered scans."""
        segmenter = self.segmenter
        uncovered, start_ns, end_ns = segmenter.uncovered, segmenter.start_ns, segmenter.now_ns
        if start_ns is None or end_ns is None or end_ns <= start_ns:
            return None, uncovered
        return self._close(start_ns, end_ns), uncovered

    # The window closes.

    def _is_full(self, lasting_ns: int) -> bool:
        """Return whether the window closes: it lasts window_s and the robot does not stand, or it
        has half of a submap's largest number of landmarks.
        """
        if 2 * self.window.core.landmarks >= self._config.bounds.submap_landmarks:
            return True
        is_slow = self.segmenter.driven_m < self._config.front_end.window_m
        stands = is_slow and lasting_ns < self._standing_ns
        return lasting_ns >= self._window_ns and not stands

    def _close(self, start_ns: int, end_ns: int, late: int = 0) -> ClosedWindow:
        rest = self.segmenter.cut(end_ns)
        self._open.core.advance_by(self.segmenter)
        self._open.confirm()
        self._open.core.move(rest)
        submap = self._open.solve(windows.gaussian)
        if submap is not None and submap_beyond(submap, self._config.bounds) is not None:
            submap = None
        uncovered = self.segmenter.uncovered
        scans, self._scans = self._scans - uncovered, uncovered
        closed = ClosedWindow(
            sequence=self.sequence,
            first_measurement=self._first_measurement,
            last_measurement=self.last_measurement,
            start_ns=start_ns,
            end_ns=end_ns,
            local=submap or self._moved_alone(),
            gated=self._open.gated,
            late=late,
            unsolved=0 if submap is not None else scans - late,
        )
        if submap is not None:
            found = self._open.settled
            closed = replace(
                closed,
                local=replace(submap, unnamed=found.unnamed) if found.keyframes else submap,
                became=found.became,
                slips=found.slips,
                sightings=() if self._grid is None else self._grid.sightings(),
                window=windows.of_base(self.window),
                keyframes_ns=tuple(self._open.core.keyframes_ns.tolist()),
                innovation=self.window.innovation,
            )
        self._innovation = self._innovation.plus(closed.innovation)
        self.segmenter.begin(end_ns)
        if self._grid is not None:
            self._grid.begin(end_ns)
        self._begin_window(self.sequence + 1, self.last_measurement + 1)
        return closed

    def _begin_window(self, sequence: int, first_measurement: int) -> None:
        self.sequence = sequence
        self._first_measurement, self.last_measurement = first_measurement, first_measurement - 1
        self._open = OpenWindow(self._config, self._incarnation, sequence)

    # The open window meanwhile.

    @property
    def last_keyframe_ns(self) -> int | None:
        """Team time of the open window's last keyframe."""
        return self._open.core.last_keyframe_ns

    @property
    def window(self) -> Window:
        """Particles of the open window, with paths and measurements."""
        return self._open.particles

    def running(self) -> RunningWindow | None:
        """Return the Gaussian of the open window at its last keyframe."""
        if self.last_keyframe_ns is None:
            return None
        found = self._open.solve(windows.running)
        if found is None:
            alone = self._moved_alone()
            found = RunningWindow(core.WholeMap(alone.ids, alone.mean, alone.covariance))
        return found

    def _moved_alone(self) -> LocalMap:
        return windows.motion_alone(Increment(*self._open.core.base_motion()))

    @property
    def innovation(self) -> Innovation:
        """Innovations of the incarnation's windows in this process."""
        return self._innovation.plus(self.window.innovation)
