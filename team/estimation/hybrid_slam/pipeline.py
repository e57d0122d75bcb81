"""Hybrid-SLAM on one robot's measurements: Brooks and Bailey 2009, HybridSLAM.

    a measurement comes in                        observe, sight, drive
    particles move and weigh                      _advance, _admit, _take
    the window closes                             _is_full, _close
    landmarks are solved again along the paths    _solved
    moments are matched                           _solved
    a submap goes out                             _close

A window begins at zero where the last one ended, so a submap depends on its own measurements, the
configuration and (seed, robot, incarnation, sequence) alone. Joining submaps is the back end's:
`team.estimation.map_joining`.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from team.config import RobotConfig
from team.estimation.gaussian import NotACovarianceError
from team.estimation.hybrid_slam import window as windows
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.hybrid_slam.innovation import NOTHING, Innovation
from team.estimation.hybrid_slam.keyframes import Keyframe, Segmenter, nearest_landmarks
from team.estimation.hybrid_slam.outliers import OutlierGate
from team.estimation.hybrid_slam.pose_grid import Looks, PoseGrid
from team.estimation.hybrid_slam.window import Window
from team.estimation.models import Increment
from team.estimation.plausible import submap_beyond
from team.estimation.randomness import generator
from team.estimation.submap import LocalMap
from team.rejection import Rejection

Scan = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Landmark ids, ranges [m] and bearings [rad] of one message."""


class HybridSlam:
    """One incarnation of a robot's stream, from its beginning or from its last submap."""

    sequence: int
    window: Window
    last_keyframe_ns: int | None
    _start_ns: int | None
    _way_m: float
    _motion: Increment
    _solvable: bool
    _generator: np.random.Generator

    def __init__(self, config: RobotConfig, incarnation: int) -> None:
        front = config.front_end
        with_nodes = front.node_s > 0.0 and config.fusion == "join"
        self._config, self._incarnation = config, incarnation
        self._grid = PoseGrid(config.sensor, front) if with_nodes else None
        self._segmenter = Segmenter(config.motion, config.sensor, front.keyframe_s, self._grid)
        self._gate = OutlierGate(config.sensor, front.garbage)
        self._innovation, self._scans = NOTHING, 0
        self._open(0, 0, None)

    def resume(self, closed: ClosedWindow) -> None:
        """Go on behind a submap of an earlier life: the next window begins where it ended."""
        self._open(closed.sequence + 1, closed.last_measurement + 1, closed.end_ns)

    # A measurement comes in.

    def consumed(self, measurement: int) -> None:
        """The measurement belongs to the open window (or was rejected while it was open)."""
        self._last_measurement = measurement

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Take a scan of landmarks; the reason if it is rejected."""
        reason = self._segmenter.observe(stamp_ns, *scan)
        self._scans += reason is None
        return reason

    def sight(self, stamp_ns: int, measurement: int, looks: Looks) -> Rejection | None:
        """Take inter-robot measurements; the reason if they are rejected."""
        if self._grid is None:
            return Rejection.NO_TEAMMATES
        if self._start_ns is None:
            return Rejection.OLDER
        return self._grid.observe(stamp_ns, measurement, looks)

    def drive(
        self,
        stamp_ns: int,
        duration_ns: int,
        forward: float,
        yaw_rate: float,
        *,
        measured: bool = True,
    ) -> ClosedWindow | None:
        """Take one odometry interval, the keyframes that lie in it, and the window that it ends."""
        if self._start_ns is None:
            self._start_ns = stamp_ns - duration_ns
            self._segmenter.begin(self._start_ns)
        self._way_m += abs(forward) * duration_ns * 1e-9
        interval = stamp_ns, duration_ns, forward, yaw_rate
        for keyframe in self._segmenter.drive(*interval, measured=measured):
            self._advance(keyframe)
        if self._is_full(stamp_ns - self._start_ns):
            return self._close(stamp_ns, self._segmenter.leave())
        if self._grid is not None:
            self._grid.go_on(stamp_ns)
        return None

    def finish(self) -> tuple[ClosedWindow | None, int]:
        """The stream has ended: the last submap, and how many scans no odometry covered."""
        uncovered, end_ns = self._segmenter.uncovered, self._segmenter.now_ns
        if self._start_ns is None or end_ns is None or end_ns <= self._start_ns:
            return None, uncovered
        return self._close(end_ns), uncovered

    # Particles move and weigh.

    def _advance(self, keyframe: Keyframe) -> None:
        self._motion = self._motion.then(keyframe.increment)
        self.last_keyframe_ns = keyframe.stamp_ns
        self._try(lambda: self._admit(keyframe))

    def _admit(self, keyframe: Keyframe) -> None:
        most = self._config.bounds.submap_landmarks
        bounded = nearest_landmarks(keyframe, self.window.particles.ids, most)
        self._take(self._gate.admitted(bounded))

    def _take(self, keyframe: Keyframe) -> None:
        self.window = windows.advanced(
            self.window,
            keyframe.increment,
            keyframe.ids,
            keyframe.ranges,
            keyframe.bearings,
            self._generator,
            keyframe.forward,
        )
        if keyframe.is_node:
            self.window = windows.marked(self.window, keyframe.stamp_ns)

    def _try(self, step: Callable[[], None]) -> None:
        """Take a step of the particles, unless one has failed: then no measurement counts."""
        if self._solvable:
            try:
                with np.errstate(all="ignore"):
                    step()
            except (NotACovarianceError, np.linalg.LinAlgError):
                self._solvable = False

    # The window closes.

    def _is_full(self, lasting_ns: int) -> bool:
        """Whether the window is long enough to close; one of a standing robot goes on.

        One that has seen half as many landmarks as a submap may hold closes at once.
        """
        front, bounds = self._config.front_end, self._config.bounds
        if 2 * len(self.window.particles.ids) >= bounds.submap_landmarks:
            return True
        standing = self._way_m < front.window_m and lasting_ns < round(front.standing_s * 1e9)
        return lasting_ns >= round(front.window_s * 1e9) and not standing

    def _close(self, stamp_ns: int, late: int = 0) -> ClosedWindow:
        last, rest = self._segmenter.cut(stamp_ns)
        for keyframe in last:
            self._advance(keyframe)
        if self._gate.judges:
            self._try(self._settle)
        if rest.mean.any() or rest.covariance.any():
            self._motion = self._motion.then(rest)
            self._try(lambda: self._go(rest))
        submap = self._solved()
        scans, self._scans = self._scans - self._segmenter.uncovered, self._segmenter.uncovered
        assert self._start_ns is not None
        closed = ClosedWindow(
            sequence=self.sequence,
            first_measurement=self._first_measurement,
            last_measurement=self._last_measurement,
            start_ns=self._start_ns,
            end_ns=stamp_ns,
            local=windows.motion_alone(self._motion) if submap is None else submap,
            gated=self._gate.gated,
            late=late,
            unsolved=scans - late if submap is None else 0,
        )
        if submap is not None:
            closed = replace(
                closed,
                sightings=() if self._grid is None else self._grid.sightings(),
                particles=self.window.particles,
                innovation=self.window.innovation,
            )
        self._innovation = self._innovation.plus(closed.innovation)
        self._open(self.sequence + 1, self._last_measurement + 1, stamp_ns)
        return closed

    def _settle(self) -> None:
        """The window once more with the measurements that all of it confirms."""
        self._reopen()
        for keyframe in self._gate.settled():
            self._take(keyframe)

    def _go(self, rest: Increment) -> None:
        """The motion after the last keyframe."""
        forward = self._segmenter.rest_forward
        self.window = windows.moved(self.window, rest, self._generator, forward)

    # Landmarks are solved again along the paths, moments are matched.

    def _solved(self, *, running: bool = False) -> LocalMap | None:
        """The window as a Gaussian; None where there is none, or none that is sensible."""
        if not self._solvable:
            return None
        try:
            with np.errstate(all="ignore"):
                landmarks = windows.landmarks_solved_again(self.window, running=running)
                submap = windows.moments_matched(self.window, landmarks)
        except (NotACovarianceError, np.linalg.LinAlgError):
            return None
        return submap if running or not submap_beyond(submap, self._config.bounds) else None

    def running(self) -> LocalMap | None:
        """The open window's Gaussian at its last keyframe, if it has one; no submap."""
        if self.last_keyframe_ns is None:
            return None
        return self._solved(running=True) or windows.motion_alone(self._motion)

    @property
    def innovation(self) -> Innovation:
        """Of every window of this incarnation, since this process consumes it."""
        return self._innovation.plus(self.window.innovation)

    # The next window opens.

    def _open(self, sequence: int, first_measurement: int, stamp_ns: int | None) -> None:
        self.sequence = sequence
        self._first_measurement, self._last_measurement = first_measurement, first_measurement - 1
        self._start_ns = stamp_ns
        self._way_m, self._motion, self._solvable = 0.0, Increment.identity(), True
        self.last_keyframe_ns = None
        if stamp_ns is not None:
            self._segmenter.begin(stamp_ns)
        self._gate.begin()
        self._reopen()

    def _reopen(self) -> None:
        """The window at its start; its random numbers too."""
        config = self._config
        self.window = windows.opened(config.front_end, config.sensor)
        self._generator = generator(config.seed, config.id, self._incarnation, self.sequence)
