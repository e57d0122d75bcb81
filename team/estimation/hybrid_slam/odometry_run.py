"""Consecutive odometry intervals, composed in one compiled call.

Odometry arrives tens of times between two uses of the resulting motion. Each interval is one row
here; the motions since the last keyframe, since the last pose node and since the first scan of a
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
def gone_on(since: Since, rows: Float[np.ndarray, "n 10"], turns_first: bool) -> Since:
    """All motions after further intervals, in order: equal to `Increment.then` and `compose`.

    rows: `models.course_of` of each interval, then its `odometry.forward_column`, as `rows_of`.
    """
    motion, covariance, shift, node_motion, node_covariance, of_scan = since
    for row in rows:
        if turns_first:
            step, spread = turn_then_drive(row[0], row[1], row[2], row[3], row[4], row[5], row[6])
        else:
            step, spread = arc(row[0], row[1], row[2], row[3], row[4], row[5], row[6])
        node_motion, node_covariance = composed(node_motion, node_covariance, step, spread)
        motion, covariance = composed(motion, covariance, step, spread)
        shift = carried_on(shift, step)
        for i in range(3):
            shift[i] += row[7 + i]
        of_scan = compose(of_scan, step)
    return Since(motion, covariance, shift, node_motion, node_covariance, of_scan)


@compiled
def rows_of(
    model: CourseModel,
    durations_ns: Int64[np.ndarray, " n"],
    forward: Float[np.ndarray, " n"],
    yaw_rates: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 10"]:
    """A row of `gone_on` for each interval."""
    rows = np.zeros((len(forward), 10))
    for k in range(len(forward)):
        duration_s = durations_ns[k] * 1e-9
        course = course_of(model, duration_s, forward[k], yaw_rates[k])
        for i in range(7):
            rows[k, i] = course[i]
        rows[k, 7], rows[k, 8] = scale_column(model, duration_s, forward[k], yaw_rates[k])
    return rows


class OdometryRun:
    """Parts of intervals whose motion follows from their speeds, stored until it is needed."""

    def __init__(self, motion: MotionModel) -> None:
        self._model = model_of(motion)
        self._rows: list[Float[np.ndarray, "n 10"]] = []
        self._parts: list[tuple[int, float, float]] = []

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._rows or self._parts)

    def add(self, over: OdometryInterval, duration_ns: int) -> None:
        """Adds the next part of an interval."""
        self._parts.append((duration_ns, over.forward, over.yaw_rate))

    def add_all(self, intervals: Intervals) -> None:
        """Adds whole intervals."""
        self._note_parts()
        _, durations_ns, forward, yaw_rates = intervals
        self._rows.append(rows_of(self._model, durations_ns, forward, yaw_rates))

    def _note_parts(self) -> None:
        if self._parts:
            durations, forward, yaw_rates = zip(*self._parts, strict=True)
            speeds = np.array([forward, yaw_rates], np.float64)
            of_parts = np.array(durations, np.int64), speeds[0], speeds[1]
            self._rows.append(rows_of(self._model, *of_parts))
            self._parts = []

    def behind(self, motion: Increment) -> Increment:
        """A motion followed by all stored parts, which remain stored."""
        none = np.zeros(3)
        still = none, np.zeros((3, 3))
        since = Since(motion.mean, motion.covariance, none, *still, none)
        after = gone_on(since, self._whole(), self._model.turns_first)
        return Increment(after.motion, after.covariance)

    def driven(
        self,
        increment: Increment,
        since_node: Increment,
        shift: Float[np.ndarray, "3"],
        of_scan: Pose,
    ) -> Since:
        """The motions up to now with all stored parts, which are removed."""
        rows, self._rows = self._whole(), []
        node = since_node.mean, since_node.covariance
        since = Since(increment.mean, increment.covariance, shift, *node, of_scan)
        return gone_on(since, rows, self._model.turns_first)

    def _whole(self) -> Float[np.ndarray, "n 10"]:
        self._note_parts()
        if len(self._rows) > 1:
            self._rows = [np.concatenate(self._rows)]
        return self._rows[0]
