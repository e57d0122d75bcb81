"""Products and solutions of dense matrices with the same bits on every processor.

A BLAS uses other kernels, with other orders of sums, on other processors. Here an entry of a
product is one sum in the order of its index, whatever the shapes; parallel lanes hold different
entries. Arrays of three and more axes are stacks of matrices, as in NumPy.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation.dense_kernel import (
    factored,
    inner,
    inverse_from_factor,
    matrix_product,
    row_sums,
    solve_lower,
    solve_stack,
    solve_upper,
    stack_product,
)

Array = Float[np.ndarray, "..."]
Matrix = Float[np.ndarray, "n n"]


def product(a: Array, b: Array) -> Array:
    """Compute A B of matrices, vectors or stacks of them, as NumPy's `matmul`.

    Raises ValueError where A has not as many columns as B has rows.
    """
    if a.shape[-1] != b.shape[-2 if b.ndim > 1 else 0]:
        raise ValueError(f"no product of the shapes {a.shape} and {b.shape}")
    if a.dtype != np.float64 or not a.flags.carray:
        a = np.array(a, np.float64, order="C")
    if b.dtype != np.float64 or not b.flags.carray:
        b = np.array(b, np.float64, order="C")
    if b.ndim == 1:
        if a.ndim == 1:
            return np.asarray(inner(a, b))
        return row_sums(a.reshape(math.prod(a.shape[:-1]), len(b)), b).reshape(a.shape[:-1])
    if b.ndim == 2:
        if a.ndim == 2:
            return matrix_product(a, b)
        rows = a.reshape(math.prod(a.shape[:-1]), len(b))
        return matrix_product(rows, b).reshape(*a.shape[:-1], b.shape[1])
    one = a[None] if a.ndim == 1 else a
    if one.shape[:-2] != b.shape[:-2]:
        stack = np.broadcast_shapes(one.shape[:-2], b.shape[:-2])
        one = np.array(np.broadcast_to(one, (*stack, *one.shape[-2:])), order="C")
        b = np.array(np.broadcast_to(b, (*stack, *b.shape[-2:])), order="C")
    n, k, m = one.shape[-2], b.shape[-2], b.shape[-1]
    count = math.prod(b.shape[:-2])
    found = stack_product(one.reshape(count, n, k), b.reshape(count, k, m))
    return found.reshape(*b.shape[:-2], *((n, m) if a.ndim > 1 else (m,)))


def solve(A: Array, B: Array) -> Array:
    """Solve A⁻¹ B by elimination with partial pivoting; B is a vector, a matrix or a stack of
    these.

    Raises LinAlgError where A is singular.
    """
    right = B[:, None] if B.ndim == 1 else B
    n = A.shape[-1]
    stack = A.shape[:-2]
    if stack != right.shape[:-2]:
        stack = np.broadcast_shapes(stack, right.shape[:-2])
        A = np.broadcast_to(A, (*stack, n, n))
        right = np.broadcast_to(right, (*stack, *right.shape[-2:]))
    count = math.prod(stack)
    left = np.array(A, np.float64, order="C").reshape(count, n, n)
    solved = np.array(right, np.float64, order="C").reshape(count, n, right.shape[-1])
    if not solve_stack(left, solved):
        raise np.linalg.LinAlgError("Singular matrix")
    return solved.reshape(B.shape if B.ndim == 1 else right.shape)


def inverse(A: Array) -> Array:
    """Invert a matrix or each of a stack. Raises LinAlgError where one is singular."""
    return solve(A, np.broadcast_to(np.eye(A.shape[-1]), A.shape))


def cholesky(A: Matrix) -> Matrix:
    """Compute the lower L with L Lᵀ = A from the lower triangle of A.

    Raises LinAlgError where A is not positive definite.
    """
    L, definite = factored(np.array(A.T, np.float64, order="C"))
    if not definite:
        raise np.linalg.LinAlgError("Matrix is not positive definite")
    return L


def inverse_of_factored(L: Matrix) -> Matrix:
    """Compute (L Lᵀ)⁻¹ of a lower triangular L, exactly symmetric."""
    return inverse_from_factor(np.array(L, np.float64, order="C"))


def forward(L: Matrix, B: Array) -> Array:
    """Compute L⁻¹ B of a lower triangular L; B is a vector or a matrix."""
    solved = np.array(B, np.float64, order="C")
    solve_lower(np.array(L, np.float64, order="C"), _columns(solved))
    return solved


def solve_factored(L: Matrix, B: Array) -> Array:
    """Compute (L Lᵀ)⁻¹ B of a lower triangular L; B is a vector or a matrix."""
    solved = np.array(B, np.float64, order="C")
    right = _columns(solved)
    left = np.array(L, np.float64, order="C")
    solve_lower(left, right)
    solve_upper(left, right)
    return solved


def _columns(values: Array) -> Float[np.ndarray, "n k"]:
    """Reshape a vector to one column."""
    return values[:, None] if values.ndim == 1 else values
