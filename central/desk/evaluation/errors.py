"""Errors against the truth: distances, headings, NEES, alignment."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from teamslam.team.estimation.consistency import chi2_interval, coverage, nees
from teamslam.team.estimation.gaussian import cholesky_factor
from teamslam.team.estimation.map_joining.alignment import NEEDED, procrustes
from teamslam.team.estimation.se2 import Pose, between
from teamslam.team.shapes import Bool, Float, Int64

Points = Float[np.ndarray, "n 2"]  # (x [m], y [m])
Poses = Float[np.ndarray, "K 3"]  # (x [m], y [m], theta [rad])
PoseCovariances = Float[np.ndarray, "K 3 3"]
Covariance = Float[np.ndarray, "m m"]  # of points, (x0, y0, x1, y1, …) [m²]
Stamps = Int64[np.ndarray, " K"]
TRUTH_GAP_NS = 1_000_000_000  # largest gap between truth samples that is interpolated
BAND = 0.95


@dataclass(frozen=True)
class Path:
    """Poses (x [m], y [m], theta [rad]) by ascending stamp."""

    stamps_ns: Stamps
    poses: Poses


def join_batches(batches: Sequence[Path]) -> Path:
    """Join batches by stamp; the first of equal stamps counts."""
    if not batches:
        return Path(np.zeros(0, np.int64), np.zeros((0, 3)))
    stamps = np.concatenate([batch.stamps_ns for batch in batches])
    stamps, first = np.unique(stamps, return_index=True)
    return Path(stamps, np.concatenate([batch.poses for batch in batches])[first])


SMALL_TURN = 1e-6  # below this [rad], (δ/2) cot(δ/2) is 1 to the last bit


@dataclass(frozen=True)
class PoseErrors:
    """Estimate − truth of the K poses with truth, (x [m], y [m], theta [rad]).

    nees: eᵀ P⁻¹ e with 3 degrees of freedom. motion_nees: of the motion from estimate to truth.
    """

    stamps_ns: Stamps
    errors: Poses
    sigmas: Poses
    nees: Float[np.ndarray, " K"]
    motion_nees: Float[np.ndarray, " K"]

    @property
    def position_rmse_m(self) -> float:
        """RMS position error [m]."""
        return rms(np.hypot(self.errors[:, 0], self.errors[:, 1]))

    @property
    def heading_rmse_rad(self) -> float:
        """RMS heading error [rad]."""
        return rms(self.errors[:, 2])

    @property
    def nees_per_dof(self) -> float:
        """Mean NEES/3; 1 if the covariances are right."""
        return float(self.nees.mean()) / 3.0

    @property
    def coverage(self) -> float:
        """Share of poses within their 95 % ellipsoid."""
        return coverage(self.nees, np.full(len(self.nees), 3.0), BAND)


@dataclass(frozen=True, kw_only=True)
class MapErrors:
    """Map errors against the true positions of the same landmarks.

    aligned_rmse_m: after the rigid motion truth_from_map; all others unaligned. nees_per_dof:
    joint, 2L degrees of freedom; `band`: its 95 % interval for one run. coverage: share of
    landmarks in their 95 % ellipse.
    """

    count: int
    rmse_m: float
    aligned_rmse_m: float | None
    truth_from_map: Pose | None
    nees_per_dof: float
    band: tuple[float, float]
    shape: "ShapeErrors | None"
    coverage: float

    @property
    def in_band(self) -> bool:
        """Whether the NEES lies in its band."""
        return self.band[0] <= self.nees_per_dof <= self.band[1]

    @property
    def band_text(self) -> str:
        """The band as text."""
        return f"{self.band[0]:.2f}…{self.band[1]:.2f}"


@dataclass(frozen=True)
class ShapeErrors:
    """Map errors without their rigid part, with that part's covariance removed.

    nees_per_landmark: NEES of the 2L − 3 degrees of freedom, scaled to an expectation of 2.
    """

    nees_per_landmark: float
    coverage: float


def rms(values: Float[np.ndarray, " n"]) -> float:
    """√(mean of squares)."""
    return float(np.sqrt(np.mean(values * values)))


def on_circle(angles: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Wrap angles to (−π, π]."""
    turns: Float[np.ndarray, "*n"] = np.floor((np.pi - angles) / (2.0 * np.pi))
    return angles + 2.0 * np.pi * turns


def map_errors(means: Points, covariance: Covariance, truth: Points) -> MapErrors:
    """Errors of L ≥ 1 landmarks with 2L × 2L covariance."""
    count = len(means)
    difference = means - truth
    motion = rigid_alignment(truth, means)
    return MapErrors(
        count=count,
        rmse_m=distance_rmse(means, truth),
        aligned_rmse_m=moved_rmse(motion, means, truth),
        truth_from_map=motion,
        nees_per_dof=nees(difference.ravel(), covariance) / (2 * count),
        band=chi2_interval(2 * count, BAND, 1),
        shape=None if motion is None else _shape_errors(means, covariance, truth, motion),
        coverage=_covered(difference, covariance),
    )


def _shape_errors(
    means: Points, covariance: Covariance, truth: Points, truth_from_map: Pose
) -> ShapeErrors:
    """With G = ∂(positions)/∂(x, y, θ), NEES = min_g (e − G g)ᵀ P⁻¹ (e − G g).

    The covariance of the remaining error is Π P Π with Π = I − G (GᵀG)⁻¹ Gᵀ.
    """
    count = len(means)
    error = (means - transform_points(between(truth_from_map, np.zeros(3)), truth)).ravel()
    centred = means - means.mean(axis=0)
    G = np.zeros((2 * count, 3))
    G[0::2, 0] = G[1::2, 1] = 1.0
    G[0::2, 2], G[1::2, 2] = -centred[:, 1], centred[:, 0]
    L = cholesky_factor(covariance, "a map")
    white_error, white_G = (np.linalg.solve(L, part) for part in (error, G))
    left = white_error - white_G @ np.linalg.lstsq(white_G, white_error)[0]
    basis = np.linalg.qr(G)[0]
    projection = np.eye(2 * count) - basis @ basis.T
    return ShapeErrors(
        2.0 * float(left @ left) / (2 * count - 3),
        _covered((projection @ error).reshape(-1, 2), projection @ covariance @ projection),
    )


def _covered(errors: Points, covariance: Covariance) -> float:
    count = len(errors)
    blocks = covariance.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count), :]
    # Two landmarks have a one-dimensional shape, so their blocks are singular.
    inverses = np.linalg.pinv(blocks, hermitian=True)
    squared = np.einsum("ki,kij,kj->k", errors, inverses, errors)
    return coverage(squared, np.linalg.matrix_rank(blocks, hermitian=True).astype(float), BAND)


def rigid_alignment(truth: Points, points: Points) -> Pose | None:
    """truth_from_points by least squares (Umeyama 1991); None below two points."""
    if len(points) < NEEDED or np.ptp(points, axis=0).max() == 0.0:
        return None
    return procrustes(truth, points, np.ones(len(points)))


def transform_points(a_from_b: Pose, points: Points) -> Points:
    """Transform points from frame b to a."""
    c, s = np.cos(a_from_b[2]), np.sin(a_from_b[2])
    turned: Points = points @ np.array([[c, s], [-s, c]])
    turned += a_from_b[:2]
    return turned


def distance_rmse(a: Points, b: Points) -> float:
    """RMS distance between corresponding rows [m]."""
    difference = a - b
    return rms(np.hypot(difference[:, 0], difference[:, 1]))


def moved_rmse(
    motion: Pose | None, points: Float[np.ndarray, "n k"], truth: Float[np.ndarray, "n k"]
) -> float | None:
    """RMS distance [m] of the first two columns after a motion, if there is one, and points."""
    if motion is None or not len(points):
        return None
    return distance_rmse(transform_points(motion, points[:, :2]), truth[:, :2])


def interpolate_truth(truth: Path, stamps_ns: Stamps) -> tuple[Poses, Bool[np.ndarray, " K"]]:
    """Interpolate the true poses at the stamps; return poses and a mask of known rows.

    Headings by the shorter arc; unknown outside the truth and in gaps above TRUTH_GAP_NS.
    """
    poses = np.zeros((len(stamps_ns), 3))
    if not len(truth.stamps_ns):
        return poses, np.zeros(len(stamps_ns), dtype=bool)
    last = len(truth.stamps_ns) - 1
    after = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns, side="left"), 0, last)
    before = np.maximum(after - 1, 0)
    exact = truth.stamps_ns[after] == stamps_ns
    gap_ns = truth.stamps_ns[after] - truth.stamps_ns[before]
    inside = (stamps_ns >= truth.stamps_ns[before]) & (stamps_ns <= truth.stamps_ns[after])
    known: Bool[np.ndarray, " K"] = exact | (inside & (gap_ns <= TRUTH_GAP_NS))
    elapsed_ns = stamps_ns - truth.stamps_ns[before]
    share = np.where(exact, 1.0, elapsed_ns / np.maximum(gap_ns, 1))
    step = truth.poses[after] - truth.poses[before]
    step[:, 2] = on_circle(step[:, 2])
    poses[known] = (truth.poses[before] + share[:, np.newaxis] * step)[known]
    poses[:, 2] = on_circle(poses[:, 2])
    return poses, known


def pose_errors(path: Path, covariances: PoseCovariances, truth: Path) -> PoseErrors | None:
    """Errors of the poses with truth; None without any."""
    true_poses, known = interpolate_truth(truth, path.stamps_ns)
    if not known.any():
        return None
    errors = path.poses[known] - true_poses[known]
    errors[:, 2] = on_circle(errors[:, 2])
    P = covariances[known]
    whitened = np.linalg.solve(np.linalg.cholesky(P), errors[:, :, np.newaxis])[:, :, 0]
    return PoseErrors(
        path.stamps_ns[known],
        errors,
        np.sqrt(np.diagonal(P, axis1=1, axis2=2)),
        np.einsum("ki,ki->k", whitened, whitened),
        _motion_nees(path.poses[known], true_poses[known], P),
    )


def _motion_nees(poses: Poses, truth: Poses, P: PoseCovariances) -> Float[np.ndarray, " K"]:
    """ξᵀ (A P Aᵀ)⁻¹ ξ with truth = Exp(ξ) ∘ pose, which allows for rotation about a far point.

    ξ = (V⁻¹ (p' − R p), δ) with V of the SE(2) exponential; A = [1 0 y; 0 1 −x; 0 0 1].
    """
    turn = on_circle(truth[:, 2] - poses[:, 2])
    p = poses[:, 0] + 1j * poses[:, 1]
    shift = truth[:, 0] + 1j * truth[:, 1] - np.exp(1j * turn) * p
    half = 0.5 * np.where(np.abs(turn) < SMALL_TURN, SMALL_TURN, turn)
    shift = shift * (half / np.tan(half) - 0.5j * turn)
    xi = np.column_stack([shift.real, shift.imag, turn])
    A = np.tile(np.eye(3), (len(poses), 1, 1))
    A[:, 0, 2], A[:, 1, 2] = poses[:, 1], -poses[:, 0]
    solved = np.linalg.solve(A @ P @ A.transpose(0, 2, 1), xi[:, :, np.newaxis])[:, :, 0]
    squared: Float[np.ndarray, " K"] = np.einsum("ki,ki->k", xi, solved)
    return squared


@dataclass(frozen=True)
class TrajectoryErrors:
    """RMS over poses with truth [m], [rad]; alignment without scale.

    ape: absolute (evo: -r trans_part, angle_rad); aligned: after the best position alignment (-a).
    rpe: motion between consecutive poses (--delta 1 --delta_unit f).
    """

    poses: int
    ape_m: float
    ape_rad: float
    ape_aligned_m: float | None
    ape_aligned_rad: float | None
    rpe_m: float | None
    rpe_rad: float | None


def associate_truth(path: Path, truth: Path) -> tuple[Path, Path]:
    """Poses with truth, and the true poses there."""
    poses, known = interpolate_truth(truth, path.stamps_ns)
    stamps = path.stamps_ns[known]
    return Path(stamps, path.poses[known]), Path(stamps, poses[known])


def align_paths(paths: Iterable[tuple[Path, Path]]) -> Pose | None:
    """truth_from_map that aligns paths with the true ones; None below two places."""
    pairs = [associate_truth(*pair) for pair in paths]
    places, true = (
        np.concatenate([np.empty((0, 2)), *(pair[k].poses[:, :2] for pair in pairs)])
        for k in (0, 1)
    )
    return rigid_alignment(true, places)


def trajectory_errors(path: Path, truth: Path) -> TrajectoryErrors | None:
    """Errors of a path; None without truth."""
    estimate, true = (each.poses for each in associate_truth(path, truth))
    if not len(estimate):
        return None
    turned = on_circle(estimate[:, 2] - true[:, 2])
    motion = rigid_alignment(true[:, :2], estimate[:, :2])
    relative = _relative(_relative(true[:-1], true[1:]), _relative(estimate[:-1], estimate[1:]))
    return TrajectoryErrors(
        len(estimate),
        distance_rmse(estimate[:, :2], true[:, :2]),
        rms(turned),
        moved_rmse(motion, estimate, true),
        None if motion is None else rms(on_circle(turned + motion[2])),
        rms(np.hypot(relative[:, 0], relative[:, 1])) if len(relative) else None,
        rms(relative[:, 2]) if len(relative) else None,
    )


def _relative(a: Poses, b: Poses) -> Poses:
    dx, dy = (b[:, :2] - a[:, :2]).T
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack((c * dx + s * dy, c * dy - s * dx, on_circle(b[:, 2] - a[:, 2])))
