"""Reduce several scans to one range and bearing per landmark."""

from collections.abc import Sequence

import msgspec
import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED, Sensor
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.scans import SENSOR, Own
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float, UInt32


class KeyframeScan(msgspec.Struct, frozen=True, gc=False):
    """One scan at at_ns (its stamp, or the start of the odometry that covers it).

    back: the robot's pose relative to the keyframe's end, if that is known and another. motion:
    since the scan or keyframe before.
    """

    stamp_ns: int
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own
    at_ns: int = 0
    motion: Increment | None = None
    back: Pose | None = None

    @property
    def is_unnamed(self) -> bool:
        """Whether it has detections without identities; it has no others then."""
        return max(self.ids.tolist(), default=0) >= UNNAMED


Measured = tuple[UInt32[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"], Own]
"""Ids, ranges [m], bearings [rad] and the noises that they claim."""


def reduced(placed: Sequence[tuple[KeyframeScan, Pose]]) -> Measured:
    """Reduce scans, each with its pose relative to the keyframe's end, to one measurement per
    landmark, by ascending id: the median range and bearing at that end, and the mean claimed noise.
    """
    scans = [(look.ids, look.ranges, look.bearings, look.own) for look, _ in placed]
    return core.reduce_scans(scans, np.array([back for _, back in placed]).reshape(-1, 3))


def variances(
    ranges: Float[np.ndarray, " n"], own: Own, sensor: Sensor
) -> Float[np.ndarray, "n 3"]:
    """(rr, rb, bb) of each measurement: claimed, or the sensor's at its range."""
    of_sensor = np.column_stack(
        (
            core.squared(sensor.range_sigma) + core.squared(sensor.range_sigma_per_m * ranges),
            np.zeros(len(ranges)),
            np.full(len(ranges), core.squared(sensor.bearing_sigma)),
        )
    )
    if not own.size:
        return of_sensor
    claims = own[:, 3] != SENSOR
    return np.where(claims[:, None], own[:, :3], of_sensor)
