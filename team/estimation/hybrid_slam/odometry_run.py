"""Consecutive odometry intervals, composed in one compiled call.

Odometry arrives tens of times between two uses of the resulting motion. Each interval is kept as it
came; the motions since the last keyframe, since the last pose node and since the first scan of a
keyframe are updated when they are needed.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from team.config import MotionModel
from team.estimation.compiled import compiled
from team.estimation.geometry import Pose, compose
from team.estimation.hybrid_slam.sensitivity_kernel import carried_on
from team.estimation.models import (
    CourseModel,
    Increment,
    arc,
    composed,
    course_of,
    model_of,
    scale_column,
    turn_then_drive,
)
from team.estimation.odometry import Intervals, OdometryInterval

Spread = Float[np.ndarray, "3 3"]
Driven = tuple[Int64[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Durations [ns], forward speeds [m/s] and yaw rates [rad/s] of consecutive intervals."""


class Since(NamedTuple):
    """Motions up to now.

    motion, covariance, shift: since the last keyframe; shift: by an error of the scale of speed.
    node_motion, node_covariance: since the last pose node.
    of_scan: since the first scan of a keyframe of several scans, without noise.
    """

    motion: Pose
    covariance: Spread
    shift: Float[np.ndarray, "3"]
    node_motion: Pose
    node_covariance: Spread
    of_scan: Pose


@compiled
def gone_on(since: Since, model: CourseModel, driven: Driven) -> Since:
    """All motions after further intervals, in order: equal to `Increment.then` and `compose`."""
    motion, covariance, shift, node_motion, node_covariance, of_scan = since
    durations_ns, forward, yaw_rates = driven
    for k in range(len(forward)):
        duration_s = durations_ns[k] * 1e-9
        way, turn, of_way, of_turn, both, final, lateral = course_of(
            model, duration_s, forward[k], yaw_rates[k]
        )
        if model.turns_first:
            step, spread = turn_then_drive(way, turn, of_way, of_turn, both, final, lateral)
        else:
            step, spread = arc(way, turn, of_way, of_turn, both, final, lateral)
        node_motion, node_covariance = composed(node_motion, node_covariance, step, spread)
        motion, covariance = composed(motion, covariance, step, spread)
        shift = carried_on(shift, step)
        ahead, left = scale_column(model, duration_s, forward[k], yaw_rates[k])
        shift[0] += ahead
        shift[1] += left
        of_scan = compose(of_scan, step)
    return Since(motion, covariance, shift, node_motion, node_covariance, of_scan)


class OdometryRun:
    """Parts of intervals whose motion follows from their speeds, stored until it is needed."""

    def __init__(self, motion: MotionModel) -> None:
        self._model = model_of(motion)
        self._stretches: list[Driven] = []
        self._parts: list[tuple[int, float, float]] = []

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._stretches or self._parts)

    def add(self, over: OdometryInterval, duration_ns: int) -> None:
        """Adds the next part of an interval."""
        self._parts.append((duration_ns, over.forward, over.yaw_rate))

    def add_all(self, intervals: Intervals) -> None:
        """Adds whole intervals."""
        self._note_parts()
        self._stretches.append(intervals[1:])

    def _note_parts(self) -> None:
        if self._parts:
            durations, forward, yaw_rates = zip(*self._parts, strict=True)
            speeds = np.array([forward, yaw_rates], np.float64)
            self._stretches.append((np.array(durations, np.int64), speeds[0], speeds[1]))
            self._parts = []

    def behind(self, motion: Increment) -> Increment:
        """A motion followed by all stored parts, which remain stored."""
        none = np.zeros(3)
        still = none, np.zeros((3, 3))
        since = Since(motion.mean, motion.covariance, none, *still, none)
        after = gone_on(since, self._model, self._whole())
        return Increment(after.motion, after.covariance)

    def driven(
        self,
        increment: Increment,
        since_node: Increment,
        shift: Float[np.ndarray, "3"],
        of_scan: Pose,
    ) -> Since:
        """The motions up to now with all stored parts, which are removed."""
        whole, self._stretches = self._whole(), []
        node = since_node.mean, since_node.covariance
        since = Since(increment.mean, increment.covariance, shift, *node, of_scan)
        return gone_on(since, self._model, whole)

    def _whole(self) -> Driven:
        self._note_parts()
        if len(self._stretches) > 1:
            durations, forward, yaw_rates = zip(*self._stretches, strict=True)
            self._stretches = [
                (np.concatenate(durations), np.concatenate(forward), np.concatenate(yaw_rates))
            ]
        return self._stretches[0]
