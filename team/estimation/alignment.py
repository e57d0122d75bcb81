"""Where one map lies in the frame of another, from the landmarks that both know.

Weighted Procrustes by singular values gives the first guess (Downs' thesis on map joining; Arun,
Huang & Blostein 1987), Gauss-Newton in the metric of both joint covariances the rest; the χ² of
what is left says whether the two maps agree.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from team.estimation.gaussian import information
from team.estimation.geometry import wrapped

ITERATIONS = 10
NEEDED = 2
"""Landmarks that determine a rigid motion in the plane."""


class Alignment(NamedTuple):
    """a_from_b (x [m], y [m], theta [rad]) with its covariance, and χ² of the landmarks left over.

    dof: 2 per shared landmark less the 3 of the motion.
    """

    a_from_b: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    chi2: float
    dof: int


def procrustes(
    in_a: Float[np.ndarray, "n 2"], in_b: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3"]:
    """a_from_b = argmin Σ wᵢ ‖aᵢ − (R bᵢ + t)‖² over proper rotations R and translations t.

    With U S Vᵀ = Σ wᵢ (bᵢ − b̄)(aᵢ − ā)ᵀ: R = V diag(1, det VUᵀ) Uᵀ, t = ā − R b̄.
    """
    share = weights / weights.sum()
    mean_a, mean_b = share @ in_a, share @ in_b
    u, _, vt = np.linalg.svd(((in_b - mean_b) * share[:, None]).T @ (in_a - mean_a))
    proper = np.diag([1.0, np.linalg.det(vt.T @ u.T)])
    rotation = vt.T @ proper @ u.T
    shift = mean_a - rotation @ mean_b
    return np.array([shift[0], shift[1], np.arctan2(rotation[1, 0], rotation[0, 0])])


def aligned(
    in_a: Float[np.ndarray, "n 2"],
    covariance_a: Float[np.ndarray, "m m"],
    in_b: Float[np.ndarray, "n 2"],
    covariance_b: Float[np.ndarray, "m m"],
) -> Alignment:
    """The most likely a_from_b, given two independent Gaussian maps of the same n ≥ 2 landmarks.

    Minimises dᵀ(P_a + R P_b Rᵀ)⁻¹d with d = a − (R b + t), the metric taken at each iterate.
    """
    n = len(in_a)
    variances = np.diag(covariance_a) + np.diag(covariance_b)
    a_from_b = procrustes(in_a, in_b, 1.0 / variances.reshape(n, 2).sum(axis=1))
    for _ in range(ITERATIONS):
        residual, metric, jacobian = _linearised(a_from_b, in_a, covariance_a, in_b, covariance_b)
        spread = information(jacobian.T @ metric @ jacobian, "an alignment")
        a_from_b = a_from_b + spread @ (jacobian.T @ (metric @ residual))
        a_from_b[2] = wrapped(a_from_b[2])
    residual, metric, jacobian = _linearised(a_from_b, in_a, covariance_a, in_b, covariance_b)
    spread = information(jacobian.T @ metric @ jacobian, "an alignment")
    return Alignment(a_from_b, spread, float(residual @ metric @ residual), 2 * n - 3)


def _linearised(
    a_from_b: Float[np.ndarray, "3"],
    in_a: Float[np.ndarray, "n 2"],
    covariance_a: Float[np.ndarray, "m m"],
    in_b: Float[np.ndarray, "n 2"],
    covariance_b: Float[np.ndarray, "m m"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"], Float[np.ndarray, "m 3"]]:
    """d, (P_a + R P_b Rᵀ)⁻¹ and ∂(R b + t)/∂(t, θ)."""
    n = len(in_a)
    c, s = np.cos(a_from_b[2]), np.sin(a_from_b[2])
    rotation = np.array([[c, -s], [s, c]])
    turned = in_b @ rotation.T
    all_turned = np.kron(np.eye(n), rotation)
    metric = information(
        covariance_a + all_turned @ covariance_b @ all_turned.T, "the shared landmarks of two maps"
    )
    jacobian = np.zeros((2 * n, 3))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
    jacobian[0::2, 2], jacobian[1::2, 2] = -turned[:, 1], turned[:, 0]
    return (in_a - turned - a_from_b[:2]).ravel(), metric, jacobian


def refusal(
    shared: int, alignment: Alignment | None, confidence: float, heading_sigma: float
) -> str | None:
    """Why two maps should not be merged, or None. `alignment` is None where `shared` is too few."""
    if shared < NEEDED or alignment is None:
        plural = "" if shared == 1 else "s"
        return f"{shared} shared landmark{plural}, {NEEDED} needed"
    sigma = float(np.sqrt(alignment.covariance[2, 2]))
    if sigma > heading_sigma:
        return (
            f"{shared} shared landmarks too close together: "
            f"heading known to {sigma:.2f} rad, {heading_sigma:.2f} needed"
        )
    limit = float(chdtri(alignment.dof, 1.0 - confidence))
    if alignment.chi2 > limit:
        return (
            f"{shared} shared landmarks disagree: chi² {alignment.chi2:.1f} "
            f"exceeds {limit:.1f} ({100.0 * confidence:g} %)"
        )
    return None
