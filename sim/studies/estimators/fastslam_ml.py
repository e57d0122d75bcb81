"""FastSLAM 1.0 with maximum-likelihood data association in each particle (Montemerlo and Thrun
2003).

Beyond the gate a detection is a new landmark; the heaviest particle has the map.
"""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.sim.world.streams import rows_of
from teamslam.team import core
from teamslam.team.config import GATE, UNNAMED, Sensor
from teamslam.team.core import mean_direction
from teamslam.team.estimation import dense
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, PoseGaussian
from teamslam.team.shapes import Bool, Float, Int64


@dataclass(frozen=True)
class FastSlamMl:
    """M particles with C landmark slots, the first counts[m] used.

    seen: detections per slot. took: slot of each detection. resample_below: relative effective
    sample size.
    """

    poses: Float[np.ndarray, "M 3"]
    logs: Float[np.ndarray, " M"]
    means: Float[np.ndarray, "M C 2"]
    covariances: Float[np.ndarray, "M C 2 2"]
    seen: Int64[np.ndarray, "M C"]
    counts: Int64[np.ndarray, " M"]
    took: Int64[np.ndarray, "M N"]
    resample_below: float


def initial_state(
    poses: Float[np.ndarray, "M 3"], logs: Float[np.ndarray, " M"], resample_below: float
) -> FastSlamMl:
    """Make particles without landmarks."""
    particles = len(poses)
    return FastSlamMl(
        poses=poses,
        logs=logs,
        means=np.zeros((particles, 16, 2)),
        covariances=np.zeros((particles, 16, 2, 2)),
        seen=np.zeros((particles, 16), np.int64),
        counts=np.zeros(particles, np.int64),
        took=np.empty((particles, 0), np.int64),
        resample_below=resample_below,
    )


def filter_step(state: FastSlamMl, step: RobotStep, generator: np.random.Generator) -> FastSlamMl:
    """Move, associate, update and resample."""
    values, vectors = np.linalg.eigh(step.increment.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = step.increment.mean + dense.product(
        generator.standard_normal((len(state.poses), 3)), root.T
    )
    s, c = core.sin_and_cos(state.poses[:, 2])
    moved = np.column_stack((c * drawn[:, 0] - s * drawn[:, 1], s * drawn[:, 0] + c * drawn[:, 1]))
    poses = state.poses + np.column_stack((moved, drawn[:, 2]))
    state = _make_room(replace(state, poses=poses), len(step.ids))
    state = rows_of(state, np.arange(len(poses)))  # copies, which are changed in place
    free, took = np.ones(state.seen.shape, np.bool_), [state.took]
    for r, b in zip(step.ranges.tolist(), step.bearings.tolist(), strict=True):
        took.append(_assign(state, free, r, b, step.sensor)[:, None])
    state = replace(state, logs=state.logs - state.logs.max(), took=np.hstack(took))
    return _resample(state, generator)


def _assign(
    state: FastSlamMl, free: Bool[np.ndarray, "M C"], r: float, b: float, sensor: Sensor
) -> Int64[np.ndarray, " M"]:
    """Assign a detection in each particle, in place, to its likeliest free or a new landmark."""
    x, y, heading = state.poses.T
    particles = np.arange(len(x))
    dx, dy = state.means[..., 0] - x[:, None], state.means[..., 1] - y[:, None]
    q = np.maximum(dx * dx + dy * dy, 1e-12)
    range_ = np.sqrt(q)
    H = np.stack((np.stack((dx / range_, dy / range_), -1), np.stack((-dy / q, dx / q), -1)), -2)
    R = np.diag(
        [
            core.squared(sensor.range_sigma) + core.squared(sensor.range_sigma_per_m * r),
            core.squared(sensor.bearing_sigma),
        ]
    )
    S = dense.product(dense.product(H, state.covariances), H.transpose(0, 1, 3, 2)) + R
    turned = b - core.atan2(dy, dx) + heading[:, None]
    off = np.stack((r - range_, np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi), -1)
    determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    squared = (
        S[..., 1, 1] * core.squared(off[..., 0])
        - 2.0 * S[..., 0, 1] * off[..., 0] * off[..., 1]
        + S[..., 0, 0] * core.squared(off[..., 1])
    ) / determinant
    likely = -0.5 * squared - 0.5 * core.log(determinant) - core.log(2.0 * np.pi)
    used = np.arange(state.means.shape[1]) < state.counts[:, None]
    likely = np.where(used & free & (squared < GATE), likely, -np.inf)
    best = likely.argmax(axis=1)
    edge = -0.5 * GATE - 0.5 * core.log(np.linalg.det(R)) - core.log(2.0 * np.pi)
    old = likely[particles, best] > edge
    state.logs[:] += np.where(old, likely[particles, best], edge)
    place = np.where(old, best, state.counts)
    _update(state, particles[old], best[old], H, S, off)
    _add(state, particles[~old], place[~old], (r, b), R)
    free[particles, place] = False
    state.seen[particles, place] += 1
    return place


def _update(
    state: FastSlamMl,
    at: Int64[np.ndarray, " k"],
    place: Int64[np.ndarray, " k"],
    H: Float[np.ndarray, "M C 2 2"],
    S: Float[np.ndarray, "M C 2 2"],
    off: Float[np.ndarray, "M C 2"],
) -> None:
    P, J = state.covariances[at, place], H[at, place]
    gain = dense.solve(S[at, place], dense.product(J, P)).transpose(0, 2, 1)
    state.means[at, place] += np.einsum("kij,kj->ki", gain, off[at, place])
    after = P - dense.product(dense.product(gain, J), P)
    state.covariances[at, place] = 0.5 * (after + after.transpose(0, 2, 1))


def _add(
    state: FastSlamMl,
    at: Int64[np.ndarray, " k"],
    place: Int64[np.ndarray, " k"],
    measured: tuple[float, float],
    R: Float[np.ndarray, "2 2"],
) -> None:
    r, b = measured
    x, y, heading = state.poses[at].T
    s, c = core.sin_and_cos(heading + b)
    G = np.stack((np.stack((c, -r * s), -1), np.stack((s, r * c), -1)), -2)
    state.means[at, place] = np.column_stack((x + r * c, y + r * s))
    state.covariances[at, place] = dense.product(dense.product(G, R), G.transpose(0, 2, 1))
    state.counts[at] += 1


def _make_room(state: FastSlamMl, more: int) -> FastSlamMl:
    places = state.means.shape[1]
    if int(state.counts.max()) + more <= places:
        return state
    wider = max(2 * places, int(state.counts.max()) + more) - places
    return replace(
        state,
        means=np.pad(state.means, ((0, 0), (0, wider), (0, 0))),
        covariances=np.pad(state.covariances, ((0, 0), (0, wider), (0, 0), (0, 0))),
        seen=np.pad(state.seen, ((0, 0), (0, wider))),
    )


def _weights(state: FastSlamMl) -> Float[np.ndarray, " M"]:
    weights = core.exp(state.logs - state.logs.max())
    return np.asarray(weights / weights.sum())


def _resample(state: FastSlamMl, generator: np.random.Generator) -> FastSlamMl:
    weights, m = _weights(state), len(state.poses)
    if 1.0 / float(dense.product(weights, weights)) >= state.resample_below * m:
        return state
    at = (np.arange(m) + generator.random()) / m
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), at), m - 1)
    return replace(rows_of(state, chosen), logs=np.zeros(m))


def slots_of_detections(state: FastSlamMl) -> Int64[np.ndarray, " N"]:
    """Landmark of each detection in the heaviest particle."""
    numbers: Int64[np.ndarray, " N"] = UNNAMED + state.took[int(np.argmax(state.logs))]
    return numbers


def pose_gaussian(state: FastSlamMl) -> PoseGaussian:
    """Moments of all particles."""
    weights = _weights(state)
    heading = float(mean_direction(state.poses[:, 2], weights))
    mean = np.append(dense.product(weights, state.poses[:, :2]), heading)
    off = state.poses - mean
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return PoseGaussian(mean, dense.product((off * weights[:, None]).T, off))


def landmark_gaussian(state: FastSlamMl) -> LandmarkGaussian:
    """Map of the heaviest particle."""
    best = int(np.argmax(state.logs))
    count = int(state.counts[best])
    if not count:
        return NO_LANDMARKS
    joint = np.zeros((2 * count, 2 * count))
    for i in range(count):
        joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = state.covariances[best, i]
    ids = (UNNAMED + np.arange(count)).astype(np.uint32)
    return LandmarkGaussian(ids, state.means[best, :count], joint)
