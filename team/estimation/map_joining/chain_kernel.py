"""Compiled kernel of a prior and the submaps after it: one small least-squares problem.

The unknowns are a pose per submap and the landmarks, a few tens of numbers; most factors contain
most of them, so the matrix is dense. The requested unknowns stand last: their covariance is the
inverse of the last block of the factor.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from team.estimation.compiled import compiled
from team.estimation.dense_kernel import (
    factor_or_fault,
    inverse_from_factor,
    solve_lower,
    solve_upper,
)
from team.estimation.geometry import compose, transformed, wrapped
from team.estimation.map_joining.joining_kernel import (
    SubmapFactors,
    costs,
    landmark_chi2,
    submap_of,
)
from team.estimation.map_joining.least_squares import (
    LEAST_DAMPING,
    MOST_DAMPING,
    ROUNDING,
    SHARES,
)
from team.estimation.map_joining.submap_factor import submap_normal, submap_residual
from team.estimation.placing import put

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]
UNDETERMINED, NO_COVARIANCE = 1, 2
"""Faults: an undetermined unknown, or a matrix that is no covariance."""


class Chain(NamedTuple):
    """Consecutive local maps, each beginning at the end of the one before, in flat arrays.

    ids: of their landmarks, ascending in each; those of map k begin at id_start[k]. mean: (end
    pose, landmarks) of each, from mean_start[k] on; covariance: row by row.
    """

    ids: UInt32[np.ndarray, " _"]
    id_start: Indices
    mean: Values
    mean_start: Indices
    covariance: Values


class SolvedChain(NamedTuple):
    """The solution of a chain. fault: 0, UNDETERMINED or NO_COVARIANCE; then at map `of`.

    ids: all landmarks, ascending. mean, covariance: of the last end pose and of these. cost: χ² of
    all maps, in `dof` degrees of freedom. known: for each map after the first, the number of its
    landmarks that another map has, too. beyond: for each landmark of these maps, whether its own χ²
    is beyond the gate.
    """

    ids: UInt32[np.ndarray, " L"]
    mean: Values
    covariance: Matrix
    cost: float
    dof: int
    known: Indices
    beyond: Bool[np.ndarray, " _"]
    fault: int
    of: int


@compiled
def solved_chain(chain: Chain, gate: float, iterations: int, tolerance: float) -> SolvedChain:
    """Minimise over all poses and landmarks as `gauss_newton.settled`, without robust losses."""
    ids = np.unique(chain.ids)
    slots = np.searchsorted(ids, chain.ids)
    maps = len(chain.id_start) - 1
    factors, of = _factors(chain, slots)
    if of >= 0:
        return _without_solution(ids, NO_COVARIANCE, of)
    offset = np.empty(maps + 2 + len(ids), np.int64)
    for node in range(maps + 2):
        offset[node] = 3 * node
    for landmark in range(len(ids)):
        offset[maps + 2 + landmark] = 3 * (maps + 1) + 2 * (landmark + 1)
    state = _guess(chain, slots, len(ids))
    damping = 0.0
    for _ in range(iterations):
        state, damping, change = _iterated(state, offset, factors, damping)
        if math.isnan(change):
            return _without_solution(ids, UNDETERMINED, 0)
        if damping == math.inf:
            break
        if damping == 0.0 and change < tolerance:
            break
    H, _ = _normal_equations(state, offset, factors)
    L, fault = factor_or_fault(H)
    if fault:
        return _without_solution(ids, UNDETERMINED, 0)
    last = 3 * maps
    beyond = landmark_chi2(state, offset, factors, 1.0)[chain.id_start[1] :] > gate
    return SolvedChain(
        ids,
        state[last:].copy(),
        inverse_from_factor(L[last:, last:].copy()),
        costs(state, offset, factors, 1.0).sum(),
        len(chain.mean) - (len(state) - 3),
        _shared(chain, slots, len(ids)),
        beyond,
        0,
        0,
    )


@compiled
def _without_solution(ids: UInt32[np.ndarray, " L"], fault: int, of: int) -> SolvedChain:
    no_count, nowhere = np.zeros(0, np.int64), np.zeros(0, np.bool_)
    no_mean, no_covariance = np.zeros(0), np.zeros((0, 0))
    return SolvedChain(ids, no_mean, no_covariance, 0.0, 0, no_count, nowhere, fault, of)


@compiled
def _factors(chain: Chain, slots: Indices) -> tuple[SubmapFactors, int]:
    """Make factors between the origin (node 0), the end poses (1, 2, …) and the landmarks; return
    also the first map without a covariance, or −1.
    """
    maps = len(chain.id_start) - 1
    member = np.empty(2 * maps + len(slots), np.int64)
    member_start = np.empty(maps + 1, np.int64)
    information = np.empty_like(chain.covariance)
    information_start = np.zeros(maps + 1, np.int64)
    block = np.empty((len(slots), 3))
    fault_of = -1
    for k in range(maps):
        begin, end = chain.id_start[k], chain.id_start[k + 1]
        member_start[k] = 2 * k + begin
        member[2 * k + begin], member[2 * k + begin + 1] = k, k + 1
        for i in range(begin, end):
            member[2 * (k + 1) + i] = maps + 1 + slots[i]
        n, first = chain.mean_start[k + 1] - chain.mean_start[k], information_start[k]
        information_start[k + 1] = first + n * n
        P = chain.covariance[first : first + n * n].copy().reshape(n, n)
        for i in range(begin, end):
            row = n - 2 * (end - i)
            block[i, 0], block[i, 1], block[i, 2] = (
                P[row, row],
                P[row, row + 1],
                P[row + 1, row + 1],
            )
        L, fault = factor_or_fault(P)
        if fault and fault_of < 0:
            fault_of = k
        elif fault_of < 0:
            put(information, first, inverse_from_factor(L).ravel())
    member_start[maps] = 2 * maps + len(slots)
    none, no_start = np.zeros(0, np.int64), np.zeros(maps + 1, np.int64)
    factors = SubmapFactors(
        member,
        member_start,
        chain.mean,
        chain.mean_start,
        information,
        information_start,
        np.zeros(0),
        no_start,
        block,
        chain.id_start,
        none,
        no_start,
    )
    return factors, fault_of


@compiled
def _guess(chain: Chain, slots: Indices, landmarks: int) -> Values:
    """Place each map after the one before, each landmark by the first map that has it."""
    maps = len(chain.id_start) - 1
    state = np.zeros(3 * (maps + 1) + 2 * landmarks)
    is_placed = np.zeros(landmarks, np.bool_)
    for k in range(maps):
        mean = chain.mean[chain.mean_start[k] : chain.mean_start[k + 1]]
        start = state[3 * k : 3 * k + 3].copy()
        put(state, 3 * k + 3, compose(start, mean[:3]))
        for i in range(chain.id_start[k], chain.id_start[k + 1]):
            if not is_placed[slots[i]]:
                is_placed[slots[i]] = True
                row = len(mean) - 2 * (chain.id_start[k + 1] - i)
                at = 3 * (maps + 1) + 2 * slots[i]
                put(state, at, transformed(start, mean[row : row + 2]))
    return state


@compiled
def _normal_equations(
    state: Values, offset: Indices, factors: SubmapFactors
) -> tuple[Matrix, Float[np.ndarray, "n 1"]]:
    """Σ JᵀP⁻¹J and Σ JᵀP⁻¹r; the origin has an identity block and a zero gradient."""
    H, gradient = np.zeros((len(state), len(state))), np.zeros((len(state), 1))
    for f in range(len(factors.member_start) - 1):
        nodes, at, mean, information, _ = submap_of(offset, factors, f)
        unknowns, k = np.empty(len(mean) + 3, np.int64), 0
        for a in range(len(nodes)):
            for i in range(offset[nodes[a]], offset[nodes[a] + 1]):
                unknowns[k] = i
                k += 1
        if f == 0:  # it begins at the origin, so it is linear
            residual, _ = submap_residual(state, at, mean)
            for i in range(len(mean)):
                row = H[unknowns[3 + i]]
                for j in range(len(mean)):
                    row[unknowns[3 + j]] = information[i, j]
                    gradient[unknowns[3 + i], 0] += information[i, j] * residual[j]
            continue
        hessian, slope, _ = submap_normal(state, at, mean, information)
        for i in range(len(unknowns)):
            gradient[unknowns[i], 0] += slope[i]
            row = H[unknowns[i]]
            for j in range(len(unknowns)):
                row[unknowns[j]] += hessian[i, j]
    H[:3], H[:, :3], gradient[:3] = 0.0, 0.0, 0.0
    for i in range(3):
        H[i, i] = 1.0
    return H, gradient


@compiled
def _iterated(
    state: Values, offset: Indices, factors: SubmapFactors, damping: float
) -> tuple[Values, float, float]:
    """Take one step of `gauss_newton.take_step`; return the next state, the next damping and the
    largest change of the full step; NaN where an unknown is undetermined.
    """
    H, gradient = _normal_equations(state, offset, factors)
    before = costs(state, offset, factors, 1.0).sum()
    refused = math.inf
    while damping < MOST_DAMPING:
        damped = H.copy()
        for i in range(len(H)):
            damped[i, i] *= 1.0 + damping
        L, fault = factor_or_fault(damped)
        if fault:
            return state, damping, math.nan
        step = -gradient
        solve_lower(L, step)
        solve_upper(L, step)
        largest = np.abs(step).max()
        for share in SHARES:
            if damping > 0.0 and share < 1.0:
                break
            moved = _moved(state, offset, step, share)
            if costs(moved, offset, factors, 1.0).sum() <= before * (1.0 + ROUNDING) + ROUNDING:
                return moved, damping / 10.0 if damping > LEAST_DAMPING else 0.0, largest
        refused = largest if refused == math.inf else refused
        damping = max(10.0 * damping, LEAST_DAMPING)
    return state, math.inf, refused


@compiled
def _moved(state: Values, offset: Indices, step: Float[np.ndarray, "n 1"], share: float) -> Values:
    moved = state.copy()
    for i in range(len(state)):
        moved[i] += share * step[i, 0]
    for node in range(len(offset) - 1):
        if offset[node + 1] - offset[node] == 3:
            moved[offset[node] + 2] = wrapped(moved[offset[node] + 2])
    return moved


@compiled
def _shared(chain: Chain, slots: Indices, landmarks: int) -> Indices:
    """Count, for each map after the first, its landmarks that another map has."""
    counts = np.zeros(landmarks, np.int64)
    for slot in slots:
        counts[slot] += 1
    known = np.zeros(len(chain.id_start) - 2, np.int64)
    for k in range(len(known)):
        for i in range(chain.id_start[k + 1], chain.id_start[k + 2]):
            known[k] += counts[slots[i]] > 1
    return known
