"""The open window of a robot, total: a step that has no solution ends no run.

Where the particles of a window have once had no solution, none of its measurements count: what is
left of it is the motion that the odometry says.
"""

import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from team.config import RobotConfig
from team.estimation.gaussian import NotACovarianceError
from team.estimation.hybrid_slam import window as windows
from team.estimation.hybrid_slam.fastslam import effective_sample_size
from team.estimation.hybrid_slam.keyframes import Keyframe, nearest_landmarks
from team.estimation.hybrid_slam.outliers import OutlierGate
from team.estimation.hybrid_slam.unnamed import Settled, settled
from team.estimation.hybrid_slam.window import Window
from team.estimation.models import Increment
from team.estimation.mount import of_base
from team.estimation.plausible import submap_beyond
from team.estimation.randomness import generator
from team.estimation.submap import LocalMap

DEPLETED = 10.0
"""Effective particles: where fewer were left after a keyframe, their scatter says nothing. One of a
thousand windows of `thesis`, whose submap is then far off and sure of itself (decision 0081)."""
AGAIN = 8
"""So many times the particles take such a window again."""


class OpenWindow:
    """The particles since the window's start, and the odometry's motion beside them.

    A window's random numbers are keyed by (seed, robot, incarnation, sequence).
    """

    def __init__(self, config: RobotConfig, incarnation: int, sequence: int) -> None:
        self._config = config
        self._key = incarnation, sequence
        self._gate = OutlierGate(config.sensor, config.front_end.outlier_share)
        self._solvable = True
        self.motion = Increment.identity()
        self.last_keyframe_ns: int | None = None
        self._keyframes: list[Keyframe] = []
        self.settled = Settled(())
        self._begin()

    def _begin(self, times: int = 1) -> None:
        config = self._config
        front = config.front_end
        if times > 1:
            front = msgspec.structs.replace(front, particles=times * front.particles)
        self.particles = windows.opened(front, config.sensor)
        self._least = math.inf
        self._generator = generator(config.seed, config.id, *self._key)
        self.keyframes_ns: tuple[int, ...] = ()

    @property
    def gated(self) -> int:
        """Measurements that no others of the window confirmed."""
        return self._gate.gated + self.settled.gated

    def advance(self, keyframe: Keyframe) -> None:
        """Particles move and weigh, once more: those measurements count that others agree with."""
        self._follow(keyframe.increment)
        self.last_keyframe_ns = keyframe.stamp_ns
        self._try(lambda: self._admit(keyframe))

    def confirm(self) -> None:
        """Where there may be outliers, or there are detections without identities, the window once
        more with what all of it confirms; where that depleted the particles, again with more
        (where landmarks have names and errors are white: decision 0081).
        """
        self._try(self._settle)

    def move(self, rest: Increment, forward: np.ndarray) -> None:
        """The motion after the last keyframe; forward: its shift by an error of the speed."""
        if rest.mean.any() or rest.covariance.any():
            self._follow(rest)
            self._try(lambda: self._go(rest, forward))

    def solved(self, step: Callable[[Window], LocalMap]) -> LocalMap | None:
        """The Gaussian that a step makes of the window; None where there is none."""
        if not self._solvable:
            return None
        try:
            with np.errstate(all="ignore"):
                return step(self.particles)
        except (NotACovarianceError, np.linalg.LinAlgError):
            return None

    def is_sensible(self, submap: LocalMap | None) -> bool:
        """Whether a submap is there and within the bounds."""
        return submap is not None and submap_beyond(submap, self._config.bounds) is None

    def _follow(self, motion: Increment) -> None:
        """The base moves as its sensor does."""
        sensor = self._config.sensor
        if sensor.is_mounted:
            motion = of_base(motion, np.array(sensor.mount))
        self.motion = self.motion.then(motion)

    def _admit(self, keyframe: Keyframe) -> None:
        most = self._config.bounds.submap_landmarks
        bounded = nearest_landmarks(keyframe, self.particles.particles.ids, most)
        self._keyframes.append(bounded)
        self._take(self._gate.admitted(bounded))

    def _take(self, keyframe: Keyframe) -> None:
        self.particles = windows.advanced(
            self.particles,
            keyframe.increment,
            keyframe.ids,
            keyframe.ranges,
            keyframe.bearings,
            self._generator,
            keyframe.forward,
            own=keyframe.own,
        )
        self._least = min(self._least, effective_sample_size(self.particles.particles.log_weights))
        self.keyframes_ns = (*self.keyframes_ns, keyframe.stamp_ns)
        if keyframe.is_node:
            self.particles = windows.marked(self.particles, keyframe.stamp_ns)

    def _settle(self) -> None:
        keyframes = self._gate.settled() if self._gate.judges else tuple(self._keyframes)
        has_unnamed = any(each.looks for each in self._keyframes)
        if has_unnamed:
            config = self._config
            self.settled = settled(
                keyframes,
                config.front_end.association,
                config.sensor,
                config.bounds.submap_landmarks,
            )
            keyframes = self.settled.keyframes
        if has_unnamed or self._gate.judges:
            self._take_all(keyframes)
        sensor = self._config.sensor
        white = sensor.range_white == sensor.bearing_white == 1.0
        if self._least < DEPLETED and white and not has_unnamed:
            self._take_all(keyframes, AGAIN)

    def _take_all(self, keyframes: Sequence[Keyframe], times: int = 1) -> None:
        self._begin(times)
        for keyframe in keyframes:
            self._take(keyframe)

    def _go(self, rest: Increment, forward: np.ndarray) -> None:
        self.particles = windows.moved(self.particles, rest, self._generator, forward)

    def _try(self, step: Callable[[], None]) -> None:
        """Take a step of the particles, unless one has failed."""
        if self._solvable:
            try:
                with np.errstate(all="ignore"):
                    step()
            except (NotACovarianceError, np.linalg.LinAlgError):
                self._solvable = False
