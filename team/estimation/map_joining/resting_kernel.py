"""Compiled kernels of resting landmarks, whose covariance is stored as an upper triangle."""

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.compiled import compiled
from team.estimation.dense_kernel import inner

Indices = Int64[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


@compiled
def upper_of(upper: Matrix, chosen: Indices, size: int) -> Matrix:
    """Return the upper triangle among these ascending numbers, at the corner of a larger matrix."""
    result = np.zeros((size, size))
    for a in range(len(chosen)):
        source, target = upper[chosen[a]], result[a]
        for b in range(a, len(chosen)):
            target[b] = source[chosen[b]]
    return result


@compiled
def packed_of(upper: Matrix) -> Float[np.ndarray, " _"]:
    """Pack the upper triangle, row after row."""
    n = len(upper)
    result = np.empty(n * (n + 1) // 2)
    at = 0
    for a in range(n):
        for b in range(a, n):
            result[at] = upper[a, b]
            at += 1
    return result


@compiled
def unpacked_of(packed: Float[np.ndarray, " _"], size: int) -> Matrix:
    """Unpack to a square matrix with zeros below the diagonal."""
    result = np.zeros((size, size))
    at = 0
    for a in range(size):
        for b in range(a, size):
            result[a, b] = packed[at]
            at += 1
    return result


@compiled
def between(upper: Matrix, rows: Indices, columns: Indices) -> Float[np.ndarray, "r c"]:
    """Return the entries of these rows and columns of a symmetric matrix stored as upper
    triangle.
    """
    result = np.empty((len(rows), len(columns)))
    for a in range(len(rows)):
        for b in range(len(columns)):
            i, j = rows[a], columns[b]
            result[a, b] = upper[i, j] if i <= j else upper[j, i]
    return result


@compiled
def symmetric_of(
    values: Float[np.ndarray, " _"],
    sizes: Indices,
    entry: Indices,
    value_start: Indices,
    numbers: int,
) -> Matrix:
    """Make the dense symmetric matrix over some nodes, from the values of a block pattern.

    entry: the pattern's entries of each pair of nodes, −1 where the first is the smaller one.
    """
    result = np.zeros((numbers, numbers))
    count = len(sizes)
    row = 0
    for a in range(count):
        column = 0
        for b in range(count):
            at = entry[a * count + b]
            if at >= 0:
                base = value_start[at]
                for p in range(sizes[a]):
                    for q in range(sizes[b]):
                        value = values[base + p * sizes[b] + q]
                        result[row + p, column + q] = value
                        result[column + q, row + p] = value
            column += sizes[b]
        row += sizes[a]
    return result


@compiled
def own_blocks(upper: Matrix, spread: Float[np.ndarray, "r n"]) -> Float[np.ndarray, "L 2 2"]:
    """Return the 2 × 2 diagonal blocks of C + S Sᵀ."""
    result = np.empty((len(spread) // 2, 2, 2))
    for k in range(len(result)):
        x, y = spread[2 * k], spread[2 * k + 1]
        cross = inner(x, y)
        result[k, 0, 0] = upper[2 * k, 2 * k] + inner(x, x)
        result[k, 0, 1] = upper[2 * k, 2 * k + 1] + cross
        result[k, 1, 0] = result[k, 0, 1]
        result[k, 1, 1] = upper[2 * k + 1, 2 * k + 1] + inner(y, y)
    return result
