"""Align two maps by their common points.

Weighted Procrustes alignment (Arun, Huang & Blostein 1987) gives the first guess; Gauss-Newton
refines it in the metric of both joint covariances. The joint cost, which is not linearised about a
drifted map, tests the agreement.
"""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.gaussian import deviation, information
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float

ITERATIONS = 10
NEEDED = 2  # number of points that determine a rigid motion in the plane


class Alignment(NamedTuple):
    """Rigid motion a_from_b (x [m], y [m], theta [rad]) with covariance, and the χ² of its
    residuals.

    dof: of `chi2`, 2 per landmark less 3. heading_sigma: standard deviation [rad] of the heading
    from the shape of the landmarks alone, without the rotation of each map as a whole: √(tr(Π S
    Π)/dof / Σ‖bᵢ − b̄‖²), with the covariance S of the difference and the projection Π off the
    rigid motions.
    """

    a_from_b: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    chi2: float
    dof: int
    heading_sigma: float


def procrustes(
    in_a: Float[np.ndarray, "n 2"], in_b: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3"]:
    """a_from_b = argmin Σ wᵢ ‖aᵢ − (R bᵢ + t)‖² over rotations R and translations t.

    R turns by the direction of (Σ wᵢ (bᵢ − b̄)·(aᵢ − ā), Σ wᵢ (bᵢ − b̄) × (aᵢ − ā)).
    """
    share = weights / weights.sum()
    mean_a, mean_b = dense.product(share, in_a), dense.product(share, in_b)
    spread = dense.product(((in_b - mean_b) * share[:, None]).T, in_a - mean_a)
    turn = core.atan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1])
    s, c = core.sin_and_cos(turn)
    x, y = c * mean_b[0] - s * mean_b[1], s * mean_b[0] + c * mean_b[1]
    return np.array([mean_a[0] - x, mean_a[1] - y, turn])


def align(
    in_a: Float[np.ndarray, "n 2"],
    covariance_a: Float[np.ndarray, "m m"],
    in_b: Float[np.ndarray, "n 2"],
    covariance_b: Float[np.ndarray, "m m"],
) -> Alignment:
    """Estimate the most likely a_from_b of two independent Gaussian maps of the same n ≥ 2
    landmarks.

    Minimises dᵀ(P_a + R P_b Rᵀ)⁻¹d, d = a − (R b + t), about the centroids, with the metric of each
    iterate. If the points coincide, the heading is 0 and `heading_sigma` infinite. Raises
    NotACovarianceError.
    """
    n = len(in_a)
    variances = np.diag(covariance_a) + np.diag(covariance_b)
    of_a, of_b = in_a.mean(axis=0), in_b.mean(axis=0)
    near_a, near_b = in_a - of_a, in_b - of_b
    if not near_b.any():
        return _at_one_place(of_a - of_b, n)
    about = procrustes(near_a, near_b, 1.0 / variances.reshape(n, 2).sum(axis=1))
    for _ in range(ITERATIONS):
        residual, metric, jacobian = _linearise(about, near_a, covariance_a, near_b, covariance_b)
        spread = information(
            dense.product(dense.product(jacobian.T, metric), jacobian), "an alignment"
        )
        about = about + dense.product(
            spread, dense.product(jacobian.T, dense.product(metric, residual))
        )
        about[2] = wrapped(about[2])
    residual, metric, jacobian = _linearise(about, near_a, covariance_a, near_b, covariance_b)
    spread = information(dense.product(dense.product(jacobian.T, metric), jacobian), "an alignment")
    chi2 = float(dense.product(dense.product(residual, metric), residual))
    difference = information(metric, "the metric of an alignment")
    sigma = _shape_heading_sigma(near_b, jacobian, difference)
    s, c = core.sin_and_cos(about[2])
    x, y = c * of_b[0] - s * of_b[1], s * of_b[0] + c * of_b[1]
    a_from_b = np.array([of_a[0] + about[0] - x, of_a[1] + about[1] - y, about[2]])
    lever = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
    return Alignment(
        a_from_b, dense.product(dense.product(lever, spread), lever.T), chi2, 2 * n - 3, sigma
    )


def _at_one_place(shift: Float[np.ndarray, "2"], n: int) -> Alignment:
    unknown = np.full((3, 3), np.inf)
    return Alignment(np.array([*shift, 0.0]), unknown, np.inf, 2 * n - 3, np.inf)


def fit_at_heading(
    in_a: Float[np.ndarray, "n 2"],
    covariance_a: Float[np.ndarray, "m m"],
    in_b: Float[np.ndarray, "n 2"],
    covariance_b: Float[np.ndarray, "m m"],
    heading: float,
) -> tuple[Float[np.ndarray, "2"], float]:
    """Fit the translation [m] of a_from_b at a given heading; return it with its χ²."""
    pose = np.array([0.0, 0.0, heading])
    residual, metric, jacobian = _linearise(pose, in_a, covariance_a, in_b, covariance_b)
    J = jacobian[:, :2]
    shift = dense.solve(
        dense.product(dense.product(J.T, metric), J),
        dense.product(J.T, dense.product(metric, residual)),
    )
    left = residual - dense.product(J, shift)
    return shift, float(dense.product(dense.product(left, metric), left))


def _shape_heading_sigma(
    in_b: Float[np.ndarray, "n 2"],
    jacobian: Float[np.ndarray, "m 3"],
    covariance: Float[np.ndarray, "m m"],
) -> float:
    squares = dense.product(jacobian.T, jacobian)
    shape = np.eye(len(jacobian)) - dense.product(jacobian, dense.solve(squares, jacobian.T))
    variance = np.trace(dense.product(dense.product(shape, covariance), shape)) / (
        len(jacobian) - 3
    )
    extent = float((core.squared(in_b - in_b.mean(axis=0))).sum())
    return deviation(variance / extent)


def _linearise(
    a_from_b: Float[np.ndarray, "3"],
    in_a: Float[np.ndarray, "n 2"],
    covariance_a: Float[np.ndarray, "m m"],
    in_b: Float[np.ndarray, "n 2"],
    covariance_b: Float[np.ndarray, "m m"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"], Float[np.ndarray, "m 3"]]:
    """Return the differences d, (P_a + R P_b Rᵀ)⁻¹ and ∂(R b + t)/∂(t, θ)."""
    n = len(in_a)
    s, c = core.sin_and_cos(a_from_b[2])
    rotation = np.array([[c, -s], [s, c]])
    turned = dense.product(in_b, rotation.T)
    all_turned = np.kron(np.eye(n), rotation)
    metric = information(
        covariance_a + dense.product(dense.product(all_turned, covariance_b), all_turned.T),
        "the shared landmarks of two maps",
    )
    jacobian = np.zeros((2 * n, 3))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
    jacobian[0::2, 2], jacobian[1::2, 2] = -turned[:, 1], turned[:, 0]
    return (in_a - turned - a_from_b[:2]).ravel(), metric, jacobian


class SharedPoints(NamedTuple):
    """Numbers of shared landmarks and of teammates observed from either map."""

    landmarks: int
    sightings: int = 0

    def __str__(self) -> str:
        words = f"{self.landmarks} shared landmark{'' if self.landmarks == 1 else 's'}"
        if self.sightings:
            words += f" and {self.sightings} sighting{'' if self.sightings == 1 else 's'}"
        return words


def refusal(shared: SharedPoints, alignment: Alignment | None, heading_sigma: float) -> str | None:
    """Return why the shared points cannot place one map in the other, or None."""
    if alignment is None:
        return f"{shared}, {NEEDED} needed"
    if alignment.heading_sigma == np.inf:
        return f"{shared} at one place, which gives no heading"
    if alignment.heading_sigma > heading_sigma:
        return (
            f"{shared} too close together for their uncertainty: "
            f"heading to {alignment.heading_sigma:.2f} rad, {heading_sigma:.2f} needed"
        )
    return None


def disagreement(shared: SharedPoints, chi2: float, confidence: float) -> str | None:
    """Return why two maps with these shared points cannot be of one place, or None.

    chi2: rise of the joint cost, with 2 degrees of freedom per point less 3. confidence: quantile
    above which the maps disagree.
    """
    limit = chi2_limit(2 * sum(shared) - 3, 1.0 - confidence)
    if chi2 > limit:
        return f"{shared} disagree: chi² {chi2:.1f} exceeds {limit:.1f} ({100.0 * confidence:g} %)"
    return None
