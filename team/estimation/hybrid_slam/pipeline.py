"""Hybrid-SLAM on one robot's measurements: Brooks and Bailey 2009, HybridSLAM.

    a measurement comes in                        observe, sight, drive
    particles move and weigh                      advance (OpenWindow.advance)
    the window closes                             _is_full, _close
    landmarks are solved again along the paths    window.gaussian
    moments are matched                           window.gaussian
    a submap goes out                             _close

A window begins at zero where the last one ended: a submap depends on its own measurements, the
configuration and (seed, robot, incarnation, sequence) alone. `teamslam.team.estimation.map_joining`
joins submaps.
"""

from dataclasses import replace

from teamslam.team import core
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.open_window import OpenWindow
from teamslam.team.estimation.hybrid_slam.pose_grid import PoseGrid, TeammateScan
from teamslam.team.estimation.hybrid_slam.window import (
    NOTHING,
    ClosedWindow,
    Innovation,
    RunningWindow,
    Window,
)
from teamslam.team.estimation.inter_robot import CarriedPoint
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.odometry import OdometryInterval, nanoseconds, segmenter_of
from teamslam.team.estimation.scans import Scan
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.rejection import BY_CORE, Rejection

DUE = core.Segmenter.DUE


class HybridSlam:
    """One incarnation of a robot's stream, from its beginning or last submap.

    segmenter: takes the odometry; where it says DUE, call `advance`. sequence: of the open window.
    last_measurement: its newest, even a rejected one; set by the caller.
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
        """Take a scan of landmarks; returns the reason if it is rejected."""
        verdict = self.segmenter.observe(stamp_ns, scan)
        self._scans += not verdict
        return BY_CORE[verdict]

    def sight(self, stamp_ns: int, measurement: int, looks: TeammateScan) -> Rejection | None:
        """Take inter-robot measurements; returns the reason if they are rejected."""
        if self._grid is None:
            return Rejection.NO_NODES
        if self._is_late(stamp_ns):
            return Rejection.OLDER
        return self._grid.observe(stamp_ns, measurement, looks)

    def fix(self, stamp_ns: int, measurement: int, position: CarriedPoint) -> Rejection | None:
        """Take a fix of the antenna, or return the reason to reject it."""
        if self._grid is None:
            return Rejection.NO_NODES
        if self._is_late(stamp_ns):
            return Rejection.OLDER
        return self._grid.fix(stamp_ns, measurement, position)

    def _is_late(self, stamp_ns: int) -> bool:
        """Whether odometry has passed this time, or has not begun."""
        now_ns = self.segmenter.now_ns
        return now_ns is None or stamp_ns < now_ns

    def drive(self, interval: OdometryInterval) -> ClosedWindow | None:
        """Take one odometry interval; returns the window that it closes, if any."""
        return self.advance() if self.segmenter.drive(interval) >= DUE else None

    def advance(self) -> ClosedWindow | None:
        """Take the keyframes of the last interval; returns the window that it closes, if any."""
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
        """End the stream; return the last submap, and the number of uncovered scans."""
        segmenter = self.segmenter
        uncovered, start_ns, end_ns = segmenter.uncovered, segmenter.start_ns, segmenter.now_ns
        if start_ns is None or end_ns is None or end_ns <= start_ns:
            return None, uncovered
        return self._close(start_ns, end_ns), uncovered

    # The window closes.

    def _is_full(self, lasting_ns: int) -> bool:
        """Whether the window is long enough to close; a standing robot's stays open.

        Half a submap's largest number of landmarks closes it at once.
        """
        if 2 * self.window.core.landmarks >= self._config.bounds.submap_landmarks:
            return True
        is_slow = self.segmenter.driven_m < self._config.front_end.window_m
        stands = is_slow and lasting_ns < self._standing_ns
        return lasting_ns >= self._window_ns and not stands

    def _close(self, start_ns: int, end_ns: int, late: int = 0) -> ClosedWindow:
        """Close the open window; without a solution its submap is the odometry's motion."""
        rest = self.segmenter.cut(end_ns)
        self._open.core.advance_by(self.segmenter)
        self._open.confirm()
        self._open.core.move(rest)
        submap = self._open.solve(windows.gaussian)
        is_sensible = self._open.is_sensible(submap)
        uncovered = self.segmenter.uncovered
        scans, self._scans = self._scans - uncovered, uncovered
        closed = ClosedWindow(
            sequence=self.sequence,
            first_measurement=self._first_measurement,
            last_measurement=self.last_measurement,
            start_ns=start_ns,
            end_ns=end_ns,
            local=submap if is_sensible and submap is not None else self._moved_alone(),
            gated=self._open.gated,
            late=late,
            unsolved=0 if is_sensible else scans - late,
        )
        if submap is not None and is_sensible:
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
        """The particles of the open window, their paths and measurements."""
        return self._open.particles

    def running(self) -> RunningWindow | None:
        """Gaussian of the open window at its last keyframe."""
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
