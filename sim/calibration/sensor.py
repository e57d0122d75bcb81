"""Maximum-likelihood range-bearing model: affine range, noise and correlation time.

For a depth along the optical axis, range = scale · distance · cos(b − axis) + offset with raw
bearing b.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares, minimize

from teamslam.central.desk.evaluation.errors import on_circle
from teamslam.sim.calibration.data import (
    Reference,
    by_robot,
    poses_at,
    seen_landmarks,
    sensor_poses,
)
from teamslam.sim.calibration.figures import HUBER, CalibrationError, huber
from teamslam.team.config import Sensor
from teamslam.team.estimation.models import corrected
from teamslam.team.shapes import Float, Int64

LEAST_MEASUREMENTS = 100
ROUNDS = 4
OUTLIER = 4.0  # standard deviations beyond which measurements are outliers
MAD_TO_SIGMA = 1.4826
LAGS_S = np.geomspace(0.1, 30.0, 9)  # lag edges [s] of the error correlation of one landmark
NEIGHBOURS = 64  # largest index distance of paired measurements of a landmark

UNITS = {
    "range_offset": "m",
    "range_scale": "",
    "optical_axis": "rad",
    "range_sigma": "m",
    "range_sigma_per_m": "m/m",
    "range_white": "",
    "range_correlation_s": "s",
    "bearing_offset": "rad",
    "bearing_lens.linear": "",
    "bearing_lens.square": "1/rad",
    "bearing_lens.cubic": "1/rad²",
    "bearing_sigma": "rad",
    "bearing_white": "",
    "bearing_correlation_s": "s",
    "bearing_outliers": "",
    "marker_range_offset": "m",
}


@dataclass(frozen=True)
class _Rows:
    """True distances [m] and bearing errors [rad]; rows ascend by (series, time).

    series: equal for one landmark and robot.
    """

    series: Int64[np.ndarray, " n"]
    seconds: Float[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    distances: Float[np.ndarray, " n"]
    bearing_errors: Float[np.ndarray, " n"]


def _rows(data: Sequence[Reference]) -> _Rows:
    parts = [np.zeros((0, 6))]
    for k, each in enumerate(data):
        seen, (known, stamps, poses, positions) = each.seen, seen_landmarks(each)
        if not known.any():
            continue
        ahead = positions - poses[:, :2]
        expected = np.arctan2(ahead[:, 1], ahead[:, 0]) - poses[:, 2]
        columns = (
            k * 1_000_000.0 + seen.ids[known],
            (stamps - each.path.stamps_ns[0]) * 1e-9,
            seen.ranges[known],
            seen.bearings[known],
            np.hypot(ahead[:, 0], ahead[:, 1]),
            on_circle(seen.bearings[known] - expected),
        )
        parts.append(np.stack(columns, axis=1))
    rows = np.concatenate(parts)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    return _Rows(rows[:, 0].astype(np.int64), *rows[:, 1:].T)


class Constants(NamedTuple):
    """range = scale · d · cos(b − axis) + offset [m]; bearing + offset.

    axis: None if the range is the distance. lens: coefficients of b, b² and b³ of excess bearing.
    """

    range_scale: float
    range_offset: float
    bearing_offset: float
    axis: float | None
    lens: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def figures(self) -> dict[str, float]:
        """Constants by the fields of `Sensor`."""
        named = {
            "range_offset": self.range_offset,
            "range_scale": self.range_scale,
            "bearing_offset": self.bearing_offset,
        }
        if self.axis is None:
            return named
        bent = zip(("linear", "square", "cubic"), self.lens, strict=True)
        named |= {f"bearing_lens.{name}": value for name, value in bent}
        return named | {"optical_axis": self.axis}

    def distances(
        self, ranges: Float[np.ndarray, " n"], bearings: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Distances [m] of raw ranges; NaN far from the axis."""
        sensor = Sensor(
            range_offset=self.range_offset,
            range_scale=self.range_scale,
            range_is_depth=self.axis is not None,
            optical_axis=self.axis or 0.0,
        )
        return corrected(sensor, ranges, bearings)[0]


def constants(data: Sequence[Reference], *, depth: bool) -> Constants:
    """Fit one camera: ranges under Huber's loss, bearings by the median."""
    return _constants(_enough(_rows(data)), depth)


def joint_constants(
    data: Sequence[Reference], *, depth: bool
) -> tuple[Constants, Float[np.ndarray, "p p"]]:
    """Fit the constants, with their covariance in the order of `Constants.figures`:

    (JᵀWJ)⁻¹ JᵀW diag(e²) WJ (JᵀWJ)⁻¹ with bounded residuals e (White 1980).
    """
    rows = _enough(_rows(data))
    found = _constants(rows, depth)
    d, one = rows.distances, np.ones(len(rows.distances))
    if found.axis is None:
        along, columns = one, [one, d]
        bent, of_bearing = one[:, np.newaxis] * found.bearing_offset, [one]
    else:
        from_axis = rows.bearings - found.axis
        along = np.cos(from_axis)
        columns = [one, d * along, found.range_scale * d * np.sin(from_axis)]
        of_bearing = list((rows.bearings[:, np.newaxis] ** np.arange(4)).T)
        bent = np.column_stack(of_bearing) * (found.bearing_offset, *found.lens)
    ranged = rows.ranges - found.range_scale * d * along - found.range_offset
    turned = on_circle(rows.bearing_errors - bent.sum(axis=1))
    of_ranges = _sandwich(np.column_stack(columns), ranged, np.hypot(0.05, 0.04 * d))
    of_bearings = _sandwich(np.column_stack(of_bearing), turned, one)
    joint = block_diag(of_ranges, of_bearings)
    order = [0, 1, 2] if found.axis is None else [0, 1, 3, 4, 5, 6, 2]
    return found, joint[np.ix_(order, order)]


def _sandwich(
    J: Float[np.ndarray, "n p"], error: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "p p"]:
    weighted, e = J / sigma[:, np.newaxis], error / sigma
    bound = HUBER * MAD_TO_SIGMA * float(np.median(np.abs(e)))
    scores = weighted * np.clip(e, -bound, bound)[:, np.newaxis]
    inverse = np.linalg.inv(weighted.T @ weighted)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse)


def _enough(rows: _Rows) -> _Rows:
    if len(rows.series) < LEAST_MEASUREMENTS:
        raise CalibrationError(
            f"{len(rows.series)} measurements of landmarks from known poses, "
            f"{LEAST_MEASUREMENTS} needed: record more, or give several data sets at once"
        )
    return rows


def _constants(rows: _Rows, depth: bool) -> Constants:
    affine, noise = np.array([1.0, 0.0, 0.0][: 3 if depth else 2]), np.array([0.05, 0.04])

    def residual(p: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        along = np.cos(rows.bearings - p[2]) if depth else 1.0
        return np.asarray(rows.ranges - p[0] * rows.distances * along - p[1])

    for _ in range(ROUNDS):
        sigma = np.hypot(noise[0], noise[1] * rows.distances)
        affine = huber(residual, sigma, affine)
        noise = _range_noise(residual(affine) / affine[0], rows.distances, sigma)
    offset = float(np.median(rows.bearing_errors))
    scale, shift = float(affine[0]), float(affine[1])
    if not depth:
        return Constants(scale, shift, offset, None)
    bent = _lens(rows, offset)
    return Constants(scale, shift, bent[0], float(affine[2]), (bent[1], bent[2], bent[3]))


def _lens(rows: _Rows, offset: float) -> list[float]:
    """Fit offset and lens under Huber's loss."""
    error = on_circle(rows.bearing_errors - offset)
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(error)))
    powers = rows.bearings[:, np.newaxis] ** np.arange(4)

    found = huber(lambda p: error - powers @ p, np.full(len(error), sigma), np.zeros(4))
    found[0] += offset
    return [float(each) for each in found]


def fit_sensor(data: Sequence[Reference], *, depth: bool = False) -> Mapping[str, float]:
    """Fit the likeliest `Sensor`; raises CalibrationError.

    Constants are of all robots; noise of residuals under each robot's own: σ² = σ₀² + (σ₁ d)² by
    likelihood, for bearings the median absolute deviation. White shares and times T fit ρ(τ) = (1 −
    white) exp(−τ/T) to one landmark's error correlation.
    """
    common = constants(data, depth=depth)
    parts = []
    owns: dict[str, Constants] = {}
    for k, each in enumerate(by_robot(data).values()):
        rows = _rows(each)
        if len(rows.series) < LEAST_MEASUREMENTS:
            continue
        own = owns[each[0].robot] = _constants(rows, depth)
        range_errors = own.distances(rows.ranges, rows.bearings) - rows.distances
        bent = rows.bearings[:, np.newaxis] ** np.arange(1, 4) @ own.lens
        turned = on_circle(rows.bearing_errors - own.bearing_offset - bent)
        columns = (rows.series + k * 1e9, rows.seconds, rows.distances, range_errors, turned)
        parts.append(np.stack(columns, axis=1)[np.isfinite(range_errors)])
    series, seconds, distances, error, turned = np.concatenate(parts).T
    series = series.astype(np.int64)
    sigma = np.hypot(0.05, 0.04 * distances)
    for _ in range(ROUNDS):
        noise = _range_noise(error, distances, sigma)
        sigma = np.hypot(noise[0], noise[1] * distances)
    bearing_sigma = MAD_TO_SIGMA * float(np.median(np.abs(turned)))
    range_white, range_time = _persistence(series, seconds, error / sigma)
    bearing_white, bearing_time = _persistence(series, seconds, turned / bearing_sigma)
    figures = common.figures | {
        "range_sigma": float(noise[0]),
        "range_sigma_per_m": float(noise[1]),
        "range_white": range_white,
        "range_correlation_s": range_time,
        "bearing_sigma": bearing_sigma,
        "bearing_white": bearing_white,
        "bearing_correlation_s": bearing_time,
        "bearing_outliers": float(np.mean(np.abs(turned) > 5.0 * bearing_sigma)),
    }
    return figures | _marker(data, owns)


def shares_by_landmark(data: Reference, *, depth: bool) -> dict[int, float]:
    """Relative excess range of landmarks with LEAST_MEASUREMENTS: medians less their mean."""
    rows = _rows([data])
    if len(rows.series) < LEAST_MEASUREMENTS:
        return {}
    own = _constants(rows, depth)
    share = own.distances(rows.ranges, rows.bearings) / rows.distances - 1.0
    found = {}
    for landmark in np.unique(rows.series).tolist():
        chosen = (rows.series == landmark) & np.isfinite(share)
        if np.count_nonzero(chosen) >= LEAST_MEASUREMENTS:
            found[landmark] = float(np.median(share[chosen]))
    mean = float(np.mean(list(found.values()))) if found else 0.0
    return {landmark: value - mean for landmark, value in found.items()}


def _range_noise(
    error: Float[np.ndarray, " n"],
    distance: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "2"]:
    """(σ₀, σ₁) of errors within OUTLIER of the last σ, by maximum likelihood."""
    inside = np.abs(error) < OUTLIER * sigma
    error, distance = error[inside], distance[inside]

    def cost(logs: Float[np.ndarray, "2"]) -> float:
        spread = np.hypot(np.exp(logs[0]), np.exp(logs[1]) * distance)
        return float(np.sum(np.log(spread) + 0.5 * (error / spread) ** 2))

    found = minimize(cost, np.log([0.02, 0.04]), method="L-BFGS-B", bounds=[(-7.0, 3.0)] * 2)
    return np.asarray(np.exp(found.x))


def _persistence(
    series: Int64[np.ndarray, " n"],
    seconds: Float[np.ndarray, " n"],
    relative: Float[np.ndarray, " n"],
) -> tuple[float, float]:
    """(white share, correlation time [s]); (1, 0) without correlation."""
    inside = np.abs(relative) < OUTLIER
    variance = float(np.mean(relative[inside] ** 2))
    counts, sums, times = (np.zeros(len(LAGS_S) - 1) for _ in range(3))
    for step in range(1, min(NEIGHBOURS, len(relative))):
        pair = (series[step:] == series[:-step]) & inside[step:] & inside[:-step]
        lag = (seconds[step:] - seconds[:-step])[pair]
        product = (relative[step:] * relative[:-step])[pair]
        at = np.searchsorted(LAGS_S, lag) - 1
        counted = (at >= 0) & (at < len(counts))
        counts += np.bincount(at[counted], minlength=len(counts))
        sums += np.bincount(at[counted], product[counted], minlength=len(counts))
        times += np.bincount(at[counted], lag[counted], minlength=len(counts))
    filled = counts >= LEAST_MEASUREMENTS
    if np.count_nonzero(filled) < 3:
        return 1.0, 0.0
    rho = sums[filled] / counts[filled] / variance
    lags = times[filled] / counts[filled]

    def misfit(p: Float[np.ndarray, "2"]) -> Float[np.ndarray, " n"]:
        return np.asarray(p[0] * np.exp(-lags / np.exp(p[1])) - rho)

    bounds = ([0.0, np.log(0.05)], [0.99, np.log(1e3)])
    found = least_squares(misfit, [0.5, np.log(5.0)], bounds=bounds)
    share, time_s = float(found.x[0]), float(np.exp(found.x[1]))
    if time_s < lags[0]:  # shorter than the measurement interval, so any share fits
        return 1.0, 0.0
    return 1.0 - share, time_s


def _marker(data: Sequence[Reference], owns: Mapping[str, Constants]) -> dict[str, float]:
    """Excess distance [m] of teammates, the median of the nearer half."""
    errors, distances = [np.zeros(0)], [np.zeros(0)]
    for each in data:
        seen, own = each.sighted, owns.get(each.robot)
        if own is None:
            continue
        stamps = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
        here, known = sensor_poses(each, stamps)
        measured = own.distances(seen.ranges, seen.bearings)
        for index, name in enumerate(each.names):
            if name in each.teammates:
                teammate_poses, teammate_known = poses_at(each.teammates[name], stamps, each.gap_ns)
                chosen = known & teammate_known & (seen.ids == index) & np.isfinite(measured)
                distance = np.hypot(*(teammate_poses - here)[chosen, :2].T)
                errors.append(measured[chosen] - distance)
                distances.append(distance)
    error, distance = np.concatenate(errors), np.concatenate(distances)
    if len(error) < LEAST_MEASUREMENTS:
        return {}
    near = distance <= np.median(distance)
    return {"marker_range_offset": float(np.median(error[near]))}
