"""Align two maps by their common points.

Weighted Procrustes alignment (Arun, Huang & Blostein 1987) gives the first guess; Gauss-Newton
refines it in the metric of both joint covariances. The joint cost, which is not linearised about a
drifted map, tests the agreement.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.gaussian import deviation, information
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Bool, Float

ITERATIONS = 10
NEEDED = 2  # number of points that determine a rigid motion in the plane
LEAST_AGREEING = 3  # fewest landmarks that must agree where others disagree
MOST_PAIRS = 2000  # most pairs of shared landmarks from which a frame is proposed


class Maps(NamedTuple):
    """Two independent Gaussian maps of the same n landmarks [m], N(a, A) and N(b, B), m = 2n."""

    a: Float[np.ndarray, "n 2"]
    A: Float[np.ndarray, "m m"]
    b: Float[np.ndarray, "n 2"]
    B: Float[np.ndarray, "m m"]

    def select(self, which: Bool[np.ndarray, " n"]) -> "Maps":
        """Select landmarks."""
        both = np.repeat(which, 2)
        of = np.ix_(both, both)
        return Maps(self.a[which], self.A[of], self.b[which], self.B[of])

    def differences(
        self, a_from_b: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"], Float[np.ndarray, "m 3"]]:
        """Compute d = a − (R b + t), its covariance A + R B Rᵀ, and J = ∂(R b + t)/∂(t, θ)."""
        n = len(self.a)
        s, c = core.sin_and_cos(a_from_b[2])
        R = np.array([[c, -s], [s, c]])
        turned = dense.product(self.b, R.T)
        D = self.A + dense.congruent(np.kron(np.eye(n), R), self.B)
        J = np.zeros((2 * n, 3))
        J[0::2, 0] = J[1::2, 1] = 1.0
        J[0::2, 2], J[1::2, 2] = -turned[:, 1], turned[:, 0]
        return (self.a - turned - a_from_b[:2]).ravel(), D, J


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


def align(maps: Maps) -> Alignment:
    """Estimate the most likely a_from_b of maps of n ≥ 2 landmarks.

    Minimises dᵀ(A + R B Rᵀ)⁻¹d, d = a − (R b + t), about the centroids, with the metric of each
    iterate. If the points coincide, the heading is 0 and `heading_sigma` infinite. Raises
    NotACovarianceError.
    """
    a, A, b, B = maps
    dof = 2 * len(a) - 3
    of_a, of_b = a.mean(axis=0), b.mean(axis=0)
    near = Maps(a - of_a, A, b - of_b, B)
    if not near.b.any():
        unknown = np.full((3, 3), np.inf)
        return Alignment(np.array([*(of_a - of_b), 0.0]), unknown, np.inf, dof, np.inf)
    variances = np.diag(A) + np.diag(B)
    about = procrustes(near.a, near.b, 1.0 / variances.reshape(-1, 2).sum(axis=1))
    for _ in range(ITERATIONS):
        residual, metric, J = _linearise(near, about)
        spread = information(dense.congruent(J.T, metric), "an alignment")
        slope = dense.product(J.T, dense.product(metric, residual))
        about = about + dense.product(spread, slope)
        about[2] = wrapped(about[2])
    residual, metric, J = _linearise(near, about)
    spread = information(dense.congruent(J.T, metric), "an alignment")
    difference = information(metric, "the metric of an alignment")
    sigma = _shape_heading_sigma(near.b, J, difference)
    s, c = core.sin_and_cos(about[2])
    x, y = c * of_b[0] - s * of_b[1], s * of_b[0] + c * of_b[1]
    a_from_b = np.array([of_a[0] + about[0] - x, of_a[1] + about[1] - y, about[2]])
    lever = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
    chi2 = dense.quadratic(metric, residual)
    return Alignment(a_from_b, dense.congruent(lever, spread), chi2, dof, sigma)


def fit_at_heading(maps: Maps, heading: float) -> tuple[Float[np.ndarray, "2"], float]:
    """Fit the translation [m] of a_from_b at a given heading; return it with its χ²."""
    residual, metric, jacobian = _linearise(maps, np.array([0.0, 0.0, heading]))
    J = jacobian[:, :2]
    slope = dense.product(J.T, dense.product(metric, residual))
    shift = dense.solve(dense.congruent(J.T, metric), slope)
    return shift, dense.quadratic(metric, residual - dense.product(J, shift))


def _linearise(
    maps: Maps, a_from_b: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"], Float[np.ndarray, "m 3"]]:
    """Return the differences d, (A + R B Rᵀ)⁻¹ and ∂(R b + t)/∂(t, θ)."""
    d, D, J = maps.differences(a_from_b)
    return d, information(D, "the shared landmarks of two maps"), J


def _shape_heading_sigma(
    in_b: Float[np.ndarray, "n 2"],
    jacobian: Float[np.ndarray, "m 3"],
    covariance: Float[np.ndarray, "m m"],
) -> float:
    squares = dense.product(jacobian.T, jacobian)
    shape = np.eye(len(jacobian)) - dense.product(jacobian, dense.solve(squares, jacobian.T))
    spread = dense.product(dense.product(shape, covariance), shape)
    variance = np.trace(spread) / (len(jacobian) - 3)
    extent = float((core.squared(in_b - in_b.mean(axis=0))).sum())
    return deviation(variance / extent)


def agreeing(maps: Maps, limit: float) -> Bool[np.ndarray, " n"]:
    """Mark the landmarks of two maps that one rigid motion places.

    From the largest set by the motion of a pair, those whose χ² exceeds the limit are removed, the
    worst first, and those that agree are added.
    """
    agree = np.ones(len(maps.a), np.bool_)
    if _disagreements(maps, agree).max() > limit:
        agree = _largest_agreement(maps, limit)
        if agree.sum() < LEAST_AGREEING:
            return agree
    for _ in range(len(agree)):
        chi2 = _disagreements(maps, agree)
        worst = int(np.argmax(np.where(agree, chi2, -np.inf)))
        if chi2[worst] > limit and agree.sum() > LEAST_AGREEING:
            agree[worst] = False
            continue
        best = int(np.argmin(np.where(agree, np.inf, chi2)))
        if agree[best] or chi2[best] > limit:
            break
        agree[best] = True
    return agree


def _largest_agreement(maps: Maps, limit: float) -> Bool[np.ndarray, " n"]:
    """Mark the most landmarks that the rigid motion of one pair places within the limit.

    The motion from i and j turns bⱼ − bᵢ to aⱼ − aᵢ and maps middle to middle.
    """
    a, A, b, B = maps
    best = np.zeros(len(a), np.bool_)
    pairs = list(combinations(range(len(a)), 2))
    for i, j in pairs[:: -(-len(pairs) // MOST_PAIRS)]:
        to, of = a[j] - a[i], b[j] - b[i]
        turn = core.atan2(to[1], to[0]) - core.atan2(of[1], of[0])
        s, c = core.sin_and_cos(turn)
        R = np.array([[c, -s], [s, c]])
        d = a - 0.5 * (a[i] + a[j]) - dense.product(b - 0.5 * (b[i] + b[j]), R.T)
        P = _relative(A, i, j) + _turned(_relative(B, i, j), s, c)
        # The direction of the pair is uncertain across it; far from the pair by as much more.
        far = core.hypot(*(a - 0.5 * (a[i] + a[j])).T) / max(core.hypot(*to), 1e-12)
        P = P + core.squared(far)[:, None, None] * (P[i] + P[j])
        x, y = d.T
        xx, xy, yy = P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]
        chi2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * P[:, 1, 0])
        agree = chi2 <= limit
        if agree.sum() > best.sum():
            best = agree
    return best


def _relative(P: Float[np.ndarray, "m m"], i: int, j: int) -> Float[np.ndarray, "n 2 2"]:
    """Compute the covariance of each landmark relative to the middle of i and j."""
    n = len(P) // 2
    grid = P.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)
    own = grid[np.arange(n), np.arange(n)]
    middle = 0.25 * (grid[i, i] + grid[i, j] + grid[j, i] + grid[j, j])
    cross = 0.5 * (grid[:, i] + grid[:, j])
    found: Float[np.ndarray, "n 2 2"] = own + middle - cross - cross.transpose(0, 2, 1)
    return found


def _turned(P: Float[np.ndarray, "n 2 2"], s: float, c: float) -> Float[np.ndarray, "n 2 2"]:
    xx, xy, yy = P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]
    across = 2.0 * c * s * xy
    x, y = c * c * xx - across + s * s * yy, s * s * xx + across + c * c * yy
    between = c * s * (xx - yy) + (c * c - s * s) * xy
    found: Float[np.ndarray, "n 2 2"] = np.stack([x, between, between, y], axis=1).reshape(-1, 2, 2)
    return found


def _disagreements(maps: Maps, agree: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Compute each landmark's χ² of two degrees of freedom against those that agree.

    With the difference d at the motion of the agreeing landmarks I, its covariance D, and J by the
    motion, of covariance N: in I, g = W d_I, M = W − W J_I N J_Iᵀ W, W = D_II⁻¹, and χ² = g_iᵀ
    M_ii⁻¹ g_i (Baarda 1968); any other k is predicted as D_kI D_II⁻¹ d_I.
    """
    inside = np.repeat(agree, 2)
    d, D, J = maps.differences(align(maps.select(agree)).a_from_b)
    W = information(D[np.ix_(inside, inside)], "the shared landmarks of two maps")
    gain = dense.product(D[:, inside], W)
    along = dense.product(W, J[inside])
    N = information(dense.product(J[inside].T, along), "the motion between two maps")
    M = W - dense.congruent(along, N)
    g = dense.product(W, d[inside])
    G = J - dense.product(gain, J[inside])
    e = d - dense.product(gain, d[inside])
    S = D - dense.product(gain, D[inside]) + dense.congruent(G, N)
    found = np.empty(len(agree))
    place = np.cumsum(agree) - 1
    for k, is_inside in enumerate(agree.tolist()):
        at = 2 * int(place[k]) if is_inside else 2 * k
        block, own = (M, g) if is_inside else (S, e)
        two = slice(at, at + 2)
        metric = information(0.5 * (block[two, two] + block[two, two].T), "a difference")
        found[k] = dense.quadratic(metric, own[two])
    return found


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
