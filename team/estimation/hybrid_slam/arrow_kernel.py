"""Solves A X = B of a chain of poses with landmarks: A's blocks lie on an arrow.

Each pose is connected with the poses next to it and with any landmark, no landmark with another.
The Cholesky factor has the same zeros among the poses, so only what is not zero is worked. Terms
are taken in the order of `dense_kernel`'s functions, whose bits these are: a product with zero
changes none.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation.compiled import compiled
from team.estimation.dense_kernel import BLOCK, EPSILON, NOT_POSITIVE, fault_of

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]
Panel = Float[np.ndarray, "n k"]


@compiled
def solve_arrow(A: Matrix, right: Panel, poses: int) -> int:
    """Overwrite `right` with A⁻¹ right; returns why there is no solution, an index in
    `gaussian.FAULTS`.

    poses: number of A's first unknowns that are poses, three for each. The lower triangle is read.
    """
    fault, sigmas = fault_of(A)
    if fault:
        return fault
    U = A.T.copy()
    if not _factor(U, poses):
        return NOT_POSITIVE
    for i in range(len(U)):
        pivot = U[i, i] / sigmas[i]
        if pivot * pivot <= len(U) * EPSILON:
            return NOT_POSITIVE
    _solve_lower(U, right, poses)
    _solve_upper(U, right, poses)
    return 0


@compiled
def _factor(U: Matrix, poses: int) -> bool:
    """Overwrite the upper triangle with the factor's transpose; whether each pivot is positive."""
    n = len(U)
    for pose in range(0, poses, 3):
        near = min(pose + 6, poses)
        for k in range(pose, pose + 3):
            if not _divide(U, k, near, poses):
                return False
            for later in range(k + 1, pose + 3):
                _take_row(U, later, k, later, near)
                _take_row(U, later, k, poses, n)
        a, b, c = U[pose], U[pose + 1], U[pose + 2]
        for later in range(pose + 3, near):
            _take_three(U[later], a, b, c, later, later, near)
            _take_three(U[later], a, b, c, later, poses, n)
        for later in range(poses, n):
            if a[later] != 0.0 or b[later] != 0.0 or c[later] != 0.0:
                _take_three(U[later], a, b, c, later, later, n)
    for k in range(poses, n):
        if not _divide(U, k, k, k):
            return False
        for later in range(k + 1, n):
            _take_row(U, later, k, later, n)
    return True


@compiled
def _take_row(U: Matrix, later: int, k: int, begin: int, end: int) -> None:
    """From columns begin … end − 1 of a row the multiple of row k by its column `later`."""
    factor = U[k, later]
    for j in range(begin, end):
        U[later, j] -= factor * U[k, j]


@compiled
def _divide(U: Matrix, k: int, near: int, behind: int) -> bool:
    """Divides row k by the root of its pivot, up to column `near` and from `behind` on; whether
    the pivot is positive.
    """
    if not 0.0 < U[k, k] < math.inf:
        return False
    root = math.sqrt(U[k, k])
    for i in range(k, near):
        U[k, i] /= root
    for i in range(behind, len(U)):
        U[k, i] /= root
    return True


@compiled
def _take_three(
    row: Vector, a: Vector, b: Vector, c: Vector, later: int, begin: int, end: int
) -> None:
    """From columns begin … end − 1 of a row the multiples of three rows by their column `later`."""
    of_a, of_b, of_c = a[later], b[later], c[later]
    for j in range(begin, end):
        row[j] = ((row[j] - of_a * a[j]) - of_b * b[j]) - of_c * c[j]


@compiled
def _take(right: Panel, i: int, factor: float, k: int) -> None:
    """Row i less `factor` times row k."""
    if factor != 0.0:
        for j in range(right.shape[1]):
            right[i, j] -= factor * right[k, j]


@compiled
def _first(k: int, poses: int) -> int:
    """The first unknown that A or its factor connects with unknown k."""
    return max(k - k % 3 - 3, 0) if k < poses else 0


@compiled
def _solve_lower(U: Matrix, right: Panel, poses: int) -> None:
    """Overwrite `right` with U⁻ᵀ right."""
    for k in range(len(U)):
        for p in range(_first(k, poses), k):
            _take(right, k, U[p, k], p)
        for j in range(right.shape[1]):
            right[k, j] /= U[k, k]


@compiled
def _solve_upper(U: Matrix, right: Panel, poses: int) -> None:
    """Overwrite `right` with U⁻¹ right."""
    n = len(U)
    for begin in range((n - 1) // BLOCK * BLOCK, -1, -BLOCK):
        end = min(begin + BLOCK, n)
        for k in range(end - 1, begin - 1, -1):
            for j in range(right.shape[1]):
                right[k, j] /= U[k, k]
            for p in range(max(begin, _first(k, poses)), k):
                _take(right, p, U[p, k], k)
        for k in range(begin, end):
            for p in range(_first(k, poses), begin):
                _take(right, p, U[p, k], k)
