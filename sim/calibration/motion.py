"""Maximum-likelihood odometry model: scales, drag, veer and noise densities."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from teamslam.central.desk.evaluation.errors import on_circle
from teamslam.sim.calibration.data import (
    LEAST_SPANS,
    LEAST_WAY_M,
    SPAN_S,
    Reference,
    poses_at,
    sinc,
    too_short,
)
from teamslam.sim.calibration.figures import CalibrationError, huber
from teamslam.team.shapes import Float

STEPS = 40  # steps of a span, each an arc (or rotation and chord) of the true path
STEP_S = SPAN_S / STEPS
ROUNDS = 4
STANDING_M_S = 1e-3  # speeds below this [m/s] count as standing
FLOOR_VARIANCE = 1e-6  # variance of a motionless span: a millimetre, a milliradian of the reference

UNITS = {
    "forward_scale": "",
    "turn_drag": "m",
    "yaw_scale": "",
    "veer": "rad/m",
    "slow_scale": "",
    "forward.per_m": "m/√m",
    "forward.per_rad": "m/√rad",
    "turn.per_m": "rad/√m",
    "turn.per_rad": "rad/√rad",
    "lateral.per_m": "m/√m",
}

LEAST_SLOW_S = 20.0  # least time [s] at low speed for its scale

Numbers = Float[np.ndarray, " p"]
Pair = Float[np.ndarray, "2"]
Grid = Float[np.ndarray, "spans steps"]
Values = Float[np.ndarray, " spans"]


@dataclass(frozen=True)
class _Spans:
    """Steps of each span: logged speed and yaw rate; true forward, lateral and rotation."""

    speed: Grid
    yaw_rate: Grid
    forward: Grid
    lateral: Grid
    turn: Grid

    @property
    def way(self) -> Values:
        """True path length [m]."""
        return np.asarray(np.abs(self.forward).sum(axis=1))

    @property
    def driven(self) -> Values:
        """True forward translation [m]."""
        return np.asarray(self.forward.sum(axis=1))

    @property
    def turned(self) -> Values:
        """True rotation [rad]."""
        return np.asarray(self.turn.sum(axis=1))

    def rates(self, yaw_scale: float, limit: float) -> Grid:
        """clip(yaw_scale · yaw rate, ±limit) [rad/s]."""
        return np.asarray(np.clip(yaw_scale * self.yaw_rate, -limit, limit))

    def slow(self, below: float) -> Grid:
        """1 for a moving step below this logged speed [m/s], else 0."""
        speed = np.abs(self.speed)
        return np.asarray(((speed < below) & (speed > STANDING_M_S)).astype(np.float64))

    def forward_of(self, p: Numbers, yaw_scale: float, limit: float, below: float) -> Values:
        """Modelled translation for p = (forward_scale, turn_drag, slow_scale or nothing) [m]."""
        lost = p[1] * np.abs(self.rates(yaw_scale, limit))
        scale = p[0] + (p[2] - p[0]) * self.slow(below) if len(p) > 2 else p[0]
        speed = np.maximum(scale * np.abs(self.speed) - lost, 0.0)
        return np.asarray((np.sign(self.speed) * speed).sum(axis=1) * STEP_S)

    def turn_of(self, p: Pair, limit: float) -> Values:
        """Modelled rotation for p = (yaw_scale, veer) on the true path [rad]."""
        return np.asarray(self.rates(p[0], limit).sum(axis=1) * STEP_S + p[1] * self.driven)


def _spans(data: Sequence[Reference]) -> _Spans:
    steps = np.concatenate([np.zeros((0, STEPS, 5)), *(_steps_of(each) for each in data)])
    return _Spans(*steps.transpose(2, 0, 1))


def _steps_of(data: Reference) -> Float[np.ndarray, "spans steps 5"]:
    intervals = data.intervals
    if len(intervals.end_ns) < 2:
        return np.zeros((0, STEPS, 5))
    edges = np.append(intervals.end_ns[0] - intervals.duration_ns[0], intervals.end_ns)
    spans = int((edges[-1] - edges[0]) * 1e-9 / SPAN_S)
    grid = edges[0] + np.rint(np.arange(spans * STEPS + 1) * STEP_S * 1e9).astype(np.int64)
    poses, known = poses_at(data.path, grid, data.gap_ns, turns_first=data.turns_first)
    logged = [
        np.diff(
            np.interp(
                grid - edges[0],
                edges - edges[0],
                np.append(0.0, np.cumsum(rate * intervals.duration_ns * 1e-9)),
            )
        )
        / STEP_S
        for rate in (intervals.forward, intervals.yaw_rate)
    ]
    turn = on_circle(np.diff(poses[:, 2]))
    toward = poses[1:, 2] if data.turns_first else poses[1:, 2] - 0.5 * turn
    c, s = np.cos(toward), np.sin(toward)
    chords = np.ones_like(turn) if data.turns_first else sinc(0.5 * turn)
    x, y = np.diff(poses[:, :2], axis=0).T / chords
    rows = np.stack([*logged, c * x + s * y, c * y - s * x, turn], axis=1)
    whole = (known[1:] & known[:-1]).reshape(spans, STEPS).all(axis=1)
    return np.asarray(rows.reshape(spans, STEPS, 5)[whole])


def creep(data: Sequence[Reference], slow_below: float) -> bool:
    """Whether slow motion lasts long enough for its scale."""
    return bool(_spans(data).slow(slow_below).sum() * STEP_S >= LEAST_SLOW_S)


def fit_motion(
    data: Sequence[Reference], yaw_rate_limit: float | None, slow_below: float = 0.0
) -> Mapping[str, float]:
    """Fit the model of `increment_of`, with errors over SPAN_S; raises CalibrationError.

    slow_below [m/s]: fit the scale below that speed, too. Alternates weighted least squares of the
    scales under Huber's loss with the likelihood of σ² = per_m² |d| + per_rad² |φ|.
    """
    spans = _spans(data)
    moving = np.abs(spans.speed).mean(axis=1) * SPAN_S > LEAST_WAY_M
    if np.count_nonzero(moving) < LEAST_SPANS:
        raise CalibrationError(
            f"{too_short(int(np.count_nonzero(moving)))} A stretch counts where the path is known "
            "throughout: by truth, or by landmarks in sight"
        )
    limit = np.inf if yaw_rate_limit is None else yaw_rate_limit
    way, rotation = spans.way, np.abs(spans.rates(1.0, limit)).sum(axis=1) * STEP_S
    scale, drift = np.array([1.0, 0.0, *([1.0] if slow_below else [])]), np.array([1.0, 0.0])
    of_way, of_turn = np.array([0.05, 0.02]), np.array([0.05, 0.1])

    def of_the_turn(p: Pair) -> Values:
        return np.asarray(spans.turned - spans.turn_of(p, limit))

    def of_the_way(p: Numbers) -> Values:
        return np.asarray(spans.driven - spans.forward_of(p, float(drift[0]), limit, slow_below))

    for _ in range(ROUNDS):
        drift = huber(of_the_turn, _sigma(of_turn, way, rotation), drift)
        of_turn = _densities(of_the_turn(drift), way, rotation)
        scale = huber(of_the_way, _sigma(of_way, way, rotation), scale)
        of_way = _densities(of_the_way(scale), way, rotation)
    lateral = spans.lateral.sum(axis=1)[moving]
    return {
        "forward_scale": float(scale[0]),
        "turn_drag": max(float(scale[1]), 0.0),
        "yaw_scale": float(drift[0]),
        "veer": float(drift[1]),
        **({"slow_scale": float(scale[2])} if slow_below else {}),
        "forward.per_m": float(of_way[0]),
        "forward.per_rad": float(of_way[1]),
        "turn.per_m": float(of_turn[0]),
        "turn.per_rad": float(of_turn[1]),
        "lateral.per_m": float(np.sqrt(np.mean(lateral**2) / np.mean(way[moving]))),
    }


def _sigma(densities: Pair, way: Values, rotation: Values) -> Values:
    variance = densities[0] ** 2 * way + densities[1] ** 2 * rotation
    return np.asarray(np.sqrt(variance + FLOOR_VARIANCE))


def _densities(residual: Values, way: Values, rotation: Values) -> Pair:
    """(per_m, per_rad) that maximise Σ log N(residual; 0, per_m² way + per_rad² rotation)."""

    def cost(logs: Pair) -> float:
        sigma = _sigma(np.exp(logs), way, rotation)
        return float(np.sum(np.log(sigma) + 0.5 * (residual / sigma) ** 2))

    found = minimize(cost, np.log([0.05, 0.05]), method="Nelder-Mead", options={"xatol": 1e-3})
    return np.asarray(np.exp(found.x))
