"""Hybrid-SLAM on one robot's readings: windows of particles, each closed into one submap."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float

from team.config import RobotConfig
from team.estimation import geometry
from team.estimation import window as windows
from team.estimation.conditioning import pose_now
from team.estimation.fastslam import Particles
from team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.innovation import NOTHING, Innovation
from team.estimation.randomness import generator
from team.estimation.submap import LocalMap
from team.estimation.whole_map import WholeMap, absorbed, begun, joined
from team.estimation.window import Window
from team.robot.gate import Gate
from team.stream.pose_grid import Looks, NodeSighting, PoseGrid
from team.stream.segmenter import Epoch, Segmenter

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
    behind the window's end; they are rejected.
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

    def start(self, pose: Float[np.ndarray, "3"] | None, covariance: Matrix | None) -> None:
        """The start pose, if it is known; without one the own map's frame is the start itself."""
        self.whole = begun(np.zeros(3) if pose is None else pose, covariance)

    def resume(self, closed: ClosedWindow) -> None:
        """Take over a submap of an earlier life: the next window begins where it ended."""
        self.whole = joined(self.whole, closed.local)
        self.sequence = closed.sequence
        self._begin_window(closed.sequence + 1, closed.last_reading + 1, closed.end_ns)

    def consumed(self, reading: int) -> None:
        """The reading belongs to the open window (or was rejected while it was open)."""
        self._last_reading = reading

    def observe(self, stamp_ns: int, scan: tuple[np.ndarray, np.ndarray, np.ndarray]) -> str | None:
        """Take a scan (ids, ranges, bearings); the reason if it is rejected."""
        return self._segmenter.observe(stamp_ns, *scan)

    def sight(self, stamp_ns: int, reading: int, looks: Looks) -> str | None:
        """Take sightings of teammates; the reason if they are rejected."""
        if self._grid is None:
            return NOT_USED
        if self._start_ns is None:
            return "older than the odometry"
        return self._grid.observe(stamp_ns, reading, looks)

    def drive(self, stamp_ns: int, duration_ns: int, forward: float, yaw_rate: float) -> Driven:
        """Take one odometry interval; the submap that it closes, if it does."""
        if self._start_ns is None:
            self._start_ns = stamp_ns - duration_ns
            self._segmenter.begin(self._start_ns)
        before_ns = self.last_epoch_ns
        self._way_m += abs(forward) * duration_ns * 1e-9
        for epoch in self._segmenter.drive(stamp_ns, duration_ns, forward, yaw_rate):
            self._advance(epoch)
        if self._is_full(stamp_ns - self._start_ns):
            return Driven.with_submap(self._close(stamp_ns, self._segmenter.leave()))
        if self._grid is not None:
            self._grid.go_on(stamp_ns)
        moved = self.last_epoch_ns != before_ns
        return Driven(None, self.last_epoch_ns if moved else None)

    def _is_full(self, lasting_ns: int) -> bool:
        """Whether the window is long enough to close; one of a standing robot goes on."""
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
        return None if self.last_epoch_ns is None else windows.gaussian(self._window, running=True)

    def own_pose(self, window: LocalMap | None) -> PoseGaussian:
        """The pose of the own whole map, times the open window."""
        return pose_now(self.whole, window).pose

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
        self._take(epoch if self._gate is None else self._gate.admitted(epoch))

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
        self.last_epoch_ns = epoch.stamp_ns

    def _close(self, stamp_ns: int, late: int = 0) -> ClosedWindow:
        epochs, rest = self._segmenter.cut(stamp_ns)
        for epoch in epochs:
            self._advance(epoch)
        gated = 0 if self._gate is None else self._settle(self._gate)
        if rest.mean.any() or rest.covariance.any():
            forward = self._segmenter.rest_forward
            self._window = windows.moved(self._window, rest, self._generator, forward)
        local = windows.gaussian(self._window)
        assert self._start_ns is not None
        closed = ClosedWindow(
            self.sequence,
            self._first_reading,
            self._last_reading,
            self._start_ns,
            stamp_ns,
            local,
            () if self._grid is None else self._grid.sightings(),
            thinned(self._window.particles, self.whole.mean[:3]),
            self._window.innovation,
            gated,
            late,
        )
        self._innovation = self._innovation.plus(closed.innovation)
        self.whole = joined(self.whole, local)
        self._begin_window(self.sequence + 1, self._last_reading + 1, stamp_ns)
        return closed

    def _settle(self, gate: Gate) -> int:
        """The window once more with the readings that all of it confirms; how many it does not."""
        self._reopen()
        for epoch in gate.settled():
            self._take(epoch)
        return gate.gated

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
        self._segmenter.begin(stamp_ns)
        if self._gate is not None:
            self._gate.begin()
        self._reopen()
        self.last_epoch_ns = None
