"""A submap as a factor between its start pose, its other poses and its landmarks.

For a submap that starts at pose s, has the poses e (its end, then its pose nodes) and observes
landmarks l, with the rotation R of the heading of s,

    r = (Rᵀ(p_e − p_s), wrap(θ_e − θ_s), …, Rᵀ(l₁ − p_s), …) − mean ~ N(0, P).

In the map frame, r' = T r with T = blkdiag(R, 1, …, R, …), its Jacobian is the identity for (e, …,
l₁, …) and

    G = [−I | (v_y, −v_x)ᵀ] per point v = p − p_s,  [0 0 −1] for the heading

for s, and its metric is M = T P⁻¹ Tᵀ. The state is additive in (x, y, θ).

A submap with sensitivities S (a row per bias) has the mean mean + Sᵀ b; the Jacobian of r' for a
bias is −T S_b. Its biases, one number each, follow the other members.
"""

import numpy as np
from jaxtyping import Float, Int64

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.geometry import wrapped
from team.estimation.placing import put, put_block

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]


@compiled
def poses_of(points: int, numbers: int) -> int:
    """Count the poses among a submap's points: a pose has 3 numbers, every other point 2."""
    return numbers - 2 * points


@compiled
def submap_residual(
    state: Values, at: Indices, mean: Values
) -> tuple[Values, Float[np.ndarray, "n 2"]]:
    """Compute the residual r' in the map frame, and v = p − p_s of each point (end pose first).

    at: index in `state` of the first number of the start pose, of the other poses and of each
    landmark.
    """
    start = at[0]
    poses = poses_of(len(at) - 1, len(mean))
    s, c = elementary.sin_and_cos(state[start + 2])
    residual = np.empty(len(mean))
    offsets = np.empty((len(at) - 1, 2))
    for point in range(len(at) - 1):
        row = 3 * point if point < poses else 2 * point + poses
        offsets[point, 0] = state[at[point + 1]] - state[start]
        offsets[point, 1] = state[at[point + 1] + 1] - state[start + 1]
        residual[row] = offsets[point, 0] - (c * mean[row] - s * mean[row + 1])
        residual[row + 1] = offsets[point, 1] - (s * mean[row] + c * mean[row + 1])
        if point < poses:
            turn = state[at[point + 1] + 2] - state[start + 2]
            residual[row + 2] = wrapped(turn - mean[row + 2])
    return residual, offsets


@compiled
def rotated_information(
    information: Float[np.ndarray, "n n"], heading: float, poses: int
) -> Float[np.ndarray, "n n"]:
    """Rotate the information of a submap with `poses` poses into the map frame: M = T P⁻¹ Tᵀ."""
    s, c = elementary.sin_and_cos(heading)
    turned = information.copy()
    n = len(information)
    row = 0
    while row < n:
        for k in range(n):
            a, b = turned[row, k], turned[row + 1, k]
            turned[row, k] = c * a - s * b
            turned[row + 1, k] = s * a + c * b
        row += 3 if row < 3 * poses else 2
    row = 0
    while row < n:
        for k in range(n):
            a, b = turned[k, row], turned[k, row + 1]
            turned[k, row] = c * a - s * b
            turned[k, row + 1] = s * a + c * b
        row += 3 if row < 3 * poses else 2
    return turned


@compiled
def submap_normal(
    state: Values, at: Indices, mean: Values, information: Float[np.ndarray, "n n"]
) -> tuple[Float[np.ndarray, "m m"], Values, float]:
    """Compute JᵀP⁻¹J, JᵀP⁻¹r and χ² = rᵀP⁻¹r of a submap over (start pose, other poses,
    landmarks).
    """
    n = len(mean)
    poses = poses_of(len(at) - 1, n)
    residual, offsets = submap_residual(state, at, mean)
    metric = rotated_information(information, state[at[0] + 2], poses)
    jacobian = np.zeros((n, 3))
    for point in range(len(at) - 1):
        row = 3 * point if point < poses else 2 * point + poses
        jacobian[row, 0] = -1.0
        jacobian[row + 1, 1] = -1.0
        jacobian[row, 2] = offsets[point, 1]
        jacobian[row + 1, 2] = -offsets[point, 0]
        if point < poses:
            jacobian[row + 2, 2] = -1.0
    hessian = np.zeros((n + 3, n + 3))
    gradient = np.zeros(n + 3)
    chi2 = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            hessian[i + 3, j + 3] = metric[i, j]
            total += metric[i, j] * residual[j]
        gradient[i + 3] = total
        chi2 += residual[i] * total
        for a in range(3):
            gradient[a] += jacobian[i, a] * total
        for j in range(n):
            for a in range(3):
                hessian[a, j + 3] += jacobian[i, a] * metric[i, j]
    for j in range(n):
        for a in range(3):
            hessian[j + 3, a] = hessian[a, j + 3]
            for b in range(3):
                hessian[a, b] += hessian[a, j + 3] * jacobian[j, b]
    return hessian, gradient, chi2


@compiled
def shifted_mean(
    state: Values, at: Indices, mean: Values, sensitivity: Float[np.ndarray, "B n"]
) -> Values:
    """Compute mean + Sᵀ b given the biases, whose indices are last in `at`."""
    shifted = mean.copy()
    first = len(at) - len(sensitivity)
    for b in range(len(sensitivity)):
        value = state[at[first + b]]
        for i in range(len(mean)):
            shifted[i] += value * sensitivity[b, i]
    return shifted


@compiled
def biased_normal(
    state: Values,
    at: Indices,
    mean: Values,
    information: Float[np.ndarray, "n n"],
    sensitivity: Float[np.ndarray, "B n"],
) -> tuple[Float[np.ndarray, "m m"], Values, float]:
    """Compute `submap_normal` over (start pose, other poses, landmarks, biases)."""
    biases = len(sensitivity)
    members = at[: len(at) - biases]
    if biases == 0:
        return submap_normal(state, members, mean, information)
    shifted = shifted_mean(state, at, mean, sensitivity)
    unbiased, slope, chi2 = submap_normal(state, members, shifted, information)
    n = len(mean)
    hessian, gradient = np.zeros((n + 3 + biases, n + 3 + biases)), np.zeros(n + 3 + biases)
    put_block(hessian, 0, 0, unbiased)
    put(gradient, 0, slope)
    s, c = elementary.sin_and_cos(state[at[0] + 2])
    poses = poses_of(len(members) - 1, n)
    turned = np.empty((biases, n))
    for b in range(biases):
        row = 0
        while row < n:
            x, y = sensitivity[b, row], sensitivity[b, row + 1]
            turned[b, row], turned[b, row + 1] = c * x - s * y, s * x + c * y
            if row < 3 * poses:
                turned[b, row + 2] = sensitivity[b, row + 2]
                row += 1
            row += 2
        for a in range(n + 3):
            total = 0.0
            for j in range(n):
                total += unbiased[a, 3 + j] * turned[b, j]
            hessian[a, n + 3 + b] = hessian[n + 3 + b, a] = -total
        for j in range(n):
            gradient[n + 3 + b] -= turned[b, j] * slope[3 + j]
    for b in range(biases):
        for other in range(biases):
            for j in range(n):
                hessian[n + 3 + other, n + 3 + b] -= turned[other, j] * hessian[3 + j, n + 3 + b]
    return hessian, gradient, chi2
