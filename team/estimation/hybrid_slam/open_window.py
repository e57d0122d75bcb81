"""The open window of a robot; a step without a solution does not end the run.

Once the particles of a window have had no solution, none of its measurements are used: its submap
is the motion by odometry alone.
"""

import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from teamslam.team.config import RobotConfig
from teamslam.team.estimation.gaussian import NotACovarianceError
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.keyframes import Keyframe, nearest_landmarks
from teamslam.team.estimation.hybrid_slam.outliers import OutlierGate
from teamslam.team.estimation.hybrid_slam.redrawing import redraw_paths
from teamslam.team.estimation.hybrid_slam.unnamed_detections import (
    AssociatedKeyframes,
    associate_keyframes,
)
from teamslam.team.estimation.hybrid_slam.window import Window
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.mount import of_base
from teamslam.team.estimation.plausibility import submap_beyond
from teamslam.team.estimation.randomness import random_numbers
from teamslam.team.estimation.submap import LocalMap

DEPLETED = 10.0
"""Effective number of particles; where fewer remain after a keyframe, their scatter is no
estimate of the uncertainty. It happens in one of a thousand windows of `thesis`, whose submap is
then far off and overconfident (decision 20)."""
AGAIN = 8
"""The window is computed again with this many times the particles."""


class OpenWindow:
    """The particles since the window's start, and the odometry's motion beside them.

    A window's random numbers are keyed by (seed, robot, incarnation, sequence).
    """

    def __init__(self, config: RobotConfig, incarnation: int, sequence: int) -> None:
        self._config = config
        self._key = incarnation, sequence
        self._gate = OutlierGate(config.sensor)
        self._solvable = True
        self._motions: list[Increment] = []
        self.settled = AssociatedKeyframes(())
        self._begin()

    def _begin(self, times: int = 1) -> None:
        config = self._config
        front = config.front_end
        if times > 1:
            front = msgspec.structs.replace(front, particles=times * front.particles)
        self.particles = windows.open_window(front, config.sensor)
        self._least = math.inf
        self._random = random_numbers(config.seed, config.id, *self._key)
        self.keyframes_ns: list[int] = []

    @property
    def motion(self) -> Increment:
        """The base's motion by odometry, as the sensor's."""
        motion, sensor = Increment.identity(), self._config.sensor
        for each in self._motions:
            step = of_base(each, np.array(sensor.mount)) if sensor.is_mounted else each
            motion = motion.then(step)
        return motion

    @property
    def gated(self) -> int:
        """Number of measurements that others of the window contradicted."""
        return self._gate.gated + self.settled.gated

    def advance(self, keyframe: Keyframe) -> None:
        """Move and weigh the particles with the measurements that agree with others so far.

        Where a keyframe contradicts one that was used before, the window is computed again.
        """
        self._motions.append(keyframe.increment)
        self._try(self._admit, keyframe)

    def confirm(self) -> None:
        """Compute the window again if it has other measurements now that all of it is compared.

        It has where outliers are found or there are detections without identities. Where that
        depletes the particles, the window is computed with more of them (where landmarks have
        identities and errors are white: decision 20).
        """
        self._try(self._settle)

    def move(self, rest: Increment, forward: np.ndarray) -> None:
        """Take the motion after the last keyframe; forward: as of `Keyframe`."""
        if rest.mean.any() or rest.covariance.any():
            self._motions.append(rest)
            self._try(self._go, rest, forward)

    def solve(self, step: Callable[[Window], LocalMap]) -> LocalMap | None:
        """Make the Gaussian of the window by `step`; None where the window has none."""
        if not self._solvable:
            return None
        try:
            return step(self.particles)
        except (NotACovarianceError, np.linalg.LinAlgError):
            return None

    def is_sensible(self, submap: LocalMap | None) -> bool:
        """Whether there is a submap and it lies within the bounds."""
        return submap is not None and submap_beyond(submap, self._config.bounds) is None

    def _admit(self, keyframe: Keyframe) -> None:
        most = self._config.bounds.submap_landmarks
        if self.particles.core.landmarks + len(keyframe.ids) > most:
            keyframe = nearest_landmarks(keyframe, self.particles.landmarks, most)
        if self._gate.add(keyframe):
            self._take(self._gate.last)
        else:
            self._take_all(self._gate.keyframes)

    def _take(self, keyframe: Keyframe) -> None:
        windows.advance(
            self.particles,
            keyframe.increment,
            keyframe.ids,
            keyframe.ranges,
            keyframe.bearings,
            self._random,
            keyframe.forward,
            own=keyframe.own,
        )
        self._least = min(self._least, self.particles.effective)
        self.keyframes_ns.append(keyframe.stamp_ns)
        if keyframe.is_node:
            windows.mark_node(self.particles, keyframe.stamp_ns)

    @np.errstate(all="ignore")
    def _settle(self) -> None:
        has_others = self._gate.confirm()
        keyframes = self._gate.keyframes
        has_unnamed = bool([each for each in keyframes if each.looks])
        if has_unnamed:
            config = self._config
            self.settled = associate_keyframes(
                keyframes,
                config.front_end.association,
                config.sensor,
                config.bounds.submap_landmarks,
            )
            keyframes = self.settled.keyframes
        if has_unnamed or has_others:
            self._take_all(keyframes)
        if has_unnamed:
            redraw_paths(self.particles, keyframes, self._random)
        sensor = self._config.sensor
        white = sensor.range_white == sensor.bearing_white == 1.0
        if self._least < DEPLETED and white and not has_unnamed:
            self._take_all(keyframes, AGAIN)

    def _take_all(self, keyframes: Sequence[Keyframe], times: int = 1) -> None:
        self._begin(times)
        for keyframe in keyframes:
            self._take(keyframe)

    def _go(self, rest: Increment, forward: np.ndarray) -> None:
        windows.move(self.particles, rest, self._random, forward)

    def _try(self, step: Callable[..., None], *arguments: object) -> None:
        """Apply a step to the particles, unless one has failed before."""
        if self._solvable:
            try:
                step(*arguments)
            except (NotACovarianceError, np.linalg.LinAlgError):
                self._solvable = False
