"""Compiled kernel for landmarks that two Gaussian maps share: noise-free constraints and their
multipliers.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation import elementary
from team.estimation.compiled import compiled
from team.estimation.dense_kernel import solve_stack
from team.estimation.geometry import wrapped
from team.estimation.placing import put_block


class Constraints(NamedTuple):
    """The constraints R(θ) bₗ + t − aₗ = 0 of k landmarks, linearised at the result of the
    iterations.

    (cos, sin) of θ; lever: ∂(R bₗ)/∂θ; multiplier z = S⁻¹ y of the innovation y with covariance S =
    H P Hᵀ, and S⁻¹. The state moves by −P Hᵀ z, its covariance by −P Hᵀ S⁻¹ H P.
    """

    cos: float
    sin: float
    lever: Float[np.ndarray, "k 2"]
    multiplier: Float[np.ndarray, " m"]
    inverse: Float[np.ndarray, "m m"]


@compiled
def tied(
    mean: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    seen: Float[np.ndarray, " m"],
    seen_covariance: Float[np.ndarray, "m m"],
    iterations: int,
) -> tuple[Constraints, bool]:
    """Iterate the EKF update by the constraints; return also whether S is positive definite.

    mean: (t, θ, a₁, a₂, …), a map's pose and the landmarks; seen: (b₁, b₂, …), the same landmarks
    in the frame of that pose, independent of the map. m = 2k, p = 3 + m.
    """
    m = len(seen)
    state, local = mean.copy(), seen.copy()
    lever = np.empty((m // 2, 2))
    y, z = np.empty(m), np.zeros(m)
    S = np.empty((m, m))
    c, s = 1.0, 0.0
    for _ in range(iterations):
        s, c = elementary.sin_and_cos(state[2])
        turn = mean[2] - state[2]
        for point in range(m // 2):
            i, j = 2 * point, 2 * point + 1
            x, u = -s * local[i] - c * local[j], c * local[i] - s * local[j]
            lever[point, 0], lever[point, 1] = x, u
            y[i] = c * seen[i] - s * seen[j] + mean[0] - mean[3 + i] + x * turn
            y[j] = s * seen[i] + c * seen[j] + mean[1] - mean[3 + j] + u * turn
        U = of_map(covariance, lever)
        V = of_seen(seen_covariance, c, s)
        for point in range(m // 2):
            i, j = 2 * point, 2 * point + 1
            for k in range(m):
                S[i, k] = U[0, k] + lever[point, 0] * U[2, k] - U[3 + i, k]
                S[j, k] = U[1, k] + lever[point, 1] * U[2, k] - U[3 + j, k]
                S[i, k] += c * V[i, k] - s * V[j, k]
                S[j, k] += s * V[i, k] + c * V[j, k]
        if not _invert(S):
            return Constraints(c, s, lever, z, S), False
        _multiply(S, y, z)
        moved_by(mean, U, z, state)
        moved_by(seen, V, z, local)
    return Constraints(c, s, lever, z, S), True


ITERATIONS = 3
INDEFINITE, SINGULAR = 1, 2
"""Faults: the covariance of the innovation is not positive definite, or that of one constraint is
singular.
"""


class Agreed(NamedTuple):
    """The landmarks that a map and a local map share, without those beyond the gate.

    mean, covariance: of the map's pose and of these landmarks. in_whole, in_local: their indices in
    both maps; sights: the indices of their coordinates in the local mean. known: number of shared
    landmarks, also beyond the gate. fault: 0, INDEFINITE or SINGULAR.
    """

    in_whole: Int64[np.ndarray, " k"]
    in_local: Int64[np.ndarray, " k"]
    sights: Int64[np.ndarray, " m"]
    mean: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    tie: Constraints
    known: int
    fault: int


@compiled
def agreed(
    whole_ids: UInt32[np.ndarray, " L"],
    whole_mean: Float[np.ndarray, " n"],
    whole_covariance: Float[np.ndarray, "n n"],
    ids: UInt32[np.ndarray, " K"],
    local_mean: Float[np.ndarray, " q"],
    local_covariance: Float[np.ndarray, "q q"],
    gate: float,
) -> Agreed:
    """Constrain two maps, and drop the worst constraint until all are within the gate.

    Ids ascend; landmarks are the last entries of a mean.
    """
    in_whole, in_local = _shared(whole_ids, ids)
    known = len(in_whole)
    behind = len(local_mean) - 2 * len(ids)
    while True:
        place, sights = coordinates(in_whole, 3, 3), coordinates(in_local, behind, 0)
        mean, covariance = _part(whole_mean, whole_covariance, place)
        seen, spread = _part(local_mean, local_covariance, sights)
        tie, sound = tied(mean, covariance, seen, spread, ITERATIONS)
        worst, fault = (-1, 0) if sound else (-1, INDEFINITE)
        if sound and gate < math.inf:
            worst, fault = _worst(tie, gate)
        if worst < 0:
            return Agreed(in_whole, in_local, sights, mean, covariance, tie, known, fault)
        others = np.arange(len(in_whole)) != worst
        in_whole, in_local = in_whole[others], in_local[others]


@compiled
def _shared(
    one: UInt32[np.ndarray, " L"], other: UInt32[np.ndarray, " K"]
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    first, second = np.empty(len(other), np.int64), np.empty(len(other), np.int64)
    i, k = 0, 0
    for j in range(len(other)):
        while i < len(one) and one[i] < other[j]:
            i += 1
        if i < len(one) and one[i] == other[j]:
            first[k], second[k] = i, j
            k += 1
    return first[:k].copy(), second[:k].copy()


@compiled
def coordinates(
    index: Int64[np.ndarray, " k"], behind: int, before: int
) -> Int64[np.ndarray, " m"]:
    """Return the entries 0 … before − 1 and those of the points with these indices, after
    `behind`.
    """
    entries = np.empty(before + 2 * len(index), np.int64)
    for j in range(before):
        entries[j] = j
    for k in range(len(index)):
        entries[before + 2 * k] = behind + 2 * index[k]
        entries[before + 2 * k + 1] = behind + 2 * index[k] + 1
    return entries


@compiled
def _part(
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    entries: Int64[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    m = len(entries)
    of_mean, of_covariance = np.empty(m), np.empty((m, m))
    for i in range(m):
        of_mean[i] = mean[entries[i]]
        for j in range(m):
            of_covariance[i, j] = covariance[entries[i], entries[j]]
    return of_mean, of_covariance


@compiled
def _worst(tie: Constraints, gate: float) -> tuple[int, int]:
    """Return the constraint that the others contradict most, −1 where all are within the gate; and
    the fault.
    """
    z, worst, most = tie.multiplier, -1, gate
    for k in range(len(z) // 2):
        i, j = 2 * k, 2 * k + 1
        own = tie.inverse[i : j + 1, i : j + 1].copy().reshape(1, 2, 2)
        weighted = z[i : j + 1].copy().reshape(1, 2, 1)
        if not solve_stack(own, weighted):
            return -1, SINGULAR
        gain = z[i] * weighted[0, 0, 0] + z[j] * weighted[0, 1, 0]
        if math.isnan(gain):
            return -1, 0
        if gain > most:
            worst, most = k, gain
    return worst, 0


class TiedPose(NamedTuple):
    """N(pose, covariance) of `tied_pose`. known, refused: numbers of shared landmarks, and of those
    beyond the gate. fault: as `Agreed`.
    """

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    known: int
    refused: int
    fault: int


@compiled
def end_pose_of(
    whole_ids: UInt32[np.ndarray, " L"],
    whole_mean: Float[np.ndarray, " n"],
    whole_covariance: Float[np.ndarray, "n n"],
    ids: UInt32[np.ndarray, " K"],
    local_mean: Float[np.ndarray, " q"],
    local_covariance: Float[np.ndarray, "q q"],
    gate: float,
) -> TiedPose:
    """Compute the end pose of a local map on a map: `agreed`, then `tied_pose`."""
    found = agreed(whole_ids, whole_mean, whole_covariance, ids, local_mean, local_covariance, gate)
    refused = found.known - len(found.in_whole)
    if found.fault:
        return TiedPose(np.zeros(3), np.zeros((3, 3)), found.known, refused, found.fault)
    end = np.arange(3)
    of_end, spread = _part(local_mean, local_covariance, end)
    end_of_seen = np.empty((3, len(found.sights)))
    for i in range(3):
        for j in range(len(found.sights)):
            end_of_seen[i, j] = local_covariance[i, found.sights[j]]
    pose, covariance = tied_pose(
        found.tie, found.mean, found.covariance, of_end, spread, end_of_seen
    )
    return TiedPose(pose, covariance, found.known, refused, 0)


@compiled
def of_map(
    covariance: Float[np.ndarray, "q p"], lever: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "q m"]:
    """Multiply rows of the map's covariance (columns: pose, then the landmarks) by Hᵀ."""
    U = np.empty((len(covariance), 2 * len(lever)))
    for row in range(len(covariance)):
        x, y, turn = covariance[row, 0], covariance[row, 1], covariance[row, 2]
        for point in range(len(lever)):
            i, j = 2 * point, 2 * point + 1
            U[row, i] = x + lever[point, 0] * turn - covariance[row, 3 + i]
            U[row, j] = y + lever[point, 1] * turn - covariance[row, 3 + j]
    return U


@compiled
def of_seen(covariance: Float[np.ndarray, "q m"], c: float, s: float) -> Float[np.ndarray, "q m"]:
    """Multiply rows of the local map's covariance (columns: the landmarks) by Hᵀ."""
    V = np.empty_like(covariance)
    for row in range(len(covariance)):
        for i in range(0, covariance.shape[1], 2):
            x, y = covariance[row, i], covariance[row, i + 1]
            V[row, i], V[row, i + 1] = c * x - s * y, s * x + c * y
    return V


@compiled
def _multiply(
    A: Float[np.ndarray, "q m"], x: Float[np.ndarray, " m"], out: Float[np.ndarray, " q"]
) -> None:
    for row in range(len(A)):
        total = 0.0
        for column in range(len(x)):
            total += A[row, column] * x[column]
        out[row] = total


@compiled
def moved_by(
    mean: Float[np.ndarray, " q"],
    gain: Float[np.ndarray, "q m"],
    z: Float[np.ndarray, " m"],
    out: Float[np.ndarray, " q"],
) -> None:
    """Write mean − gain z into `out`."""
    _multiply(gain, z, out)
    for row in range(len(mean)):
        out[row] = mean[row] - out[row]


@compiled
def tied_pose(
    tie: Constraints,
    mean: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "p p"],
    end: Float[np.ndarray, "3"],
    end_covariance: Float[np.ndarray, "3 3"],
    end_of_seen: Float[np.ndarray, "3 m"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Compute pose ∘ end pose of the tied maps and its covariance; mean and covariance as in
    `tied`.

    end: N(end pose, covariance) in the frame of the map's pose; end_of_seen: its covariance with
    the observed landmarks.
    """
    gain = np.concatenate(
        (of_map(covariance[:3], tie.lever), of_seen(end_of_seen, tie.cos, tie.sin))
    )
    before, state = np.concatenate((mean[:3], end)), np.empty(6)
    moved_by(before, gain, tie.multiplier, state)
    joint, row = np.zeros((6, 6)), np.empty(len(tie.multiplier))
    put_block(joint, 0, 0, covariance[:3, :3])
    put_block(joint, 3, 3, end_covariance)
    for a in range(6):
        _multiply(tie.inverse, gain[a], row)
        for b in range(6):
            for k in range(len(row)):
                joint[a, b] -= row[k] * gain[b, k]
    s, c = elementary.sin_and_cos(state[2])
    x, y = c * state[3] - s * state[4], s * state[3] + c * state[4]
    G = np.zeros((3, 6))
    G[0, 0], G[1, 1], G[2, 2], G[2, 5] = 1.0, 1.0, 1.0, 1.0
    G[0, 2], G[1, 2] = -y, x
    G[0, 3], G[0, 4], G[1, 3], G[1, 4] = c, -s, s, c
    spread = np.zeros((3, 3))
    for a in range(3):
        for b in range(a + 1):
            for i in range(6):
                for j in range(6):
                    spread[a, b] += G[a, i] * joint[i, j] * G[b, j]
            spread[b, a] = spread[a, b]
    return np.array([state[0] + x, state[1] + y, wrapped(state[2] + state[5])]), spread


@compiled
def _invert(S: Float[np.ndarray, "m m"]) -> bool:
    """S ← S⁻¹ by Cholesky, exactly symmetric; return whether S is positive definite."""
    m = len(S)
    for k in range(m):
        for j in range(k):
            factor = S[k, j]
            for i in range(k, m):
                S[i, k] -= S[i, j] * factor
        if not S[k, k] > 0.0:
            return False
        S[k, k] = math.sqrt(S[k, k])
        for i in range(k + 1, m):
            S[i, k] /= S[k, k]
    _inverted(S)
    return True


@compiled
def _inverted(S: Float[np.ndarray, "m m"]) -> None:
    """S ← L⁻ᵀ L⁻¹ of the lower triangle L of S."""
    m = len(S)
    for k in range(m):  # L ← L⁻¹, column by column
        S[k, k] = 1.0 / S[k, k]
        for i in range(k + 1, m):
            total = 0.0
            for j in range(k, i):
                total -= S[i, j] * S[j, k]
            S[i, k] = total / S[i, i]
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, m):
                total += S[k, i] * S[k, j]
            S[j, i] = total  # of the diagonal last, when its row needs it no more
    for i in range(m):
        for j in range(i):
            S[i, j] = S[j, i]
