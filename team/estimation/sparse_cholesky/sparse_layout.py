"""The layout of a block-sparse symmetric matrix in the panels of its Cholesky factor.

A supernode is a run of columns with (nearly) the same rows; its panel is the dense m × w matrix of
those rows and columns, column-major, its own columns being the first w rows.
"""

from typing import TypeAlias

import numpy as np
from jaxtyping import Int64

from team.estimation.compiled import compiled
from team.estimation.placing import put

Indices = Int64[np.ndarray, " _"]
Structure: TypeAlias = tuple[Indices, Indices, Indices, Indices, Indices]
"""(columns_of, row_start, row, panel_start, supernode_of): supernode s has the permuted unknowns
columns_of[s] … columns_of[s + 1] − 1 as columns and row[row_start[s] : row_start[s + 1]] as rows;
its panel begins at panel_start[s]; supernode_of[column] is its number.
"""
PADDING = 0.25
"""Supernodes grow while explicit zeros are less than this share of the panel."""


@compiled
def _supernode_begins(first: Indices, below: Indices, parent: Indices) -> Indices:
    """Return the first block of each supernode, and the number of blocks at the end.

    A block joins the supernode before it if it is the parent of that supernode's last block; the
    rows of the earlier blocks are then among the columns and rows of the later one.
    """
    n = len(below)
    begins = np.zeros(n + 1, dtype=np.int64)
    count = 0
    stored = 0
    for k in range(n):
        width = first[k + 1] - first[k]
        own = width * (width + below[k])
        if k > 0 and parent[k - 1] == k:
            wide = first[k + 1] - first[begins[count - 1]]
            if wide * (wide + below[k]) <= (1.0 + PADDING) * (stored + own) + 0.5 * wide * wide:
                stored += own
                continue
        begins[count] = k
        stored = own
        count += 1
    begins[count] = n
    return begins[: count + 1].copy()


@compiled
def supernodes(
    sizes: Indices,
    offset: Indices,
    order: Indices,
    parent: Indices,
    start: Indices,
    structure: Indices,
) -> tuple[Indices, Structure]:
    """Gather neighbouring blocks of the elimination into panels, in numbers of unknowns.

    Returns the position of each unknown in the elimination order, and the panels' structure.
    """
    n = len(order)
    first = np.zeros(n + 1, dtype=np.int64)
    below = np.zeros(n, dtype=np.int64)
    permutation = np.empty(offset[n], dtype=np.int64)
    for k in range(n):
        first[k + 1] = first[k] + sizes[order[k]]
        for unknown in range(sizes[order[k]]):
            permutation[offset[order[k]] + unknown] = first[k] + unknown
    for k in range(n):
        for later in structure[start[k] : start[k + 1]]:
            below[k] += sizes[order[later]]
    begins = _supernode_begins(first, below, parent)
    columns_of = first[begins]
    count = len(begins) - 1
    row_start = np.zeros(count + 1, dtype=np.int64)
    panel_start = np.zeros(count + 1, dtype=np.int64)
    supernode_of = np.empty(first[n], dtype=np.int64)
    for s in range(count):
        width = columns_of[s + 1] - columns_of[s]
        height = width + below[begins[s + 1] - 1]
        row_start[s + 1] = row_start[s] + height
        panel_start[s + 1] = panel_start[s] + width * height
        for column in range(columns_of[s], columns_of[s + 1]):
            supernode_of[column] = s
    row = np.empty(row_start[count], dtype=np.int64)
    for s in range(count):
        last = begins[s + 1] - 1
        at = row_start[s] + columns_of[s + 1] - columns_of[s]
        put(row, row_start[s], np.arange(columns_of[s], columns_of[s + 1]))
        for later in structure[start[last] : start[last + 1]]:
            size = sizes[order[later]]
            put(row, at, np.arange(first[later], first[later] + size))
            at += size
    return permutation, (columns_of, row_start, row, panel_start, supernode_of)


@compiled
def targets(
    sizes: Indices,
    offset: Indices,
    columns: Indices,
    rows: Indices,
    value_start: Indices,
    permutation: Indices,
    structure: Structure,
) -> Indices:
    """Find the index in the panels of each number of a pattern.

    The unknowns of a block variable are neighbours in the order of elimination and in each panel's
    rows, so one of them is searched for.
    """
    columns_of, row_start, row, panel_start, supernode_of = structure
    target = np.empty(value_start[-1], dtype=np.int64)
    for e in range(len(rows)):
        i, j = permutation[offset[rows[e]]], permutation[offset[columns[e]]]
        first = max(i, j)
        s = supernode_of[min(i, j)]
        begin, end = row_start[s], row_start[s + 1]
        at = np.searchsorted(row[begin:end], first) - first
        wide = sizes[columns[e]]
        for p in range(sizes[rows[e]]):
            for q in range(wide):
                low, high = min(i + p, j + q), max(i + p, j + q)
                target[value_start[e] + p * wide + q] = (
                    panel_start[s] + (low - columns_of[s]) * (end - begin) + at + high
                )
    return target
