"""The open window of a robot; a step without a solution does not end the run.

While the window is open a measurement is accepted if it agrees with the earlier ones of its
landmark under the odometry. At its end a smoother over the window compares all with all. Without a
solution the submap is the odometry's motion alone.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from teamslam.team import core
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.gaussian import NotACovarianceError
from teamslam.team.estimation.hybrid_slam.keyframes import Keyframe, nearest_landmarks
from teamslam.team.estimation.hybrid_slam.redrawing import redraw_paths
from teamslam.team.estimation.hybrid_slam.unnamed_detections import (
    AssociatedKeyframes,
    associate_keyframes,
)
from teamslam.team.estimation.hybrid_slam.window import Window
from teamslam.team.estimation.models import Increment, noise_of
from teamslam.team.estimation.mount import of_base
from teamslam.team.estimation.plausibility import submap_beyond
from teamslam.team.estimation.randomness import random_numbers
from teamslam.team.estimation.submap import LocalMap

OUTLIER_SHARE = 0.01
"""Probability of an outlier before the window's measurements are compared. A landmark measurement
is rejected where it is this much less likely given the others than anywhere in view; with ten times
the share a tenth of the same likelihood is needed, so the value hardly matters."""
DEPLETED = 10.0
"""Effective number of particles; where fewer remain after a keyframe, their scatter is no
estimate of the uncertainty. It happens in one of a thousand windows of `thesis`, whose submap is
then far off and overconfident (decision 20)."""
AGAIN = 8
"""The window is computed again with this many times the particles."""


UNSOLVED = (core.MotionError, core.NotFiniteError, NotACovarianceError, np.linalg.LinAlgError)
"""Errors of a window that has no solution."""
Solved = TypeVar("Solved")


class OpenWindow:
    """The particles since the window's start, and the keyframes.

    Random numbers are keyed by (seed, robot, incarnation, sequence).
    """

    def __init__(self, config: RobotConfig, incarnation: int, sequence: int) -> None:
        self._config = config
        self._most = config.bounds.submap_landmarks
        self._solvable = True
        self._keyframes: list[Keyframe] = []
        self._rest: Increment | None = None
        self.settled = AssociatedKeyframes(())
        front, sensor = config.front_end, config.sensor
        self._core = core.OpenWindow(
            front.particles,
            noise_of(sensor),
            front.proposal == "fastslam2",
            sensor.mount,
            front.resample_below,
            sensor.max_range,
            sensor.field_of_view,
            OUTLIER_SHARE,
            random_numbers(config.seed, config.id, incarnation, sequence),
        )
        self.particles = Window(front, sensor, self._core.window)

    @property
    def keyframes_ns(self) -> tuple[int, ...]:
        """Team times of the keyframes."""
        return tuple(each.stamp_ns for each in self._keyframes)

    @property
    def motion(self) -> Increment:
        """The base's motion by odometry, as the sensor's."""
        motion, sensor = Increment.identity(), self._config.sensor
        steps = [each.increment for each in self._keyframes]
        for each in steps if self._rest is None else [*steps, self._rest]:
            step = of_base(each, np.array(sensor.mount)) if sensor.is_mounted else each
            motion = motion.then(step)
        return motion

    @property
    def gated(self) -> int:
        """Number of measurements that others of the window contradicted."""
        return self._core.rejected + self.settled.gated

    def advance(self, keyframe: Keyframe) -> None:
        """Move and weigh the particles with the measurements accepted so far.

        A keyframe that contradicts an earlier one computes the window again.
        """
        if self._solvable and self._core.window.landmarks + len(keyframe.ids) > self._most:
            keyframe = nearest_landmarks(keyframe, self.particles.landmarks, self._most)
        self._keyframes.append(keyframe)
        self._try(self._admit, keyframe)

    def confirm(self) -> None:
        """Compute the window again if comparing all of it changes its measurements: by outliers, or
        detections without identities.

        Depleted particles are computed with more of them (with identities and white errors:
        decision 20).
        """
        self._try(self._settle)

    def move(self, rest: Increment, forward: np.ndarray) -> None:
        """Take the motion after the last keyframe; forward: as of `Keyframe`."""
        if rest.mean.any() or rest.covariance.any():
            self._rest = rest
            self._try(self._core.move, rest.mean, rest.covariance, forward)

    def solve(self, step: Callable[[Window], Solved]) -> Solved | None:
        """Make the Gaussian of the window by `step`."""
        if not self._solvable:
            return None
        try:
            return step(self.particles)
        except UNSOLVED:
            return None

    def is_sensible(self, submap: LocalMap | None) -> bool:
        """Whether there is a submap and it lies within the bounds."""
        return submap is not None and submap_beyond(submap, self._config.bounds) is None

    def _admit(self, keyframe: Keyframe) -> None:
        if not self._core.admit(*keyframe.arguments):
            self._take_all(self._accepted())

    def _accepted(self) -> list[Keyframe]:
        accepted = [self._core.accepted(k) for k in range(len(self._keyframes))]
        pairs = zip(self._keyframes, accepted, strict=True)
        return [each if taken is None else each.only(taken) for each, taken in pairs]

    def _settle(self) -> None:
        has_others = self._core.confirm()
        has_unnamed = any(each.looks for each in self._keyframes)
        if not (has_others or has_unnamed or self._is_depleted):
            return
        keyframes = self._accepted()
        if has_unnamed:
            with np.errstate(all="ignore"):
                self._associate(keyframes)
            return
        if has_others:
            self._take_all(keyframes)
        if self._is_depleted:
            self._take_all(keyframes, AGAIN)

    def _associate(self, keyframes: Sequence[Keyframe]) -> None:
        """Give the window's detections identities, and compute it again with them."""
        config = self._config
        self.settled = associate_keyframes(
            keyframes, config.front_end.association, config.sensor, self._most
        )
        self._take_all(self.settled.keyframes)
        redraw_paths(self.particles, self.settled.keyframes, self._core.random)

    @property
    def _is_depleted(self) -> bool:
        sensor = self._config.sensor
        white = sensor.range_white == sensor.bearing_white == 1.0
        return white and self._core.least_effective < DEPLETED

    def _take_all(self, keyframes: Sequence[Keyframe], times: int = 1) -> None:
        self._core.begin(times * self._config.front_end.particles)
        for keyframe in keyframes:
            self._core.take(*keyframe.arguments)

    def _try(self, step: Callable[..., None], *arguments: object) -> None:
        if self._solvable:
            try:
                step(*arguments)
            except UNSOLVED:
                self._solvable = False
