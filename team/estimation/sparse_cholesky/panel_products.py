"""Dense algebra on big panels by blocks, mostly matrix products.

A panel is Lᵀ on a supernode's columns J, a row per column of L (see `sparse_layout`); R are the
rows below J (docs/decisions/27).
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation.compiled import compiled, inlined
from team.estimation.dense_kernel import matrix_product
from team.estimation.placing import put_block

Values = Float[np.ndarray, " _"]
ROWS = 256
WIDTH = 16
"""Number of rows, and of columns, from which a panel is big."""
BLOCK = 48
"""Number of columns that are factorised, solved or inverted by loops."""
CHUNK = 64
"""Number of rows of a product that are in memory at once."""


@compiled
def is_big(width: int, m: int) -> bool:
    """Whether matrix products are faster than loops for a panel of this shape."""
    return m >= ROWS and width >= WIDTH


@inlined
def add_products(
    target: Values, factors: Values, rows: Float[np.ndarray, "k m"], column: int, sign: float
) -> None:
    """Add Σ sign · factors[k] · rows[k, column:] in place, row by row, four at once."""
    n, count = len(target), len(factors)
    whole = count - count % 4
    for k in range(0, whole, 4):
        r0, r1 = rows[k, column:], rows[k + 1, column:]
        r2, r3 = rows[k + 2, column:], rows[k + 3, column:]
        f0, f1 = sign * factors[k], sign * factors[k + 1]
        f2, f3 = sign * factors[k + 2], sign * factors[k + 3]
        for i in range(n):
            target[i] = (((target[i] + f0 * r0[i]) + f1 * r1[i]) + f2 * r2[i]) + f3 * r3[i]
    for k in range(whole, count):
        row = rows[k, column:]
        factor = sign * factors[k]
        for i in range(n):
            target[i] += factor * row[i]


@inlined
def factorise_columns(panel: Float[np.ndarray, "w m"], begin: int, end: int, least: Values) -> int:
    """Factorise these columns (dense Cholesky) in place; later columns are not changed.

    Returns the first column whose pivot is ≤ least, else −1.
    """
    for first in range(begin, end, 4):
        behind = min(first + 4, end)
        for k in range(first, behind):
            pivot = panel[k, k]
            if not pivot > least[k]:
                return k
            row, root = panel[k, k:], math.sqrt(pivot)
            for i in range(len(row)):
                row[i] /= root
            for later in range(k + 1, behind):
                add_products(panel[later, later:], panel[k : k + 1, later], panel[k:], later, -1.0)
        for later in range(behind, end):
            factors = panel[first:behind, later]
            add_products(panel[later, later:], factors, panel[first:], later, -1.0)
    return -1


@compiled
def factorise_by_blocks(panel: Float[np.ndarray, "w m"], least: Values) -> int:
    """Factorise all columns: each block by loops, then subtract its product from the later ones."""
    width, m = panel.shape
    for begin in range(0, width, BLOCK):
        end = min(begin + BLOCK, width)
        failed = factorise_columns(panel, begin, end, least)
        if failed >= 0:
            return failed
        columns = np.ascontiguousarray(panel[begin:end, end:])
        for first in range(0, width - end, CHUNK):
            product = rows_of_product(columns, first, min(first + CHUNK, width - end))
            for j in range(len(product)):
                later = end + first + j
                for i in range(later, m):
                    panel[later, i] -= product[j, i - end - first]
    return -1


@compiled
def rows_of_product(
    columns: Float[np.ndarray, "w h"], first: int, last: int
) -> Float[np.ndarray, "c _"]:
    """Compute rows first … last − 1 of Aᵀ A, from column `first` on."""
    rows = np.ascontiguousarray(columns[:, first:last].T)
    return matrix_product(rows, np.ascontiguousarray(columns[:, first:]))


@compiled
def inverse_by_blocks(panel: Float[np.ndarray, "w m"]) -> Float[np.ndarray, "w w"]:
    """Invert a panel's triangle: L_JJ⁻ᵀ.

    With L = (A 0; B C): L⁻¹ = (A⁻¹ 0; −C⁻¹ B A⁻¹  C⁻¹), one block of rows after the other.
    """
    width = len(panel)
    inverse = np.zeros((width, width))
    for begin in range(0, width, BLOCK):
        end = min(begin + BLOCK, width)
        own = np.zeros((end - begin, end - begin))
        for k in range(begin, end):
            own[k - begin, k - begin] = 1.0 / panel[k, k]
            for i in range(k + 1, end):
                total = 0.0
                for p in range(k, i):
                    total += panel[p, i] * own[k - begin, p - begin]
                own[k - begin, i - begin] = -total / panel[i, i]
        put_block(inverse, begin, begin, own)
        if begin > 0:
            before = np.ascontiguousarray(inverse[:begin, :begin])
            coupled = matrix_product(before, np.ascontiguousarray(panel[:begin, begin:end]))
            put_block(inverse, 0, begin, -matrix_product(coupled, own))
    return inverse


@compiled
def selected_by_blocks(
    panel: Float[np.ndarray, "w m"],
    known: Float[np.ndarray, "h h"],
    result: Float[np.ndarray, "w m"],
) -> None:
    """Takahashi's step: Z_RJ = −Z_RR Y and Z_JJ = L_JJ⁻ᵀ L_JJ⁻¹ − Yᵀ Z_RJ, Y = L_RJ L_JJ⁻¹."""
    width, m = panel.shape
    inverse = inverse_by_blocks(panel)
    for first in range(0, width, CHUNK):
        rest = np.ascontiguousarray(inverse[first:, first:])
        own = matrix_product(rest[:CHUNK], np.ascontiguousarray(rest.T))
        for j in range(len(own)):
            for k in range(first + j, width):
                result[first + j, k] = own[j, k - first]
    if m > width:
        y = matrix_product(inverse, np.ascontiguousarray(panel[:, width:]))
        below = matrix_product(y, known)
        coupled = matrix_product(below, np.ascontiguousarray(y.T))
        for k in range(width):
            for later in range(k, width):
                result[k, later] += coupled[k, later]
            for i in range(width, m):
                result[k, i] = -below[k, i - width]


@compiled
def solve_forward(panel: Float[np.ndarray, "w m"], right: Float[np.ndarray, "w k"]) -> None:
    """Overwrite `right` with L_JJ⁻¹ right."""
    width, many = right.shape
    for begin in range(0, width, BLOCK):
        end = min(begin + BLOCK, width)
        for k in range(begin, end):
            for c in range(many):
                right[k, c] /= panel[k, k]
            for i in range(k + 1, end):
                factor = panel[k, i]
                for c in range(many):
                    right[i, c] -= factor * right[k, c]
        if end < width:
            later = np.ascontiguousarray(panel[begin:end, end:width])
            product = matrix_product(np.ascontiguousarray(later.T), right[begin:end])
            for i in range(end, width):
                for c in range(many):
                    right[i, c] -= product[i - end, c]
