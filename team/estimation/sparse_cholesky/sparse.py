"""Sparse symmetric positive definite systems of small blocks: A = L Lᵀ, solutions, inverse entries.

The analysis (order, structure) is separate from the numbers and holds while the pattern does not
change. The factor is stored by supernodes: neighbouring columns with (nearly) the same rows share
one dense panel (Davis 2006, "Direct Methods for Sparse Linear Systems", chapters 4 and 6). All sums
run in a fixed order.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.sparse_cholesky import sparse_kernel
from team.estimation.sparse_cholesky.ordering import minimum_degree
from team.estimation.sparse_cholesky.sparse_layout import Structure, supernodes, targets

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
COLUMNS_AT_ONCE = 64


class NotPositiveDefiniteError(ValueError):
    """A pivot of the factorisation is not positive: the block `variable` is undetermined."""

    def __init__(self, variable: int) -> None:
        super().__init__(f"the matrix is not positive definite: pivot of variable {variable}")
        self.variable = variable


@dataclass(frozen=True, eq=False)
class Pattern:
    """The stored blocks of the lower triangle of a symmetric matrix, and their places.

    sizes: unknowns of each block variable. Entry e with column_start[j] ≤ e < column_start[j + 1]
    is block (rows[e], j), rows[e] ≥ j; the first entry of each column is its diagonal block. The
    numbers of a matrix are one flat array: block e row-major from value_start[e] on, diagonal
    blocks as full squares.
    """

    sizes: Indices
    column_start: Indices
    rows: Indices

    def __post_init__(self) -> None:
        if not np.array_equal(self.rows[self.column_start[:-1]], np.arange(len(self.sizes))):
            raise ValueError("each column of a pattern begins with its diagonal block")

    @cached_property
    def columns(self) -> Indices:
        """Column of each entry."""
        return np.repeat(np.arange(len(self.sizes)), np.diff(self.column_start))

    @cached_property
    def value_start(self) -> Indices:
        """Index of each entry's first number; the last one is the total length."""
        areas = self.sizes[self.rows] * self.sizes[self.columns]
        return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(areas)])

    @cached_property
    def offset(self) -> Indices:
        """Index of each variable's first unknown; the last one is the number of unknowns."""
        return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(self.sizes)])

    @cached_property
    def diagonal(self) -> Indices:
        """Indices of the diagonal among the numbers of a matrix."""
        begin = np.repeat(self.value_start[self.column_start[:-1]], self.sizes)
        within = np.arange(self.offset[-1]) - np.repeat(self.offset[:-1], self.sizes)
        diagonal: Indices = begin + within * (np.repeat(self.sizes, self.sizes) + 1)
        return diagonal

    def diagonal_block(self, values: Values, variable: int) -> Float[np.ndarray, "k k"]:
        """Block (variable, variable) of a matrix on this pattern."""
        size = int(self.sizes[variable])
        begin = int(self.value_start[self.column_start[variable]])
        return values[begin : begin + size * size].reshape(size, size)

    def block(self, values: Values, row: int, column: int) -> Float[np.ndarray, "j k"]:
        """Block (row, column) of a symmetric matrix on this pattern; zero where none is stored."""
        lower, upper = max(row, column), min(row, column)
        begin, end = self.column_start[upper], self.column_start[upper + 1]
        found = begin + np.flatnonzero(self.rows[begin:end] == lower)
        if not len(found):
            return np.zeros((int(self.sizes[row]), int(self.sizes[column])))
        shape = int(self.sizes[lower]), int(self.sizes[upper])
        first = int(self.value_start[found[0]])
        stored = values[first : first + shape[0] * shape[1]].reshape(shape)
        return stored if row == lower else stored.T


@dataclass(frozen=True, eq=False)
class Analysis:
    """Index in the panels of L of each number of a pattern.

    permutation: position of each unknown in the elimination order. structure: the panels (see
    `sparse_layout`). target: index in the panels of each number of the pattern (the mirrored one
    for the upper half of a diagonal block).
    """

    pattern: Pattern
    permutation: Indices
    structure: Structure
    target: Indices


@dataclass(frozen=True, eq=False)
class Cholesky:
    """The panels of L with L Lᵀ = A (permuted)."""

    analysis: Analysis
    panels: Values


def analysed(pattern: Pattern) -> Analysis:
    """Analyse a pattern: order, symbolic factorisation and supernodes."""
    elimination = minimum_degree(pattern.sizes, pattern.column_start, pattern.rows)
    permutation, structure = supernodes(pattern.sizes, pattern.offset, *elimination)
    target = targets(
        pattern.sizes,
        pattern.offset,
        pattern.columns,
        pattern.rows,
        pattern.value_start,
        permutation,
        structure,
    )
    return Analysis(pattern, permutation, structure, target)


def factorised(analysis: Analysis, values: Values) -> Cholesky:
    """Factorise A = L Lᵀ. Raises NotPositiveDefiniteError that names the pivot's variable."""
    panels, failed = sparse_kernel.factorise(analysis.structure, analysis.target, values)
    if failed >= 0:
        unknown = int(np.flatnonzero(analysis.permutation == failed)[0])
        offset = analysis.pattern.offset
        raise NotPositiveDefiniteError(int(np.searchsorted(offset, unknown, side="right")) - 1)
    return Cholesky(analysis, panels)


def solved(cholesky: Cholesky, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Solve A X = right."""
    permutation = cholesky.analysis.permutation
    permuted = np.empty_like(right)
    permuted[permutation] = right
    sparse_kernel.solve_in_place(cholesky.analysis.structure, cholesky.panels, permuted, 0)
    solution: Float[np.ndarray, "n k"] = permuted[permutation]
    return solution


def inverse_columns(cholesky: Cholesky, unknowns: Indices) -> Float[np.ndarray, "n k"]:
    """Compute columns of A⁻¹: the covariance of `unknowns` with all unknowns."""
    permutation = cholesky.analysis.permutation
    return _columns(cholesky, permutation[unknowns], permutation, 0)


def inverse_block(cholesky: Cholesky, unknowns: Indices) -> Float[np.ndarray, "k k"]:
    """Compute A⁻¹ between these unknowns: their joint covariance, symmetric."""
    structure = cholesky.analysis.structure
    place = cholesky.analysis.permutation[unknowns]
    if sparse_kernel.has_big_panel(structure):
        order = np.argsort(place, kind="stable")
        block = np.empty((len(unknowns), len(unknowns)))
        block[np.ix_(order, order)] = sparse_kernel.inverse_among(
            structure, cholesky.panels, place[order]
        )
    else:
        supernode_of = structure[4]
        first = int(supernode_of[place].min(initial=len(supernode_of)))
        block = _columns(cholesky, place, place, first)
    symmetric: Float[np.ndarray, "k k"] = 0.5 * (block + block.T)
    return symmetric


def _columns(
    cholesky: Cholesky, chosen: Indices, requested: Indices, first: int
) -> Float[np.ndarray, "n k"]:
    """Compute the rows `requested` of columns of A⁻¹, both by their place in the order of
    elimination and none before supernode `first`.
    """
    columns = np.empty((len(requested), len(chosen)))
    for begin in range(0, len(chosen), COLUMNS_AT_ONCE):
        some = chosen[begin : begin + COLUMNS_AT_ONCE]
        unit = np.zeros((len(cholesky.analysis.permutation), len(some)))
        unit[some, np.arange(len(some))] = 1.0
        sparse_kernel.solve_in_place(cholesky.analysis.structure, cholesky.panels, unit, first)
        columns[:, begin : begin + len(some)] = unit[requested]
    return columns


def selected_inverse(cholesky: Cholesky) -> Values:
    """Compute the entries of A⁻¹ on the pattern of A, in the layout of A's numbers.

    Takahashi's recursion over the pattern of L, from the last supernode back (Takahashi, Fagan &
    Chin 1973): with Y = L_RJ L_JJ⁻¹, Z_RJ = −Z_RR Y and Z_JJ = (L_JJ L_JJᵀ)⁻¹ − Yᵀ Z_RJ.
    """
    analysis = cholesky.analysis
    entries: Values = sparse_kernel.takahashi(analysis.structure, cholesky.panels)[analysis.target]
    return entries
