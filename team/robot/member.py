"""Hybrid-SLAM on one robot's readings: windows of particles, each closed into one submap."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float

from team.config import RobotConfig
from team.estimation import geometry
from team.estimation.gaussian import (
    LandmarkGaussian,
    Matrix,
    NotACovarianceError,
    PoseGaussian,
)
from team.estimation.geometry import tangent
from team.estimation.hybrid_slam import window as windows
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.hybrid_slam.innovation import NOTHING, Innovation
from team.estimation.hybrid_slam.keyframes import Epoch, Segmenter
from team.estimation.hybrid_slam.outliers import Gate
from team.estimation.hybrid_slam.pose_grid import Looks, NodeSighting, PoseGrid
from team.estimation.hybrid_slam.window import Window
from team.estimation.map_joining.conditioning import pose_now
from team.estimation.map_joining.gauss_newton import UNSOLVABLE
from team.estimation.map_joining.whole_map import WholeMap, absorbed, begun, joined
from team.estimation.models import Increment
from team.estimation.plausible import are_landmarks, submap_beyond
from team.estimation.randomness import generator
from team.estimation.submap import LocalMap

CLOUD_PARTICLES = 32
"""Particles in a cloud for viewers."""
NOT_USED = "sightings are not used by this estimator"
"""Why a sighting of a teammate is rejected where there are no pose nodes."""


class Cloud(NamedTuple):
    """A thinned particle cloud in the own map's frame: P poses and their weights, summing to 1."""

    poses: Float[np.ndarray, "P 3"]
    weights: Float[np.ndarray, " P"]


def thinned(particles: Particles, begun_at: Float[np.ndarray, "3"]) -> Cloud:
    """Every so many particles, in their order; begun_at: their frame's pose in the own map's."""
    every = max(1, -(-len(particles.poses) // CLOUD_PARTICLES))
    logs = particles.log_weights[::every]
    weights = np.exp(logs - logs.max())
    poses = [geometry.compose(begun_at, pose) for pose in particles.poses[::every]]
    return Cloud(np.array(poses), weights / weights.sum())


@dataclass(frozen=True)
class ClosedWindow:
    """A submap with the names of its inputs, and the sightings from its pose nodes.

    innovation: of the window's readings that were predicted. gated: readings that no others of the
    window confirmed, and that are not in the submap. late: scans of the interval that are stamped
    behind the window's end; they are rejected. unsolved: scans that led to no Gaussian, of which
    only the odometry's motion is in the submap.
    """

    sequence: int
    first_reading: int
    last_reading: int
    start_ns: int
    end_ns: int
    local: LocalMap
    sightings: tuple[NodeSighting, ...] = ()
    cloud: Cloud | None = None
    innovation: Innovation = NOTHING
    gated: int = 0
    late: int = 0
    unsolved: int = 0


@dataclass(frozen=True)
class Driven:
    """What an odometry interval gave: a submap; the stamps of a new running pose and map.

    cloud: the particles at map_ns of an estimator that keeps them over the whole stream.
    judged: how well such an estimator predicted what it read since it last said so, and when.
    """

    closed: ClosedWindow | None = None
    pose_ns: int | None = None
    map_ns: int | None = None
    cloud: Cloud | None = None
    judged: tuple[Innovation, int] | None = None

    @classmethod
    def with_submap(cls, closed: ClosedWindow) -> Self:
        """The pose and the map are new with a submap."""
        return cls(closed, closed.end_ns, closed.end_ns)


class HybridMember:
    """One epoch of a robot's stream, from its start or from its last submap.

    A window begins at zero where the last one ended, so each depends on its own readings, the
    configuration and (seed, robot, epoch, sequence) alone. Beside the submaps the member keeps its
    own whole map by joining them one by one (Brooks & Bailey's back end): that is what the robot
    knows by itself, and no submap depends on it.
    """

    used = "in a submap"
    joint = True

    def __init__(self, config: RobotConfig, epoch: int) -> None:
        self._config = config
        self._window_ns = round(config.front_end.window_s * 1e9)
        self._standing_ns = round(config.front_end.standing_s * 1e9)
        self._way_m = 0.0
        self._epoch = epoch
        with_nodes = config.front_end.node_s > 0.0 and config.fusion == "join"
        self._grid = PoseGrid(config.sensor, config.front_end) if with_nodes else None
        self._segmenter = Segmenter(
            config.motion, config.sensor, config.front_end.keyframe_s, self._grid
        )
        garbage = config.front_end.garbage
        self._gate = Gate(config.sensor, garbage) if garbage else None
        self.sequence = 0
        self._first_reading = 0
        self._last_reading = -1
        self._start_ns: int | None = None
        self._window: Window = windows.opened(config.front_end, config.sensor)
        self._generator = generator(config.seed, config.id, epoch, 0)
        self._innovation = NOTHING
        self.whole: WholeMap = begun(np.zeros(3), None)
        self.last_epoch_ns: int | None = None
        self._motion = Increment.identity()
        self._solvable = True
        self._scans = 0

    def start(self, pose: Float[np.ndarray, "3"] | None, covariance: Matrix | None) -> None:
        """The start pose, if it is known; without one the own map's frame is the start itself."""
        self.whole = begun(np.zeros(3) if pose is None else pose, covariance)

    def resume(self, closed: ClosedWindow) -> None:
        """Take over a submap of an earlier life: the next window begins where it ended."""
        self.whole = self._joined(closed.local)
        self.sequence = closed.sequence
        self._begin_window(closed.sequence + 1, closed.last_reading + 1, closed.end_ns)

    def consumed(self, reading: int) -> None:
        """The reading belongs to the open window (or was rejected while it was open)."""
        self._last_reading = reading

    def observe(self, stamp_ns: int, scan: tuple[np.ndarray, np.ndarray, np.ndarray]) -> str | None:
        """Take a scan (ids, ranges, bearings); the reason if it is rejected."""
        reason = self._segmenter.observe(stamp_ns, *scan)
        self._scans += reason is None
        return reason

    def sight(self, stamp_ns: int, reading: int, looks: Looks) -> str | None:
        """Take sightings of teammates; the reason if they are rejected."""
        if self._grid is None:
            return NOT_USED
        if self._start_ns is None:
            return "older than the odometry"
        return self._grid.observe(stamp_ns, reading, looks)

    def drive(
        self,
        stamp_ns: int,
        duration_ns: int,
        forward: float,
        yaw_rate: float,
        *,
        measured: bool = True,
    ) -> Driven:
        """Take one odometry interval; the submap that it closes, if it does."""
        if self._start_ns is None:
            self._start_ns = stamp_ns - duration_ns
            self._segmenter.begin(self._start_ns)
        before_ns = self.last_epoch_ns
        self._way_m += abs(forward) * duration_ns * 1e-9
        motion = stamp_ns, duration_ns, forward, yaw_rate
        for epoch in self._segmenter.drive(*motion, measured=measured):
            self._advance(epoch)
        if self._is_full(stamp_ns - self._start_ns):
            return Driven.with_submap(self._close(stamp_ns, self._segmenter.leave()))
        if self._grid is not None:
            self._grid.go_on(stamp_ns)
        moved = self.last_epoch_ns != before_ns
        return Driven(None, self.last_epoch_ns if moved else None)

    def _is_full(self, lasting_ns: int) -> bool:
        """Whether the window is long enough to close; one of a standing robot goes on.

        One that has seen half as many landmarks as a submap may hold closes at once.
        """
        if 2 * len(self._window.particles.ids) >= self._config.bounds.submap_landmarks:
            return True
        standing = self._way_m < self._config.front_end.window_m
        return lasting_ns >= self._window_ns and not (standing and lasting_ns < self._standing_ns)

    def finish(self) -> tuple[Driven, int]:
        """The stream has ended: the last submap, and how many scans no odometry covered."""
        uncovered = self._segmenter.uncovered
        end_ns = self._segmenter.now_ns
        if self._start_ns is None or end_ns is None or end_ns <= self._start_ns:
            return Driven(), uncovered
        return Driven.with_submap(self._close(end_ns)), uncovered

    def open_window(self) -> LocalMap | None:
        """The open window's Gaussian at its last epoch, if it has one."""
        if self.last_epoch_ns is None:
            return None
        return self._solved(running=True) or self._moved_only()

    def own_pose(self, window: LocalMap | None) -> PoseGaussian:
        """The pose of the own whole map, times the open window; its motion if they contradict."""
        try:
            with np.errstate(all="ignore"):
                return pose_now(self.whole, window).pose
        except UNSOLVABLE:
            return pose_now(self.whole, None if window is None else window.motion).pose

    def own_map(self) -> LandmarkGaussian:
        """The landmarks of the own whole map."""
        whole = self.whole
        return LandmarkGaussian(whole.ids, whole.mean[3:].reshape(-1, 2), whole.covariance[3:, 3:])

    def absorb(self, ids: np.ndarray, means: Float[np.ndarray, "L 2"], covariance: Matrix) -> None:
        """The fused landmarks replace those of the own whole map; submaps never see it."""
        self.whole = absorbed(self.whole, ids, means, covariance)

    @property
    def window(self) -> Window:
        """The open window."""
        return self._window

    @property
    def innovation(self) -> Innovation:
        """Of every window of this epoch, since this process consumes it."""
        return self._innovation.plus(self._window.innovation)

    def _advance(self, epoch: Epoch) -> None:
        self._motion = self._motion.then(epoch.increment)
        self.last_epoch_ns = epoch.stamp_ns
        self._try(lambda: self._admit(epoch))

    def _try(self, step: Callable[[], None]) -> None:
        """Take a step of the window's particles, unless one has failed: no readings then count."""
        if self._solvable:
            try:
                with np.errstate(all="ignore"):
                    step()
            except (NotACovarianceError, np.linalg.LinAlgError):
                self._solvable = False

    def _admit(self, epoch: Epoch) -> None:
        bounded = self._bounded(epoch)
        self._take(bounded if self._gate is None else self._gate.admitted(bounded))

    def _bounded(self, epoch: Epoch) -> Epoch:
        """The epoch without the new landmarks that are too many for a submap; the nearest stay."""
        known, most = self._window.particles.ids, self._config.bounds.submap_landmarks
        if len(known) + len(epoch.ids) <= most:
            return epoch
        new, first = np.unique(epoch.ids[~np.isin(epoch.ids, known)], return_index=True)
        ranges = epoch.ranges[~np.isin(epoch.ids, known)][first]
        nearest = new[np.argsort(ranges, kind="stable")[: max(most - len(known), 0)]]
        taken = np.isin(epoch.ids, known) | np.isin(epoch.ids, nearest)
        return replace(
            epoch, ids=epoch.ids[taken], ranges=epoch.ranges[taken], bearings=epoch.bearings[taken]
        )

    def _take(self, epoch: Epoch) -> None:
        self._window = windows.advanced(
            self._window,
            epoch.increment,
            epoch.ids,
            epoch.ranges,
            epoch.bearings,
            self._generator,
            epoch.forward,
        )
        if epoch.is_node:
            self._window = windows.marked(self._window, epoch.stamp_ns)

    def _solved(self, *, running: bool = False) -> LocalMap | None:
        """The window as a Gaussian; None where there is none, or none that is sensible."""
        if not self._solvable:
            return None
        try:
            with np.errstate(all="ignore"):
                local = windows.gaussian(self._window, running=running)
        except (NotACovarianceError, np.linalg.LinAlgError):
            return None
        if running or submap_beyond(local, self._config.bounds) is None:
            return local
        return None

    def _moved_only(self) -> LocalMap:
        """The window's motion by the odometry alone, as a Gaussian in the window's frame."""
        G = tangent(self._motion.mean[2])
        covariance = G @ self._motion.covariance @ G.T + np.diag(windows.POSE_JITTER)
        symmetric = 0.5 * (covariance + covariance.T)
        return LocalMap(np.empty(0, np.uint32), self._motion.mean, symmetric)

    def _joined(self, local: LocalMap) -> WholeMap:
        """The own map with a submap; of one that contradicts it beyond all numbers, its motion."""
        try:
            with np.errstate(all="ignore"):
                after = joined(self.whole, local)
        except (NotACovarianceError, np.linalg.LinAlgError):
            after = None
        if after is not None and are_landmarks(after.covariance[3:, 3:]):
            return after
        return joined(self.whole, local.motion)

    def _close(self, stamp_ns: int, late: int = 0) -> ClosedWindow:
        epochs, rest = self._segmenter.cut(stamp_ns)
        for epoch in epochs:
            self._advance(epoch)
        if self._gate is not None:
            self._try(self._settle)
        gated = 0 if self._gate is None else self._gate.gated
        if rest.mean.any() or rest.covariance.any():
            self._motion = self._motion.then(rest)
            self._try(lambda: self._go(rest))
        solved = self._solved()
        scans, self._scans = self._scans - self._segmenter.uncovered, self._segmenter.uncovered
        assert self._start_ns is not None
        closed = ClosedWindow(
            self.sequence,
            self._first_reading,
            self._last_reading,
            self._start_ns,
            stamp_ns,
            self._moved_only() if solved is None else solved,
            () if self._grid is None or solved is None else self._grid.sightings(),
            None if solved is None else thinned(self._window.particles, self.whole.mean[:3]),
            NOTHING if solved is None else self._window.innovation,
            gated,
            late,
            scans - late if solved is None else 0,
        )
        self._innovation = self._innovation.plus(closed.innovation)
        self.whole = self._joined(closed.local)
        self._begin_window(self.sequence + 1, self._last_reading + 1, stamp_ns)
        return closed

    def _go(self, rest: Increment) -> None:
        """The motion after the last epoch."""
        forward = self._segmenter.rest_forward
        self._window = windows.moved(self._window, rest, self._generator, forward)

    def _settle(self) -> None:
        """The window once more with the readings that all of it confirms."""
        assert self._gate is not None
        self._reopen()
        for epoch in self._gate.settled():
            self._take(epoch)

    def _reopen(self) -> None:
        """The window at its start; its random numbers too."""
        config = self._config
        self._window = windows.opened(config.front_end, config.sensor)
        self._generator = generator(config.seed, config.id, self._epoch, self.sequence)

    def _begin_window(self, sequence: int, first_reading: int, stamp_ns: int) -> None:
        self.sequence = sequence
        self._first_reading = first_reading
        self._last_reading = first_reading - 1
        self._start_ns = stamp_ns
        self._way_m = 0.0
        self._motion, self._solvable = Increment.identity(), True
        self._segmenter.begin(stamp_ns)
        if self._gate is not None:
            self._gate.begin()
        self._reopen()
        self.last_epoch_ns = None
