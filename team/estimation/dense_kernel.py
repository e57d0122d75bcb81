"""The kernels of `team.estimation.dense`: every sum in the order of its index.

A vector register holds different entries, never parts of one sum, so its width changes no bit. Big
matrices are processed by tiles of columns and blocks of terms, copied so that the compiler can rule
out overlaps; four rows and four terms at once then keep most of the work in registers.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation.compiled import compiled

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]
Panel = Float[np.ndarray, "n k"]
TILE = 64
"""Columns of a product that are processed at once."""
DEPTH = 32
"""Terms of a sum that are added at once: with TILE columns they stay in the first cache."""
BLOCK = 32
"""Columns that are factored or solved by loops before a product subtracts them from the others."""


@compiled
def inner(a: Vector, b: Vector) -> float:
    """Σ aᵢ bᵢ in eight lanes, which are summed in pairs."""
    n = len(a)
    l0, l1, l2, l3, l4, l5, l6, l7 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    whole = n - n % 8
    for i in range(0, whole, 8):
        l0 += a[i] * b[i]
        l1 += a[i + 1] * b[i + 1]
        l2 += a[i + 2] * b[i + 2]
        l3 += a[i + 3] * b[i + 3]
        l4 += a[i + 4] * b[i + 4]
        l5 += a[i + 5] * b[i + 5]
        l6 += a[i + 6] * b[i + 6]
        l7 += a[i + 7] * b[i + 7]
    rest = 0.0
    for i in range(whole, n):
        rest += a[i] * b[i]
    total: float = (((l0 + l4) + (l2 + l6)) + ((l1 + l5) + (l3 + l7))) + rest
    return total


@compiled
def row_sums(a: Panel, x: Vector) -> Vector:
    """A x, eight rows at once."""
    n, k = a.shape
    sums = np.empty(n)
    whole = n - n % 8
    for i in range(0, whole, 8):
        s0, s1, s2, s3, s4, s5, s6, s7 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(k):
            f = x[p]
            s0 += a[i, p] * f
            s1 += a[i + 1, p] * f
            s2 += a[i + 2, p] * f
            s3 += a[i + 3, p] * f
            s4 += a[i + 4, p] * f
            s5 += a[i + 5, p] * f
            s6 += a[i + 6, p] * f
            s7 += a[i + 7, p] * f
        sums[i], sums[i + 1], sums[i + 2], sums[i + 3] = s0, s1, s2, s3
        sums[i + 4], sums[i + 5], sums[i + 6], sums[i + 7] = s4, s5, s6, s7
    for i in range(whole, n):
        total = 0.0
        for p in range(k):
            total += a[i, p] * x[p]
        sums[i] = total
    return sums


@compiled
def matrix_product(a: Float[np.ndarray, "n k"], b: Float[np.ndarray, "k m"]) -> Panel:
    """A B of two matrices."""
    n, k = a.shape
    m = b.shape[1]
    c = np.zeros((n, m))
    if n >= 4 and m > TILE // 2 and k >= 4:
        add_product(a, b, c, (0, 0), False, False)
        return c
    whole = k - k % 4
    for i in range(n):
        sums = c[i]
        for p in range(0, whole, 4):
            f0, f1, f2, f3 = a[i, p], a[i, p + 1], a[i, p + 2], a[i, p + 3]
            b0, b1, b2, b3 = b[p], b[p + 1], b[p + 2], b[p + 3]
            for j in range(m):
                sums[j] = (((sums[j] + f0 * b0[j]) + f1 * b1[j]) + f2 * b2[j]) + f3 * b3[j]
        for p in range(whole, k):
            factor = a[i, p]
            for j in range(m):
                sums[j] += factor * b[p, j]
    return c


@compiled
def stack_product(
    a: Float[np.ndarray, "s n k"], b: Float[np.ndarray, "s k m"]
) -> Float[np.ndarray, "s n m"]:
    """A B of each pair of matrices."""
    c = np.zeros((a.shape[0], a.shape[1], b.shape[2]))
    for s in range(len(a)):
        for i in range(a.shape[1]):
            for p in range(a.shape[2]):
                factor = a[s, i, p]
                for j in range(b.shape[2]):
                    c[s, i, j] += factor * b[s, p, j]
    return c


@compiled
def add_product(
    a: Float[np.ndarray, "n k"],
    b: Float[np.ndarray, "k m"],
    c: Panel,
    corner: tuple[int, int],
    upper: bool,
    lower: bool,
) -> None:
    """Compute C + A B in place from C's corner on; each entry adds its terms in order.

    `upper`: only the upper triangle of the square A B is required; tiles below may stay unchanged.
    `lower`: B is lower triangular; entries above its diagonal are not read, except within its
    tiles.
    """
    n, k = a.shape
    m = b.shape[1]
    top, left = corner
    packed, sums = np.zeros(DEPTH * TILE), np.zeros(4 * TILE)
    for begin in range(0, m, TILE):
        width = min(TILE, m - begin)
        rows = min(n, begin + width) if upper else n
        for first in range(begin if lower else 0, k, DEPTH):
            deep = min(DEPTH, k - first)
            for p in range(deep):
                target, source = packed[p * TILE : (p + 1) * TILE], b[first + p, begin:]
                for j in range(width):
                    target[j] = source[j]
            for i in range(0, rows, 4):
                high = min(4, rows - i)
                for r in range(high):
                    entries = c[top + i + r, left + begin :]
                    tile = sums[r * TILE : (r + 1) * TILE]
                    for j in range(width):
                        tile[j] = entries[j]
                _add_terms(a, packed, sums, (i, first), (high, deep))
                for r in range(high):
                    entries = c[top + i + r, left + begin :]
                    tile = sums[r * TILE : (r + 1) * TILE]
                    for j in range(width):
                        entries[j] = tile[j]


@compiled
def _add_terms(
    a: Panel, packed: Vector, sums: Vector, corner: tuple[int, int], shape: tuple[int, int]
) -> None:
    """Add to four rows of a tile the products of A's entries with the packed rows."""
    i, first = corner
    high, deep = shape
    a0, a1 = a[i], a[i + min(1, high - 1)]
    a2, a3 = a[i + min(2, high - 1)], a[i + min(3, high - 1)]
    whole = deep - deep % 4
    for p in range(0, whole, 4):
        q = first + p
        f00, f01, f02, f03 = a0[q], a0[q + 1], a0[q + 2], a0[q + 3]
        f10, f11, f12, f13 = a1[q], a1[q + 1], a1[q + 2], a1[q + 3]
        f20, f21, f22, f23 = a2[q], a2[q + 1], a2[q + 2], a2[q + 3]
        f30, f31, f32, f33 = a3[q], a3[q + 1], a3[q + 2], a3[q + 3]
        rows = packed[p * TILE : (p + 4) * TILE]
        for j in range(TILE):
            b0, b1, b2, b3 = rows[j], rows[TILE + j], rows[2 * TILE + j], rows[3 * TILE + j]
            sums[j] = (((sums[j] + f00 * b0) + f01 * b1) + f02 * b2) + f03 * b3
            sums[TILE + j] = (((sums[TILE + j] + f10 * b0) + f11 * b1) + f12 * b2) + f13 * b3
            sums[2 * TILE + j] = (
                ((sums[2 * TILE + j] + f20 * b0) + f21 * b1) + f22 * b2
            ) + f23 * b3
            sums[3 * TILE + j] = (
                ((sums[3 * TILE + j] + f30 * b0) + f31 * b1) + f32 * b2
            ) + f33 * b3
    for p in range(whole, deep):
        q = first + p
        f0, f1, f2, f3 = a0[q], a1[q], a2[q], a3[q]
        rows = packed[p * TILE : (p + 1) * TILE]
        for j in range(TILE):
            sums[j] += f0 * rows[j]
            sums[TILE + j] += f1 * rows[j]
            sums[2 * TILE + j] += f2 * rows[j]
            sums[3 * TILE + j] += f3 * rows[j]


@compiled
def _take(rows: Panel, i: int, factor: float, k: int, begin: int) -> None:
    for j in range(begin, rows.shape[1]):
        rows[i, j] -= factor * rows[k, j]


@compiled
def _divide(rows: Panel, k: int, by: float) -> None:
    for j in range(rows.shape[1]):
        rows[k, j] /= by


@compiled
def _exchange(rows: Panel, k: int, i: int) -> None:
    for j in range(rows.shape[1]):
        rows[k, j], rows[i, j] = rows[i, j], rows[k, j]


@compiled
def _solve_one(A: Matrix, B: Panel) -> bool:
    """Overwrite B with A⁻¹ B and A with the rest of the elimination; return False for a zero
    pivot.
    """
    n = len(A)
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[best, k]):
                best = i
        if A[best, k] == 0.0:
            return False
        if best != k:
            _exchange(A, k, best)
            _exchange(B, k, best)
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                _take(A, i, factor, k, k + 1)
                _take(B, i, factor, k, 0)
    for k in range(n - 1, -1, -1):
        _divide(B, k, A[k, k])
        for i in range(k):
            _take(B, i, A[i, k], k, 0)
    return True


@compiled
def solve_stack(A: Float[np.ndarray, "s n n"], B: Float[np.ndarray, "s n k"]) -> bool:
    """`_solve_one` of each of a stack."""
    solved = True
    for s in range(len(A)):
        solved = solved and _solve_one(A[s], B[s])
    return solved


@compiled
def factored(U: Matrix) -> tuple[Matrix, bool]:
    """Factor a matrix, whose upper triangle is read and overwritten; return also whether each pivot
    is positive, else the factor is invalid.
    """
    n = len(U)
    L = np.zeros((n, n))
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        for k in range(begin, end):
            pivot = U[k, k]
            if not 0.0 < pivot < math.inf:
                return L, False
            root = math.sqrt(pivot)
            for i in range(k, n):
                U[k, i] /= root
            for later in range(k + 1, end):
                _take(U, later, U[k, later], k, later)
        if end < n:
            rows, columns = _negative_transposed(U, begin, end), U[begin:end, end:].copy()
            add_product(rows, columns, U, (end, end), True, False)
    for k in range(n):
        for i in range(k, n):
            L[i, k] = U[k, i]
    return L, True


@compiled
def _negative_transposed(U: Matrix, begin: int, end: int) -> Panel:
    """Copy the part of rows begin … end − 1 after column `end`, transposed and negated."""
    rows = np.empty((len(U) - end, end - begin))
    for k in range(begin, end):
        for i in range(end, len(U)):
            rows[i - end, k - begin] = -U[k, i]
    return rows


@compiled
def solve_lower(L: Matrix, right: Panel) -> None:
    """Overwrite `right` with L⁻¹ right."""
    n, many = right.shape
    if many == 1:
        _solve_lower_one(L, right)
        return
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        if begin > 0:
            add_product(-L[begin:end, :begin], right[:begin], right, (begin, 0), False, False)
        for k in range(begin, end):
            for p in range(begin, k):
                _take(right, k, L[k, p], p, 0)
            _divide(right, k, L[k, k])


@compiled
def _solve_lower_one(L: Matrix, right: Panel) -> None:
    n = len(L)
    whole = n - n % 4
    for k in range(0, whole, 4):
        s0, s1, s2, s3 = right[k, 0], right[k + 1, 0], right[k + 2, 0], right[k + 3, 0]
        for p in range(k):
            f = right[p, 0]
            s0 -= L[k, p] * f
            s1 -= L[k + 1, p] * f
            s2 -= L[k + 2, p] * f
            s3 -= L[k + 3, p] * f
        s0 /= L[k, k]
        s1 = (s1 - L[k + 1, k] * s0) / L[k + 1, k + 1]
        s2 = ((s2 - L[k + 2, k] * s0) - L[k + 2, k + 1] * s1) / L[k + 2, k + 2]
        s3 = ((s3 - L[k + 3, k] * s0) - L[k + 3, k + 1] * s1) - L[k + 3, k + 2] * s2
        s3 /= L[k + 3, k + 3]
        right[k, 0], right[k + 1, 0], right[k + 2, 0], right[k + 3, 0] = s0, s1, s2, s3
    for k in range(whole, n):
        total = right[k, 0]
        for p in range(k):
            total -= L[k, p] * right[p, 0]
        right[k, 0] = total / L[k, k]


@compiled
def solve_upper(L: Matrix, right: Panel) -> None:
    """Overwrite `right` with L⁻ᵀ right."""
    n, many = right.shape
    if many == 1:
        for k in range(n - 1, -1, -1):
            right[k, 0] /= L[k, k]
            pivot = right[k, 0]
            for p in range(k):
                right[p, 0] -= L[k, p] * pivot
        return
    for begin in range((n - 1) // BLOCK * BLOCK, -1, -BLOCK):
        end = min(begin + BLOCK, n)
        for k in range(end - 1, begin - 1, -1):
            _divide(right, k, L[k, k])
            for p in range(begin, k):
                _take(right, p, L[k, p], k, 0)
        if begin > 0:
            rows = (-L[begin:end, :begin].T).copy()
            add_product(rows, right[begin:end], right, (0, 0), False, False)


@compiled
def inverse_from_factor(L: Matrix) -> Matrix:
    """(L Lᵀ)⁻¹ = R ᵀR, R = L⁻¹, exactly symmetric."""
    n = len(L)
    rows = np.eye(n)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        if begin > 0:
            before = rows[:begin, :begin].copy()
            add_product(-L[begin:end, :begin], before, rows, (begin, 0), False, True)
        for k in range(begin, end):
            for p in range(begin, k):
                factor = L[k, p]
                for c in range(p + 1):
                    rows[k, c] -= factor * rows[p, c]
            for c in range(k + 1):
                rows[k, c] /= L[k, k]
    result = np.zeros((n, n))
    if n < BLOCK:
        for k in range(n):
            for i in range(k + 1):
                _add_row(result, i, rows[k, i], rows[k], i, k + 1)
    else:
        add_product(rows.T.copy(), rows, result, (0, 0), True, True)
    for i in range(n):
        for j in range(i):
            result[i, j] = result[j, i]
    return result


@compiled
def _add_row(result: Matrix, i: int, factor: float, row: Vector, begin: int, end: int) -> None:
    for j in range(begin, end):
        result[i, j] += factor * row[j]


EPSILON = float(np.finfo(np.float64).eps)
NOT_FINITE, NOT_POSITIVE, NOT_SYMMETRIC = 1, 2, 3


@compiled
def fault_of(P: Matrix) -> tuple[int, Float[np.ndarray, " n"]]:
    """The index in FAULTS of what is seen of a matrix without factoring it; and the roots of its
    diagonal.
    """
    n = len(P)
    sigmas = np.empty(n)
    for i in range(n):
        for j in range(n):
            if not math.isfinite(P[i, j]):
                return NOT_FINITE, sigmas
    for i in range(n):
        if not P[i, i] > 0.0:
            return NOT_POSITIVE, sigmas
        sigmas[i] = math.sqrt(P[i, i])
    for i in range(n):
        for j in range(i):
            if abs(P[i, j] - P[j, i]) > 1e-9 * sigmas[i] * sigmas[j]:
                return NOT_SYMMETRIC, sigmas
    return 0, sigmas


@compiled
def factor_or_fault(P: Matrix) -> tuple[Matrix, int]:
    """The factor of `cholesky_factor`, and the index in FAULTS of why there is none."""
    n = len(P)
    fault, sigmas = fault_of(P)
    if fault:
        return P, fault
    factor, definite = factored(P.T.copy())
    if not definite:
        return P, NOT_POSITIVE
    for i in range(n):
        pivot = factor[i, i] / sigmas[i]
        if pivot * pivot <= n * EPSILON:
            return P, NOT_POSITIVE
    return factor, 0
