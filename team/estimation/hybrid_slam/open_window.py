"""The open window of a robot; a step without a solution does not end the run.

While the window is open a measurement is accepted if it agrees with the earlier ones of its
landmark under the odometry. At its end a smoother over the window compares all with all. Without a
solution the submap is the odometry's motion alone.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from teamslam.team import core
from teamslam.team.config import RobotConfig
from teamslam.team.estimation.gaussian import NotACovarianceError
from teamslam.team.estimation.hybrid_slam.redrawing import redraw_paths
from teamslam.team.estimation.hybrid_slam.unnamed_detections import (
    AssociatedKeyframes,
    associate_keyframes,
)
from teamslam.team.estimation.hybrid_slam.window import Window
from teamslam.team.estimation.models import noise_of
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

    core: takes keyframes and motions. Random numbers are keyed by (seed, robot, incarnation,
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
        """Compute the window again if comparing all of it changes its measurements: by outliers, or
        detections without identities.

        Depleted particles are computed with more of them (with identities and white errors:
        decision 20).
        """
        if self.core.is_solvable:
            try:
                self._settle()
            except UNSOLVED:
                self.core.give_up()

    def solve(self, step: Callable[[Window], Solved]) -> Solved | None:
        """Make the Gaussian of the window by `step`."""
        if not self.core.is_solvable:
            return None
        try:
            return step(self.particles)
        except UNSOLVED:
            return None

    def is_sensible(self, submap: LocalMap | None) -> bool:
        """Whether there is a submap and it lies within the bounds."""
        return submap is not None and submap_beyond(submap, self._config.bounds) is None

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
        """Give the window's detections identities, and compute it again with them."""
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
