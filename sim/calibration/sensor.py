"""Maximum likelihood of the range-bearing sensor's model: affine range, noise, its persistence."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.optimize import least_squares, minimize

from central.desk.evaluation.errors import on_circle
from sim.calibration.data import Reference, poses_at
from sim.calibration.figures import CalibrationError, huber

LEAST_MEASUREMENTS = 100
ROUNDS = 4
OUTLIER = 4.0
"""Standard deviations beyond which a measurement is no part of a spread or a correlation."""
MAD_TO_SIGMA = 1.4826
LAGS_S = np.geomspace(0.1, 30.0, 9)
"""Edges of the lags at which the errors of one landmark are correlated."""
NEIGHBOURS = 64
"""Pairs of measurements of one landmark are taken up to so many measurements apart."""

UNITS = {
    "range_offset": "m",
    "range_scale": "",
    "range_sigma": "m",
    "range_sigma_per_m": "m/m",
    "range_white": "",
    "range_correlation_s": "s",
    "bearing_offset": "rad",
    "bearing_sigma": "rad",
    "bearing_white": "",
    "bearing_correlation_s": "s",
    "bearing_outliers": "",
    "marker_range_offset": "m",
}


@dataclass(frozen=True)
class _Rows:
    """Measurements with what they should have been: distances [m] and bearings [rad].

    series: equal for measurements of one landmark by one robot; the rows ascend by (series, time).
    """

    series: Int64[np.ndarray, " n"]
    seconds: Float[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    distances: Float[np.ndarray, " n"]
    bearing_errors: Float[np.ndarray, " n"]


def _rows(data: Sequence[Reference]) -> _Rows:
    parts = [np.zeros((0, 5))]
    for k, each in enumerate(data):
        seen = each.seen
        ids = np.array(sorted(each.landmarks), dtype=np.int64)
        stamps = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
        poses, known = poses_at(each.path, stamps, each.gap_ns, turns_first=each.turns_first)
        known &= np.isin(seen.ids, ids)
        if not known.any():
            continue
        positions = np.array([each.landmarks[i] for i in seen.ids[known].tolist()])
        ahead = positions - poses[known, :2]
        expected = np.arctan2(ahead[:, 1], ahead[:, 0]) - poses[known, 2]
        columns = (
            k * 1_000_000.0 + seen.ids[known],
            (stamps[known] - each.path.stamps_ns[0]) * 1e-9,
            seen.ranges[known],
            np.hypot(ahead[:, 0], ahead[:, 1]),
            on_circle(seen.bearings[known] - expected),
        )
        parts.append(np.stack(columns, axis=1))
    rows = np.concatenate(parts)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    return _Rows(rows[:, 0].astype(np.int64), *rows[:, 1:].T)


def fit_sensor(data: Sequence[Reference]) -> Mapping[str, float]:
    """The model of `Sensor` under which the measurements are most likely.

    range = scale · distance + offset under Huber's loss in units of the noise, then the noise
    σ² = σ₀² + (σ₁ d)² by likelihood, in turn. Bearings: median and median absolute deviation, since
    outliers come in bursts. Shares: ρ(τ) = (1 − white) exp(−τ/T) fitted to the correlation of one
    landmark's errors. Raises CalibrationError where there are too few measurements.
    """
    rows = _rows(data)
    if len(rows.series) < LEAST_MEASUREMENTS:
        raise CalibrationError(
            f"{len(rows.series)} measurements of landmarks from known poses, "
            f"{LEAST_MEASUREMENTS} needed"
        )
    affine, noise = np.array([1.0, 0.0]), np.array([0.05, 0.04])
    error = rows.ranges - rows.distances

    def residual(p: Float[np.ndarray, "2"]) -> Float[np.ndarray, " n"]:
        return np.asarray(rows.ranges - p[0] * rows.distances - p[1])

    for _ in range(ROUNDS):
        sigma = np.hypot(noise[0], noise[1] * rows.distances)
        affine = huber(residual, sigma, affine)
        error = residual(affine) / affine[0]
        noise = _range_noise(error, rows.distances, sigma)
    relative = error / np.hypot(noise[0], noise[1] * rows.distances)
    offset = float(np.median(rows.bearing_errors))
    turned = on_circle(rows.bearing_errors - offset)
    bearing_sigma = MAD_TO_SIGMA * float(np.median(np.abs(turned)))
    range_white, range_time = _persistence(rows, relative)
    bearing_white, bearing_time = _persistence(rows, turned / bearing_sigma)
    figures = {
        "range_offset": float(affine[1]),
        "range_scale": float(affine[0]),
        "range_sigma": float(noise[0]),
        "range_sigma_per_m": float(noise[1]),
        "range_white": range_white,
        "range_correlation_s": range_time,
        "bearing_offset": offset,
        "bearing_sigma": bearing_sigma,
        "bearing_white": bearing_white,
        "bearing_correlation_s": bearing_time,
        "bearing_outliers": float(np.mean(np.abs(turned) > 5.0 * bearing_sigma)),
    }
    marker = _marker_offset(data, affine)
    return figures if marker is None else figures | {"marker_range_offset": marker}


def _range_noise(
    error: Float[np.ndarray, " n"],
    distance: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "2"]:
    """(σ₀, σ₁) of the errors within OUTLIER of the last σ, by maximum likelihood."""
    inside = np.abs(error) < OUTLIER * sigma
    error, distance = error[inside], distance[inside]

    def cost(logs: Float[np.ndarray, "2"]) -> float:
        spread = np.hypot(np.exp(logs[0]), np.exp(logs[1]) * distance)
        return float(np.sum(np.log(spread) + 0.5 * (error / spread) ** 2))

    found = minimize(cost, np.log([0.02, 0.04]), method="L-BFGS-B", bounds=[(-7.0, 3.0)] * 2)
    return np.asarray(np.exp(found.x))


def _persistence(rows: _Rows, relative: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """(white share, correlation time [s]) of errors in units of σ; (1, 0) if there is none."""
    inside = np.abs(relative) < OUTLIER
    variance = float(np.mean(relative[inside] ** 2))
    counts, sums, times = (np.zeros(len(LAGS_S) - 1) for _ in range(3))
    for apart in range(1, min(NEIGHBOURS, len(relative))):
        pair = (rows.series[apart:] == rows.series[:-apart]) & inside[apart:] & inside[:-apart]
        lag = (rows.seconds[apart:] - rows.seconds[:-apart])[pair]
        product = (relative[apart:] * relative[:-apart])[pair]
        at = np.searchsorted(LAGS_S, lag) - 1
        kept = (at >= 0) & (at < len(counts))
        counts += np.bincount(at[kept], minlength=len(counts))
        sums += np.bincount(at[kept], product[kept], minlength=len(counts))
        times += np.bincount(at[kept], lag[kept], minlength=len(counts))
    filled = counts >= LEAST_MEASUREMENTS
    if np.count_nonzero(filled) < 3:
        return 1.0, 0.0
    rho = sums[filled] / counts[filled] / variance
    lags = times[filled] / counts[filled]

    def misfit(p: Float[np.ndarray, "2"]) -> Float[np.ndarray, " n"]:
        return np.asarray(p[0] * np.exp(-lags / np.exp(p[1])) - rho)

    bounds = ([0.0, np.log(0.05)], [0.99, np.log(1e3)])
    found = least_squares(misfit, [0.5, np.log(5.0)], bounds=bounds)
    return 1.0 - float(found.x[0]), float(np.exp(found.x[1]))


def _marker_offset(data: Sequence[Reference], affine: Float[np.ndarray, "2"]) -> float | None:
    """The median of corrected range − distance over the sightings of teammates; None without."""
    errors = [np.zeros(0)]
    for each in data:
        seen = each.sighted
        stamps = np.repeat(seen.stamps_ns, np.diff(seen.offsets))
        here, known = poses_at(each.path, stamps, each.gap_ns, turns_first=each.turns_first)
        for index, name in enumerate(each.names):
            if name in each.teammates:
                there, there_known = poses_at(each.teammates[name], stamps, each.gap_ns)
                chosen = known & there_known & (seen.ids == index)
                distance = np.hypot(*(there - here)[chosen, :2].T)
                errors.append((seen.ranges[chosen] - affine[1]) / affine[0] - distance)
    found = np.concatenate(errors)
    return float(np.median(found)) if len(found) >= LEAST_MEASUREMENTS else None
