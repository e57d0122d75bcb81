"""Scans of landmarks, each measurement with its own covariance or the sensor's.

`own` has no rows if no measurement has a covariance, else a row (rr [m²], rb [m·rad], bb [rad²],
form) for each. POLAR: of range and bearing. POINT: of a point in the sensor's frame, to first
order: diag(1, 1/r) S diag(1, 1/r), S along and across the measured bearing. SENSOR: the sensor's
noise, at the predicted range.
"""

import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.core import Scan
from teamslam.team.shapes import Float

__all__ = ["POINT", "POLAR", "SENSOR", "Own", "Scan", "unclaimed", "variances"]

SENSOR, POLAR, POINT = -1.0, 0.0, 1.0
Own = Float[np.ndarray, "_ _"]


def unclaimed(count: int) -> Own:
    """Make the rows of measurements without covariances."""
    return np.empty((count, 0))


def variances(
    ranges: Float[np.ndarray, " n"], own: Own, sensor: Sensor
) -> Float[np.ndarray, "n 3"]:
    """Return (rr, rb, bb) of each measurement: claimed, or the sensor's at its range."""
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
