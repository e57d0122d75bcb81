"""Range-bearing sensor of the simulated world."""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.world.config import OutlierKind
from teamslam.sim.world.streams import Detections
from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.shapes import Float, Int64, UInt32

SHORTEST_MEASUREMENT_M = 0.05  # least measured range [m]

SHORTEST_TIME_S = 1e-9  # least correlation time [s]; shorter means uncorrelated


@dataclass(frozen=True)
class Visible:
    """V true range-bearing pairs, by step, then point."""

    steps: Int64[np.ndarray, " V"]
    points: Int64[np.ndarray, " V"]
    ranges: Float[np.ndarray, " V"]
    bearings: Float[np.ndarray, " V"]


def visible_points(
    poses: Float[np.ndarray, "K 3"],
    points: Float[np.ndarray, "#K P 2"],
    nearest: float,
    farthest: float,
    field_of_view: float,
) -> Visible:
    """Points with true range in [nearest, farthest] and true bearing in the field of view.

    points: P positions, constant or K × P.
    """
    dx = points[..., 0] - poses[:, :1]
    dy = points[..., 1] - poses[:, 1:2]
    ranges = core.hypot(dx, dy)
    steps, seen = np.nonzero((ranges >= nearest) & (ranges <= farthest))
    bearings = on_circle(core.atan2(dy[steps, seen], dx[steps, seen]) - poses[steps, 2])
    inside = np.abs(bearings) <= 0.5 * field_of_view
    steps, seen = steps[inside], seen[inside]
    return Visible(steps, seen, ranges[steps, seen], bearings[inside])


def persistent_errors(
    seen: Visible, sensor: Sensor, step_s: float, normals: Float[np.ndarray, "V 4"]
) -> Float[np.ndarray, "V 2"]:
    """Errors of unit variance, partly correlated over time for each point.

    n = √white w + √(1 − white) g with white w and g of a first-order Gauss-Markov process: g(t + τ)
    = ρ g(t) + √(1 − ρ²) n', ρ = exp(−τ/correlation time). normals: two columns of w and two of n',
    range first.
    """
    constant = normals[:, 2:].copy()
    times = np.array([sensor.range_correlation_s, sensor.bearing_correlation_s])
    order = np.lexsort((seen.steps, seen.points))
    repeated = np.flatnonzero(np.diff(seen.points[order]) == 0) + 1
    gaps = np.diff(seen.steps[order])[repeated - 1] * step_s
    correlation = core.exp(-gaps[:, np.newaxis] / np.maximum(times, SHORTEST_TIME_S))
    for row, rho in zip(repeated.tolist(), correlation, strict=True):
        before = constant[order[row - 1]]
        constant[order[row]] = rho * before + np.sqrt(1.0 - rho**2) * constant[order[row]]
    white = np.array([sensor.range_white, sensor.bearing_white])
    both: Float[np.ndarray, "V 2"] = np.sqrt(white) * normals[:, :2]
    both += np.sqrt(1.0 - white) * constant
    return both


LENS_ROUNDS = 20
"""Fixed-point rounds for a raw bearing; each multiplies the error by a lens's few per cent."""


def measurements(
    seen: Visible, sensor: Sensor, errors: Float[np.ndarray, "V 2"]
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Measured ranges [m] and bearings [rad], from errors n of unit variance.

    range = range_scale · (r + σ(r) n₁) + range_offset with σ(r)² = range_sigma² +
    (range_sigma_per_m r)²; bearing = raw + bearing_sigma n₂ with raw = b + bearing_offset +
    lens(raw). With range_is_depth r + σ(r) n₁ is projected on the optical axis.
    """
    raw = seen.bearings + sensor.bearing_offset
    lens = sensor.bearing_lens
    if not lens.is_ideal:
        straight = raw
        for _ in range(LENS_ROUNDS):
            raw = straight + raw * (lens.linear + raw * (lens.square + raw * lens.cubic))
    sigma = core.hypot(sensor.range_sigma, sensor.range_sigma_per_m * seen.ranges)
    distances = seen.ranges + sigma * errors[:, 0]
    if sensor.range_is_depth:
        distances = distances * core.cos(raw - sensor.optical_axis)
    ranges = sensor.range_scale * distances + sensor.range_offset
    bearings = raw + sensor.bearing_sigma * errors[:, 1]
    return np.maximum(ranges, SHORTEST_MEASUREMENT_M), on_circle(bearings)


def on_circle(angles: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
    """Wrap angles to (−π, π]."""
    turned = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(turned == -np.pi, np.pi, turned)


def add_outliers(
    seen: Detections,
    share: float,
    kind: OutlierKind,
    span: tuple[float, float],
    field_of_view: float,
    landmarks: int,
    uniforms: Float[np.ndarray, "R 3"],
) -> Detections:
    """Replace a share of the measurements by outliers, from uniform numbers in [0, 1).

    The first number of a row selects. "measurement": the others are a range in `span` [m] and a
    bearing in the field of view. "identity": the second selects another landmark 1 … `landmarks`.
    "drop": omitted.
    """
    chosen = uniforms[:, 0] < share
    if kind == "drop":
        return seen.where(~chosen)
    if kind == "identity":
        others = _others(seen.ids, landmarks, uniforms[:, 1])
        return replace(seen, ids=np.where(chosen, others, seen.ids))
    nearest, farthest = span
    ranges = nearest + (farthest - nearest) * uniforms[:, 1]
    bearings = field_of_view * (0.5 - uniforms[:, 2])
    return replace(
        seen,
        ranges=np.where(chosen, ranges, seen.ranges),
        bearings=np.where(chosen, bearings, seen.bearings),
    )


def _others(
    ids: UInt32[np.ndarray, " R"], landmarks: int, uniform: Float[np.ndarray, " R"]
) -> UInt32[np.ndarray, " R"]:
    ahead = 1 + np.floor(uniform * max(landmarks - 1, 1)).astype(np.int64)
    others: UInt32[np.ndarray, " R"] = (ids - 1 + ahead) % landmarks + 1
    return others.astype(np.uint32)
