"""The landmarks of a window solved again: by Gauss-Newton, given each particle's path.

Sixteen particles at once, as `blocks` has them: one flat array of rows, a row is one quantity of
sixteen particles. A particle that has come to its end repeats its last evaluation.
"""

import math

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.hybrid_slam.landmark_kernel import innovation_of
from team.estimation.hybrid_slam.moments import by_landmark, by_slot
from team.estimation.hybrid_slam.sensitivity_kernel import Noise
from team.estimation.models import NEAREST_M

SOLVED = 1e-6
"""A Gauss-Newton step of squared Mahalanobis length below this changes nothing that matters."""
STEPS = 3
"""Gauss-Newton steps at most."""
NO_SENSOR = (0.0, 0.0, 0.0)
LANES = 16
Block = Float[np.ndarray, " rows_lanes"]

(
    # Where the landmark is evaluated, its result, its least cost, and whether it goes on.
    AT_X, AT_Y, MEAN_X, MEAN_Y, OF_XX, OF_XY, OF_YY, LEAST, GOES_ON,
    # Of one measurement: the direction, both innovations and both weights.
    DISTANCE, EX, EY, OF_RANGE, OF_BEARING, RANGE_INFORMATION, BEARING_INFORMATION,
    # Sums over the measurements: the cost, its gradient and Hessian, …
    COST, GX, GY, XX, XY, YY,
    # … what range and bearing share with their constant errors, …
    RX, RY, BX, BY, RANGE_SUM, BEARING_SUM, RANGE_WEIGHT, BEARING_WEIGHT, CROSS,
    # … and the variances of the last measurement.
    TOTAL, BEARING_TOTAL,
    END,
) = range(0, 34 * LANES, LANES)  # fmt: skip


@compiled
def _information(rr: float, rb: float, bb: float, noise: Noise) -> tuple[float, float, float]:
    """The inverse of the white part of a measurement's own covariance, as (rr, rb, bb)."""
    rb *= math.sqrt(noise.range_white * noise.bearing_white)
    rr, bb = noise.range_white * rr, noise.bearing_white * bb
    determinant = rr * bb - rb * rb
    return bb / determinant, -rb / determinant, rr / determinant


@compiled
def landmarks_of_window(
    known: UInt32[np.ndarray, " L"],
    starts: Float[np.ndarray, "M L 2"],
    start_covariances: Float[np.ndarray, "M L 3"],
    paths: Float[np.ndarray, "K M 3"],
    seen: UInt32[np.ndarray, " N"],
    keyframes: Int64[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, "M L 2"], Float[np.ndarray, "M L 3"]]:
    """`landmarks_along_paths` by ascending id, of measurements as they came (`seen`: the landmark
    of each).
    """
    ids, means, covariances = by_landmark(known, starts, start_covariances)
    order, bounds = by_slot(ids, seen)
    means, covariances = landmarks_along_paths(
        means,
        covariances,
        paths,
        bounds,
        keyframes[order],
        measurements[order],
        own=own[order],
        noise=noise,
    )
    return ids, means, covariances


@compiled
def landmarks_along_paths(
    starts: Float[np.ndarray, "M L 2"],
    start_covariances: Float[np.ndarray, "M L 3"],
    paths: Float[np.ndarray, "K M 3"],
    bounds: Int64[np.ndarray, " L+1"],
    keyframes: Int64[np.ndarray, " N"],
    measurements: Float[np.ndarray, "N 2"],
    own: Float[np.ndarray, "N own"],
    noise: Noise,
) -> tuple[Float[np.ndarray, "M L 2"], Float[np.ndarray, "M L 3"]]:
    """Each landmark of each particle by Gauss-Newton over its measurements, given the particle's
    path.

    Minimises Σ ‖z − h(path, landmark) − b‖² in R⁻¹ plus ‖b‖² in B⁻¹ from the EKF's mean with at
    most three steps, each kept only if the cost falls. R is the white part of the noise, of the
    range predicted at the start; b ~ N(0, B) is the landmark's constant error, B the rest of the
    variances (of the last measurement's range), eliminated by Schur's complement: with D = Σ R⁻¹ +
    B⁻¹ and C = Σ Hᵀ R⁻¹ the covariance is (Σ Hᵀ R⁻¹ H − C D⁻¹ Cᵀ)⁻¹ at the result, (xx, xy, yy).
    A measurement with a covariance of its own (`team.estimation.scans`) has W = R⁻¹ with the term
    between range and bearing; both constant errors are eliminated one after the other.
    Measurements bounds[l] to bounds[l + 1] belong to landmark l. Where no evaluation is finite the
    EKF's mean and covariance stay.
    """
    means, covariances = starts.copy(), start_covariances.copy()
    block, weights = np.empty(END), np.empty((len(measurements), LANES))
    for begin in range(0, len(means), LANES):
        count = min(LANES, len(means) - begin)
        for landmark in range(means.shape[1]):
            for j in range(LANES):
                i = begin + min(j, count - 1)
                block[AT_X + j], block[AT_Y + j] = starts[i, landmark, 0], starts[i, landmark, 1]
                block[LEAST + j], block[GOES_ON + j] = math.inf, 1.0
                block[MEAN_X + j], block[MEAN_Y + j] = block[AT_X + j], block[AT_Y + j]
                block[OF_XX + j] = start_covariances[i, landmark, 0]
                block[OF_XY + j] = start_covariances[i, landmark, 1]
                block[OF_YY + j] = start_covariances[i, landmark, 2]
            for step in range(STEPS + 1):
                for row in range(COST, BEARING_TOTAL):
                    block[row] = 0.0
                for j in range(LANES):
                    block[BEARING_TOTAL + j] = noise.bearing_variance
                for k in range(bounds[landmark], bounds[landmark + 1]):
                    _direct(block, paths[keyframes[k]], begin, count, measurements[k, 1])
                    if own.shape[1] and own[k, 3] >= 0.0:
                        _add_claim(block, measurements[k], own[k], noise)
                    else:
                        _weigh(block, measurements[k, 0], weights[k], noise, step == 0)
                    _add(block)
                _eliminate_errors(block, noise)
                if not _step(block):
                    break
            for j in range(count):
                i = begin + j
                means[i, landmark, 0] = block[MEAN_X + j]
                means[i, landmark, 1] = block[MEAN_Y + j]
                covariances[i, landmark, 0] = block[OF_XX + j]
                covariances[i, landmark, 1] = block[OF_XY + j]
                covariances[i, landmark, 2] = block[OF_YY + j]
    return means, covariances


@compiled
def _direct(
    block: Block, poses: Float[np.ndarray, "M 3"], begin: int, count: int, bearing: float
) -> None:
    """The rows DISTANCE to OF_BEARING of a measurement with this bearing."""
    for j in range(LANES):
        i = begin + min(j, count - 1)
        block[EX + j] = block[AT_X + j] - poses[i, 0]
        block[EY + j] = block[AT_Y + j] - poses[i, 1]
        block[OF_BEARING + j] = bearing + poses[i, 2]
    for j in range(LANES):
        dx, dy = block[EX + j], block[EY + j]
        apart = math.sqrt(dx * dx + dy * dy)
        distance = apart if apart > NEAREST_M else NEAREST_M
        away = max(abs(dx), abs(dy)) >= 1e-240
        direction = elementary.direction_near(abs(dy), dx if away else math.copysign(1.0, dx))
        angle = block[OF_BEARING + j] - math.copysign(direction, dy)
        turns = np.floor((math.pi - angle) / (2.0 * math.pi))
        block[OF_BEARING + j] = angle + 2.0 * math.pi * turns
        block[DISTANCE + j] = distance
        block[EX + j], block[EY + j] = dx / distance, dy / distance


@compiled
def _weigh(
    block: Block, reading: float, weights: Float[np.ndarray, " lanes"], noise: Noise, first: bool
) -> None:
    """The range's innovation and both weights by the sensor's noise; weights: of the range, as the
    first evaluation predicts it.
    """
    white = 1.0 / (noise.bearing_white * noise.bearing_variance)
    for j in range(LANES):
        distance = block[DISTANCE + j]
        total = noise.range_variance + noise.range_per_m2 * distance * distance
        weight = 1.0 / (noise.range_white * total) if first else weights[j]
        weights[j] = weight
        block[RANGE_INFORMATION + j], block[BEARING_INFORMATION + j] = weight, white
        block[OF_RANGE + j] = reading - distance
        block[TOTAL + j], block[BEARING_TOTAL + j] = total, noise.bearing_variance


@compiled
def _add_claim(
    block: Block,
    measurement: Float[np.ndarray, "2"],
    own: Float[np.ndarray, " own"],
    noise: Noise,
) -> None:
    """The same by the noise that a measurement claims; adds the terms between range and bearing."""
    for j in range(LANES):
        distance, ex, ey = block[DISTANCE + j], block[EX + j], block[EY + j]
        of_range, of_bearing, total, between, bearing_total = innovation_of(
            measurement, own, NO_SENSOR, distance, block[OF_BEARING + j]
        )
        wr, w, wb = _information(total, between, bearing_total, noise)
        along, across = w * of_bearing, w * of_range
        block[COST + j] += 2.0 * along * of_range
        block[GX + j] += along * ex - across * ey / distance
        block[GY + j] += along * ey + across * ex / distance
        block[XX + j] -= 2.0 * w * ex * ey / distance
        block[XY + j] += w * (ex * ex - ey * ey) / distance
        block[YY + j] += 2.0 * w * ex * ey / distance
        block[RX + j] -= w * ey / distance
        block[RY + j] += w * ex / distance
        block[BX + j] += w * ex
        block[BY + j] += w * ey
        block[RANGE_SUM + j] += along
        block[BEARING_SUM + j] += across
        block[CROSS + j] += w
        block[RANGE_INFORMATION + j], block[BEARING_INFORMATION + j] = wr, wb
        block[OF_RANGE + j], block[OF_BEARING + j] = of_range, of_bearing
        block[TOTAL + j], block[BEARING_TOTAL + j] = total, bearing_total


@compiled
def _add(block: Block) -> None:
    """Adds a measurement's terms by its innovations and weights."""
    for j in range(LANES):
        distance, ex, ey = block[DISTANCE + j], block[EX + j], block[EY + j]
        of_range, of_bearing = block[OF_RANGE + j], block[OF_BEARING + j]
        wr, wb = block[RANGE_INFORMATION + j], block[BEARING_INFORMATION + j]
        block[COST + j] += wr * of_range * of_range + wb * of_bearing * of_bearing
        wr_r, wb_b = wr * of_range, wb * of_bearing / distance
        block[GX + j] += wr_r * ex - wb_b * ey
        block[GY + j] += wr_r * ey + wb_b * ex
        wt = wb / (distance * distance)
        block[XX + j] += wr * ex * ex + wt * ey * ey
        block[XY + j] += (wr - wt) * ex * ey
        block[YY + j] += wr * ey * ey + wt * ex * ex
        block[RX + j] += wr * ex
        block[RY + j] += wr * ey
        block[BX + j] -= wb * ey / distance
        block[BY + j] += wb * ex / distance
        block[RANGE_SUM + j] += wr_r
        block[RANGE_WEIGHT + j] += wr
        block[BEARING_SUM + j] += wb * of_bearing
        block[BEARING_WEIGHT + j] += wb


@compiled
def _eliminate_errors(block: Block, noise: Noise) -> None:
    """Takes the constant errors of range and bearing out, by Schur's complement."""
    if noise.range_white < 1.0:
        for j in range(LANES):
            constant = (1.0 - noise.range_white) * block[TOTAL + j]
            share = 1.0 / (block[RANGE_WEIGHT + j] + 1.0 / constant)
            total, rx, ry, cross = (
                block[RANGE_SUM + j], block[RX + j], block[RY + j], block[CROSS + j]
            )  # fmt: skip
            block[COST + j] -= share * total * total
            block[GX + j] -= share * total * rx
            block[GY + j] -= share * total * ry
            block[XX + j] -= share * rx * rx
            block[XY + j] -= share * rx * ry
            block[YY + j] -= share * ry * ry
            block[BEARING_SUM + j] -= share * cross * total
            block[BX + j] -= share * cross * rx
            block[BY + j] -= share * cross * ry
            block[BEARING_WEIGHT + j] -= share * cross * cross
    if noise.bearing_white < 1.0:
        for j in range(LANES):
            constant = (1.0 - noise.bearing_white) * block[BEARING_TOTAL + j]
            share = 1.0 / (block[BEARING_WEIGHT + j] + 1.0 / constant)
            total, bx, by = block[BEARING_SUM + j], block[BX + j], block[BY + j]
            block[COST + j] -= share * total * total
            block[GX + j] -= share * total * bx
            block[GY + j] -= share * total * by
            block[XX + j] -= share * bx * bx
            block[XY + j] -= share * bx * by
            block[YY + j] -= share * by * by


@compiled
def _step(block: Block) -> bool:
    """Keeps the evaluations of lower cost, and steps on from them; returns whether any does."""
    for j in range(LANES):
        gx, gy = block[GX + j], block[GY + j]
        xx, xy, yy = block[XX + j], block[XY + j], block[YY + j]
        determinant = xx * yy - xy * xy
        better = block[COST + j] < block[LEAST + j] and determinant > 0.0
        better = better and block[GOES_ON + j] > 0.0
        step_x, step_y = (yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant
        block[LEAST + j] = block[COST + j] if better else block[LEAST + j]
        block[MEAN_X + j] = block[AT_X + j] if better else block[MEAN_X + j]
        block[MEAN_Y + j] = block[AT_Y + j] if better else block[MEAN_Y + j]
        block[OF_XX + j] = yy / determinant if better else block[OF_XX + j]
        block[OF_XY + j] = -xy / determinant if better else block[OF_XY + j]
        block[OF_YY + j] = xx / determinant if better else block[OF_YY + j]
        far = better and not step_x * gx + step_y * gy < SOLVED
        block[AT_X + j] = block[AT_X + j] + step_x if far else block[AT_X + j]
        block[AT_Y + j] = block[AT_Y + j] + step_y if far else block[AT_Y + j]
        block[GOES_ON + j] = 1.0 if far else 0.0
    going = 0.0
    for j in range(LANES):
        going += block[GOES_ON + j]
    return going > 0.0
