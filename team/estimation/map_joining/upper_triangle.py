"""Symmetric matrices stored as upper triangles: the covariance of landmarks at rest."""

import numpy as np

from teamslam.team.shapes import Float, Int64

Indices = Int64[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


def upper_of(upper: Matrix, chosen: Indices, size: int) -> Float[np.ndarray, "m m"]:
    """Return the upper triangle among these ascending numbers, at the corner of a larger matrix."""
    result = np.zeros((size, size))
    for a, row in enumerate(chosen.tolist()):
        result[a, a : len(chosen)] = upper[row, chosen[a:]]
    return result


def packed_of(upper: Matrix) -> Float[np.ndarray, " _"]:
    """Pack the upper triangle, row after row."""
    return np.concatenate([np.zeros(0), *(row[a:] for a, row in enumerate(upper))])


def unpacked_of(packed: Float[np.ndarray, " _"], size: int) -> Matrix:
    """Unpack to a square matrix with zeros below the diagonal."""
    result, at = np.zeros((size, size)), 0
    for a in range(size):
        result[a, a:] = packed[at : at + size - a]
        at += size - a
    return result


def between(upper: Matrix, rows: Indices, columns: Indices) -> Float[np.ndarray, "r c"]:
    """Return the entries of these rows and columns of a symmetric matrix stored as upper
    triangle.
    """
    entries: Float[np.ndarray, "r c"] = upper[
        np.minimum.outer(rows, columns), np.maximum.outer(rows, columns)
    ]
    return entries
