"""Compare measurement covariances and the sensor mount with the truth.

A factor is the median squared Mahalanobis error over the median of chi-square, for odometry over
spans, since the reference's own error dominates intervals. Mount heading and `bearing_offset` are
observable as a sum only.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.sim.calibration.data import Reference, poses_at, seen_landmarks
from teamslam.sim.calibration.figures import huber
from teamslam.team.config import Sensor
from teamslam.team.estimation.consistency import chi2_quantile
from teamslam.team.estimation.models import Increment, corrected
from teamslam.team.estimation.se2 import between, logarithm
from teamslam.team.shapes import Bool, Float

SPAN_NS = 10_000_000_000
LEAST = 30  # least number of spans or measurements for a factor
CERTAIN_M = 0.02  # largest 3σ position uncertainty [m] of a reported mount
NEGLIGIBLE_M = 0.005  # smallest reported mount deviation [m]
DISTANT = 3.0  # standard deviations from which a mount deviation is significant

UNITS = {"covariance_factor": ""}


def odometry_factor(data: Sequence[Reference]) -> Mapping[str, float]:
    """`motion.covariance_factor`; empty for too few increments."""
    squared = [value for each in data for value in _spans(each)]
    return _factor(np.array(squared), 3)


def _spans(data: Reference) -> list[float]:
    intervals = data.intervals
    if intervals.increments is None or intervals.covariances is None or not len(intervals.end_ns):
        return []
    if not intervals.claimed.all():
        return []
    edges = np.append(intervals.end_ns[0] - intervals.duration_ns[0], intervals.end_ns)
    poses, known = poses_at(data.path, edges, data.gap_ns)
    found, start, sum_ = [], 0, Increment.identity()
    for k in range(len(intervals.end_ns)):
        sum_ = sum_.then(Increment(intervals.increments[k], intervals.covariances[k]))
        if edges[k + 1] - edges[start] < SPAN_NS:
            continue
        if known[start] and known[k + 1]:
            error = logarithm(between(sum_.mean, between(poses[start], poses[k + 1])))
            found.append(float(error @ np.linalg.solve(sum_.covariance, error)))
        start, sum_ = k + 1, Increment.identity()
    return found


def landmark_factor(data: Sequence[Reference], sensor: Sensor) -> Mapping[str, float]:
    """`sensor.covariance_factor`; empty for too few measurements."""
    parts = [np.empty(0)]
    for each in data:
        claims = each.seen.covariances
        if claims is None:
            continue
        rows = _rows(each, sensor)
        if each.seen.points is None:
            error = np.column_stack([rows.ranges - rows.true_ranges, rows.of_bearings])
        else:
            error = rows.points - rows.true_points
        full = claims[rows.taken][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        parts.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(full), error))
    return _factor(np.concatenate(parts), 2)


def _factor(squared: Float[np.ndarray, " n"], dof: int) -> Mapping[str, float]:
    if len(squared) < LEAST:
        return {}
    return {"covariance_factor": float(np.median(squared)) / float(chi2_quantile(0.5, dof))}


class _Rows(NamedTuple):
    taken: np.ndarray
    ranges: Float[np.ndarray, " n"]
    points: Float[np.ndarray, "n 2"]
    true_ranges: Float[np.ndarray, " n"]
    true_points: Float[np.ndarray, "n 2"]
    of_bearings: Float[np.ndarray, " n"]


def _rows(data: Reference, sensor: Sensor) -> _Rows:
    ranges, bearings = corrected(sensor, data.seen.ranges, data.seen.bearings)
    # A depth far from the optical axis has no distance.
    taken, _, poses, places = seen_landmarks(data, np.isfinite(ranges))
    ranges, bearings = ranges[taken], bearings[taken]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = (places - poses[:, :2]).T
    true = np.column_stack([c * dx + s * dy, c * dy - s * dx])
    points = ranges[:, np.newaxis] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    off = bearings - np.arctan2(true[:, 1], true[:, 0])
    off = np.arctan2(np.sin(off), np.cos(off))
    return _Rows(taken, ranges, points, np.hypot(true[:, 0], true[:, 1]), true, off)


def measured_and_true(
    data: Reference, sensor: Sensor
) -> tuple[Bool[np.ndarray, " N"], Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """Mask of usable detections; measured and true points [m] in the sensor frame."""
    rows = _rows(data, sensor)
    points, true = (np.full((len(rows.taken), 2), np.nan) for _ in range(2))
    points[rows.taken], true[rows.taken] = rows.points, rows.true_points
    return rows.taken, points, true


def mount_note(data: Sequence[Reference], sensor: Sensor) -> tuple[str, ...]:
    """Note on a mount that deviates from the scenario's."""
    rows = [_rows(each, sensor) for each in data]
    points = np.concatenate([np.empty((0, 2)), *(each.points for each in rows)])
    true = np.concatenate([np.empty((0, 2)), *(each.true_points for each in rows)])
    if len(points) < LEAST:
        return ()
    # True points relative to the assumed mount are the measured ones, moved by the mount error.
    ranges = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-3)
    rays = points / ranges[:, np.newaxis]
    sigma = np.hypot(sensor.range_sigma, sensor.bearing_sigma * ranges)

    def residual(p: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        c, s = np.cos(p[2]), np.sin(p[2])
        stretched = points + p[3] * rays
        x = c * stretched[:, 0] - s * stretched[:, 1] + p[0] - true[:, 0]
        y = s * stretched[:, 0] + c * stretched[:, 1] + p[1] - true[:, 1]
        return np.concatenate([x, y])

    both = np.concatenate([sigma, sigma])
    found = huber(residual, both, np.zeros(4))
    J = np.column_stack([
        (residual(found + h) - residual(found - h)) / 2e-6 / both for h in 1e-6 * np.eye(4)
    ])  # fmt: skip
    spread = float(np.median(np.abs(residual(found) / both))) * 1.4826
    P = np.linalg.pinv(J.T @ J) * spread**2
    sigmas = np.sqrt(np.diag(P))[:2]
    if 3.0 * float(sigmas.max()) > CERTAIN_M:
        return (
            f"mount: the sensor's place on the base is not learnt (± {sigmas.max():.3f} m): in so "
            "narrow a view, or with so much noise, it can not be told from range_offset and "
            "bearing_offset",
        )
    if np.all(np.abs(found[:2]) <= np.maximum(DISTANT * sigmas, NEGLIGIBLE_M)):
        return ()
    x, y, heading = sensor.mount
    c, s = np.cos(heading), np.sin(heading)
    at = x + c * found[0] - s * found[1], y + s * found[0] + c * found[1]
    return (
        f"mount: the sensor is at ({at[0]:.3f}, {at[1]:.3f}) m on the base, ± {sigmas[0]:.3f} and "
        f"{sigmas[1]:.3f} m, not at ({x:g}, {y:g}): set sensor.mount = [{at[0]:.3f}, {at[1]:.3f}, "
        f"{heading:g}] and calibrate again. Its heading and "
        "bearing_offset have the same effect",
    )
