"""Scans of landmarks, each measurement with its own covariance or the sensor's.

`own` has no rows where no measurement has a covariance, else a row (rr [m²], rb [m·rad], bb [rad²],
form) for each. POLAR: of range and bearing. POINT: of a point in the sensor's frame, to first
order: diag(1, 1/r) S diag(1, 1/r), S along and across the measured bearing. SENSOR: the sensor's
noise, at the predicted range.
"""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Bounds, Sensor
from teamslam.team.estimation.models import NEAREST_M
from teamslam.team.shapes import Bool, Float, UInt32

SENSOR, POLAR, POINT = -1.0, 0.0, 1.0
Own = Float[np.ndarray, "_ _"]


def unclaimed(count: int) -> Own:
    """Make the rows of measurements without covariances."""
    return np.empty((count, 0))


class Scan(NamedTuple):
    """Landmark ids, ranges [m] and bearings [rad] of one message, relative to the sensor."""

    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own

    def only(self, taken: Bool[np.ndarray, " n"]) -> "Scan":
        """Select measurements of the scan."""
        return Scan(self.ids[taken], self.ranges[taken], self.bearings[taken], self.own[taken])


def polar_scan(
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    covariances: Float[np.ndarray, "n 3"] | None = None,
) -> Scan:
    """Make a scan of ranges and bearings, with covariances (rr, rb, bb) if any."""
    if covariances is None:
        return Scan(ids, ranges, bearings, unclaimed(len(ids)))
    form = np.full((len(ids), 1), POLAR)
    return Scan(ids, ranges, bearings, np.hstack((covariances, form)))


def point_scan(
    ids: UInt32[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 3"] | None = None,
) -> Scan:
    """Make a scan of points (x, y) in the sensor's frame, with covariances (xx, xy, yy) if any.

    (r, b) = (‖p‖, atan2(y, x)) and J S Jᵀ with J = ∂(r, b)/∂p.
    """
    x, y = points[:, 0], points[:, 1]
    ranges, bearings = core.hypot(x, y), core.atan2(y, x)
    if covariances is None:
        return Scan(ids, ranges, bearings, unclaimed(len(ids)))
    reach = np.maximum(ranges, NEAREST_M)
    s, c = core.sin_and_cos(bearings)
    xx, xy, yy = covariances.T
    with np.errstate(over="ignore", invalid="ignore"):  # `sensible` refuses what is not finite
        rr = c * c * xx + 2.0 * c * s * xy + s * s * yy
        rb = (c * s * (yy - xx) + (c * c - s * s) * xy) / reach
        bb = (s * s * xx - 2.0 * c * s * xy + c * c * yy) / (reach * reach)
    return Scan(ids, ranges, bearings, np.column_stack((rr, rb, bb, np.full(len(ids), POINT))))


def calibrated(own: Own, sensor: Sensor) -> Own:
    """Apply the sensor's calibration to the covariances."""
    if not own.size or sensor.range_scale == sensor.covariance_factor == 1.0:
        return own
    scale, factor = sensor.range_scale, sensor.covariance_factor
    scaled: Own = own * np.array([factor / core.squared(scale), factor / scale, factor, 1.0])
    return scaled


def together(parts: list[tuple[int, Own]]) -> Own:
    """Join the rows of scans, given by count and rows; SENSOR for those without."""
    if not any(own.size for _, own in parts):
        return unclaimed(sum(count for count, _ in parts))
    sensors = np.array([0.0, 0.0, 0.0, SENSOR])
    return np.concatenate(
        [np.tile(sensors, (count, 1)) if own.shape[1] == 0 else own for count, own in parts]
    )


def sensible(own: Own, ranges: Float[np.ndarray, " n"], bounds: Bounds) -> Bool[np.ndarray, " n"]:
    """Mark measurements whose own standard deviations, if any, are within the bounds."""
    if not own.size:
        return np.ones(len(own), dtype=np.bool_)
    (least_m, most_m), (least_rad, most_rad) = bounds.sigma_m, bounds.sigma_rad
    point = own[:, 3] == POINT
    with np.errstate(over="ignore", invalid="ignore"):
        r, b = np.sqrt(own[:, 0]), np.sqrt(own[:, 2])
        across = np.where(point, b * np.maximum(ranges, NEAREST_M), b)
    low, high = np.where(point, least_m, least_rad), np.where(point, most_m, most_rad)
    within: Bool[np.ndarray, " n"] = (
        (r >= least_m) & (r <= most_m) & (across >= low) & (across <= high)
    )
    return within
