"""Map joining as in Downs' thesis: least squares with spherical covariances, frames tied by SVD.

argmin Σ (X̂ − H(X))ᵀ P⁻¹ (X̂ − H(X)) over submaps (eq. 4.1) with P the identity: a radian counts as
a metre. Robots that measure each other exchange maps (sections 3.2 and 4.3, appendix II).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.core import located
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian, information
from teamslam.team.estimation.map_joining import joining
from teamslam.team.estimation.map_joining.alignment import procrustes
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, joint_marginal
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold
from teamslam.team.estimation.se2 import Pose, wrapped
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float, Int64

Weighting = Literal["identity", "spherical", "full"]
SETTINGS = JoinSettings()
NEEDED = 2


class TooFewPointsError(ValueError):
    """Two maps share too few points for a relative pose."""

    def __init__(self, points: int) -> None:
        plural = "" if points == 1 else "s"
        super().__init__(f"{points} common point{plural} of two maps, {NEEDED} needed")
        self.points = points


def reweight(local: LocalMap, weighting: Weighting) -> LocalMap:
    """Replace a submap's covariance.

    "identity": I. "spherical": half the trace of each block times I. "full": unchanged.
    """
    if weighting == "full":
        return local
    if weighting == "identity":
        return replace(local, covariance=np.eye(len(local.mean)))
    variances = np.diag(local.covariance).copy()
    behind = len(variances) - 2 * len(local.ids)
    poses, landmarks = variances[:behind].reshape(-1, 3), variances[behind:].reshape(-1, 2)
    poses[:, :2] = poses[:, :2].mean(axis=1, keepdims=True)
    landmarks[:] = landmarks.mean(axis=1, keepdims=True)
    return replace(local, covariance=np.diag(variances))


@dataclass(frozen=True, eq=False)
class SubmapJoining:
    """Submaps of robots with known starts, and their least-squares map."""

    fold: Fold
    weighting: Weighting


def initial_state(poses: Mapping[str, Pose], weighting: Weighting = "identity") -> SubmapJoining:
    """Begin without submaps; start poses are exact."""
    fold = EMPTY_FOLD
    for robot, pose in poses.items():
        fold = joining.add_start(fold, InitialPoseFactor(robot, 0, pose))
    return SubmapJoining(fold, weighting)


def filter_step(state: SubmapJoining, robot: str, local: LocalMap) -> SubmapJoining:
    """Add a robot's next submap and iterate."""
    count = len(state.fold.contributions)
    sequence = state.fold.next_sequence((robot, 0))
    taken = Contribution(robot, 0, sequence, count, reweight(local, state.weighting))
    return replace(state, fold=joining.fold_submaps(state.fold, [taken], SETTINGS))


def solve(state: SubmapJoining) -> SubmapJoining:
    """The full least-squares solution."""
    return replace(state, fold=joining.solve_fold(state.fold, SETTINGS))


def _variance_factor(state: SubmapJoining) -> float:
    """Variance factor σ̂².

    With the identity Σ‖r‖²/(residuals − unknowns), 1 without redundancy; else 1.
    """
    island = state.fold.main
    redundancy = int(island.graph.dimensions.sum()) - island.graph.unknowns
    if state.weighting != "identity" or redundancy <= 0:
        return 1.0
    return island.cost / redundancy


def landmark_gaussian(state: SubmapJoining) -> LandmarkGaussian:
    """All landmarks: σ̂² (JᵀP⁻¹J)⁻¹."""
    landmarks = state.fold.main.graph.landmarks
    ids = sorted(landmarks)
    mean, covariance = joint_marginal(state.fold.main, [landmarks[id_] for id_ in ids])
    factor = _variance_factor(state)
    return LandmarkGaussian(np.array(ids, np.uint32), mean.reshape(-1, 2), factor * covariance)


class PointPairs(NamedTuple):
    """The same points in the frames of two maps [m]."""

    in_a: Float[np.ndarray, "n 2"]
    in_b: Float[np.ndarray, "n 2"]


NO_PAIRS = PointPairs(np.empty((0, 2)), np.empty((0, 2)))


class _ExchangedMap(NamedTuple):
    """Union of two maps, and the second's pose in the first."""

    landmarks: LandmarkGaussian
    a_from_b: PoseGaussian


def mutual_sighting(
    pose_a: Pose,
    range_to_b: float,
    bearing_to_b: float,
    pose_b: Pose,
    range_to_a: float,
    bearing_to_a: float,
) -> PointPairs:
    """Positions of two robots in both maps (Downs, chapter 3)."""
    return PointPairs(
        np.stack((pose_a[:2], located(pose_a, range_to_b, bearing_to_b))),
        np.stack((located(pose_b, range_to_a, bearing_to_a), pose_b[:2])),
    )


def exchange_maps(
    a: LandmarkGaussian, b: LandmarkGaussian, robots: PointPairs = NO_PAIRS
) -> _ExchangedMap:
    """Join two maps in the frame of a, by common landmarks and the robots' positions.

    argmin Σ ‖aᵢ − xᵢ‖² + Σ ‖R bᵢ + t − xᵢ‖² over x and (R, t): (R, t) is by `procrustes`. With n
    common points and G = ∂(R b + t)/∂(t, θ), Σ_T = 2 σ̂² (Σ GᵢᵀGᵢ)⁻¹ and the landmarks have σ̂² D +
    E Σ_T Eᵀ: D = 1, E = 0 of a alone, 1 and G of b alone, 1/2 and G/2 common; σ̂² = cost/(2n − 3).
    The maps' covariances are discarded. Raises TooFewPointsError.
    """
    ids = np.union1d(a.ids, b.ids)
    of_a, of_b = np.searchsorted(ids, a.ids), np.searchsorted(ids, b.ids)
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    tie_a = np.concatenate((a.means[in_a], robots.in_a))
    tie_b = np.concatenate((b.means[in_b], robots.in_b))
    n = len(tie_a)
    if n < NEEDED:
        raise TooFewPointsError(n)
    a_from_b = procrustes(tie_a, tie_b, np.ones(n))
    moved, G = _move(a_from_b, tie_b)
    variance = 0.5 * float((core.squared(tie_a - moved)).sum()) / (2 * n - 3)
    of_motion = 2.0 * variance * information(dense.product(G.T, G), "two maps' points")
    common = np.isin(ids, a.ids) & np.isin(ids, b.ids)
    from_b = np.where(common, 0.5, np.isin(ids, b.ids))
    in_frame_a, slopes = np.zeros((len(ids), 2)), np.zeros((2 * len(ids), 3))
    rows = columns_of(of_b)
    in_frame_a[of_b], slopes[rows] = _move(a_from_b, b.means)
    means = from_b[:, None] * in_frame_a
    means[of_a] += (1.0 - from_b[of_a])[:, None] * a.means
    E = np.repeat(from_b, 2)[:, None] * slopes
    own = variance * np.where(common, 0.5, 1.0)
    covariance = np.diag(np.repeat(own, 2)) + dense.product(dense.product(E, of_motion), E.T)
    return _ExchangedMap(
        LandmarkGaussian(ids, means, 0.5 * (covariance + covariance.T)),
        PoseGaussian(a_from_b, of_motion),
    )


def _move(
    a_from_b: Pose, points: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 3"]]:
    """R b + t and its derivative by (t, θ): [I, R b rotated by 90°]."""
    s, c = core.sin_and_cos(a_from_b[2])
    turned = dense.product(points, np.array([[c, s], [-s, c]]))
    G = np.zeros((2 * len(points), 3))
    G[0::2, 0] = G[1::2, 1] = 1.0
    G[0::2, 2], G[1::2, 2] = -turned[:, 1], turned[:, 0]
    return turned + a_from_b[:2], G


ITERATIONS = 10  # most Gauss-Newton steps of two maps' joint solution
STANDS_STILL = 1e-9  # largest change of a coordinate [m, rad] in the last step


def exchange_maps_fully(a: LandmarkGaussian, b: LandmarkGaussian) -> _ExchangedMap:
    """Join two maps in the frame of a, with their covariances.

    argmin ‖x_a − a‖² in A⁻¹ + ‖Rᵀ(x_b − t) − b‖² in B⁻¹ over x and (t, θ); covariance (JᵀWJ)⁻¹.
    Raises TooFewPointsError, NotACovarianceError.
    """
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(in_a) < NEEDED:
        raise TooFewPointsError(len(in_a))
    ids = np.union1d(a.ids, b.ids)
    columns_a, columns_b = (3 + columns_of(np.searchsorted(ids, each.ids)) for each in (a, b))
    a_from_b = procrustes(a.means[in_a], b.means[in_b], np.ones(len(in_a)))
    state = np.zeros(3 + 2 * len(ids))
    state[:3] = a_from_b
    state[columns_b] = _move(a_from_b, b.means)[0].ravel()
    state[columns_a] = a.means.ravel()
    of_a, of_b = information(a.covariance, "a map"), information(b.covariance, "a map")
    for _ in range(ITERATIONS):
        residual, J = _express_from(state, columns_b)
        residual -= b.means.ravel()
        hessian = dense.product(dense.product(J.T, of_b), J)
        hessian[np.ix_(columns_a, columns_a)] += of_a
        gradient = dense.product(J.T, dense.product(of_b, residual))
        gradient[columns_a] += dense.product(of_a, state[columns_a] - a.means.ravel())
        covariance = information(hessian, "two maps' joint solution")
        step = dense.product(covariance, gradient)
        state -= step
        state[2] = wrapped(state[2])
        if np.abs(step).max() < STANDS_STILL:
            break
    return _ExchangedMap(
        LandmarkGaussian(ids, state[3:].reshape(-1, 2), covariance[3:, 3:]),
        PoseGaussian(state[:3], covariance[:3, :3]),
    )


def columns_of(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    """Columns (x, y) of these landmarks in a joint covariance."""
    return (2 * index[:, None] + np.arange(2)).ravel()


def _express_from(
    state: Float[np.ndarray, " n"], columns: Int64[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """Rᵀ(x − t) of the points in these columns, and its derivative by (t, θ, x)."""
    s, c = core.sin_and_cos(state[2])
    back = np.array([[c, s], [-s, c]])
    offsets = state[columns].reshape(-1, 2) - state[:2]
    seen = dense.product(offsets, back.T)
    J = np.zeros((len(columns), len(state)))
    J[0::2, :2], J[1::2, :2] = -back[0], -back[1]
    J[0::2, 2], J[1::2, 2] = seen[:, 1], -seen[:, 0]
    for k in range(len(offsets)):
        J[2 * k : 2 * k + 2, columns[2 * k : 2 * k + 2]] = back
    return seen.ravel(), J
