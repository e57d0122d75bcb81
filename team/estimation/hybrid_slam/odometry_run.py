"""Consecutive odometry intervals, composed in one compiled call.

Odometry arrives tens of times between two uses of the resulting motion. Each interval is kept as it
came; the motions since the last keyframe, since the last pose node and since the first scan of a
keyframe are updated when they are needed. The place of a scan is marked: the same call returns the
pose at each mark.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from team.config import MotionModel
from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import Pose, wrapped
from team.estimation.models import (
    CourseModel,
    Increment,
    carry,
    course_of,
    drive_arc,
    go,
    model_of,
    scale_column,
    turn_and_drive,
)
from team.estimation.odometry import OdometryInterval
from team.estimation.placing import put

Spread = Float[np.ndarray, "3 3"]
Driven = tuple[Int64[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Durations [ns], forward speeds [m/s] and yaw rates [rad/s] of consecutive intervals."""
Marks = Int64[np.ndarray, " m"]
"""Numbers of intervals before each of some places, ascending."""
NO_MARKS = np.empty(0, np.int64)


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
def gone_on(
    since: Since,
    model: CourseModel,
    durations_ns: Int64[np.ndarray, " n"],
    forward: Float[np.ndarray, " n"],
    yaw_rates: Float[np.ndarray, " n"],
    marks: Marks,
) -> tuple[Since, Float[np.ndarray, "m 3"]]:
    """All motions after further intervals, in order: equal to `Increment.then` and `compose`; and
    `of_scan` at each of the marks.
    """
    motion, covariance, shift = since.motion.copy(), since.covariance.copy(), since.shift.copy()
    node_motion, node_covariance = since.node_motion.copy(), since.node_covariance.copy()
    of_scan = since.of_scan.copy()
    step, spread, half, Ad = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    at_marks, marked = np.empty((len(marks), 3)), 0
    for k in range(len(forward)):
        while marked < len(marks) and marks[marked] == k:
            put(at_marks[marked], 0, of_scan)
            marked += 1
        duration_s = durations_ns[k] * 1e-9
        course = course_of(model, duration_s, forward[k], yaw_rates[k])
        if model.turns_first:
            turn_and_drive(course, step, spread)
        else:
            drive_arc(course, step, spread)
        _adjoint_of_inverse(step, Ad)
        carry(node_motion, node_covariance, step, spread, Ad, half)
        carry(motion, covariance, step, spread, Ad, half)
        s, c = elementary.sin_and_cos(step[2])  # `carried_on`
        x, y = shift[0] - step[1] * shift[2], shift[1] + step[0] * shift[2]
        ahead, left = scale_column(model, duration_s, forward[k], yaw_rates[k])
        shift[0], shift[1] = c * x + s * y + ahead, -s * x + c * y + left
        go(of_scan, step)
    for k in range(marked, len(marks)):
        put(at_marks[k], 0, of_scan)
    return Since(motion, covariance, shift, node_motion, node_covariance, of_scan), at_marks


@compiled
def _adjoint_of_inverse(step: Pose, Ad: Spread) -> None:
    """`geometry.adjoint` of `geometry.inverse`, in place."""
    s, c = elementary.sin_and_cos(step[2])
    x, y = -c * step[0] - s * step[1], s * step[0] - c * step[1]
    s, c = elementary.sin_and_cos(wrapped(-step[2]))
    Ad[0, 0], Ad[0, 1], Ad[0, 2] = c, -s, y
    Ad[1, 0], Ad[1, 1], Ad[1, 2] = s, c, -x
    Ad[2, 2] = 1.0


class OdometryRun:
    """Parts of intervals whose motion follows from their speeds, stored until it is needed.

    is_pending: whether there are any.
    """

    def __init__(self, motion: MotionModel) -> None:
        self._model = model_of(motion)
        self._clear()

    def _clear(self) -> None:
        self._durations: list[int] = []
        self._forward: list[float] = []
        self._yaw_rates: list[float] = []
        self._marks: list[int] = []
        self.is_pending = False

    def add(self, over: OdometryInterval, duration_ns: int) -> None:
        """Add the next part of an interval."""
        self._durations.append(duration_ns)
        self._forward.append(over.forward)
        self._yaw_rates.append(over.yaw_rate)
        self.is_pending = True

    def mark(self) -> None:
        """Mark this place: `compose` returns the pose here."""
        self._marks.append(len(self._durations))

    def append_to(self, motion: Increment) -> Increment:
        """Append all stored parts to a motion; they remain stored."""
        none = np.zeros(3)
        still = none, np.zeros((3, 3))
        since = Since(motion.mean, motion.covariance, none, *still, none)
        after, _ = gone_on(since, self._model, *self._whole(), NO_MARKS)
        return Increment(after.motion, after.covariance)

    def compose(
        self,
        increment: Increment,
        since_node: Increment,
        shift: Float[np.ndarray, "3"],
        of_scan: Pose,
    ) -> tuple[Since, Float[np.ndarray, "m 3"]]:
        """Append all stored parts to the motions up to now and remove them; returns the motions and
        the poses since the first scan at the marks.
        """
        whole = self._whole()
        marks = np.array(self._marks, np.int64) if self._marks else NO_MARKS
        self._clear()
        node = since_node.mean, since_node.covariance
        since = Since(increment.mean, increment.covariance, shift, *node, of_scan)
        return gone_on(since, self._model, *whole, marks)

    def _whole(self) -> Driven:
        return (
            np.array(self._durations, np.int64),
            np.array(self._forward, np.float64),
            np.array(self._yaw_rates, np.float64),
        )
