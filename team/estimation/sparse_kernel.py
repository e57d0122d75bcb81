"""The kernels of the sparse Cholesky factorisation; values and meanings are in `sparse`.

A panel is a dense column-major m × w array: the w columns of a supernode on its m rows, the first w
of which are its own columns. Inner loops add a multiple of one contiguous column to another, which
a compiler turns into vector instructions without changing the order of any sum.
"""

import math
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.compiled import compiled

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Structure: TypeAlias = tuple[Indices, Indices, Indices, Indices, Indices]
PIVOT_TOLERANCE = 1e-14
"""A pivot below this part of its diagonal entry is rounding noise: the unknown is undetermined."""
PADDING = 0.25
"""Supernodes grow while explicit zeros are less than this part of the panel."""


@compiled
def supernodes(
    sizes: Indices,
    offset: Indices,
    order: Indices,
    parent: Indices,
    start: Indices,
    structure: Indices,
) -> tuple[Indices, Indices, Indices, Indices, Indices, Indices]:
    """Neighbouring blocks of the elimination gathered into panels, in numbers of unknowns.

    A block joins the supernode before it if it is the parent of that supernode's last block; the
    rows of the earlier blocks are then among the columns and rows of the later one.
    """
    n = len(order)
    first = np.zeros(n + 1, dtype=np.int64)
    below = np.zeros(n, dtype=np.int64)
    for k in range(n):
        first[k + 1] = first[k] + sizes[order[k]]
    for k in range(n):
        for e in range(start[k], start[k + 1]):
            below[k] += sizes[order[structure[e]]]
    begins = np.zeros(n + 1, dtype=np.int64)
    count = 0
    stored = 0
    for k in range(n):
        width = sizes[order[k]]
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
    columns_of = np.zeros(count + 1, dtype=np.int64)
    row_start = np.zeros(count + 1, dtype=np.int64)
    panel_start = np.zeros(count + 1, dtype=np.int64)
    supernode_of = np.empty(first[n], dtype=np.int64)
    for s in range(count):
        last = begins[s + 1] - 1
        columns_of[s + 1] = first[last + 1]
        width = columns_of[s + 1] - columns_of[s]
        row_start[s + 1] = row_start[s] + width + below[last]
        panel_start[s + 1] = panel_start[s] + width * (width + below[last])
        supernode_of[columns_of[s] : columns_of[s + 1]] = s
    row = np.empty(row_start[count], dtype=np.int64)
    for s in range(count):
        last = begins[s + 1] - 1
        at = row_start[s]
        for column in range(columns_of[s], columns_of[s + 1]):
            row[at] = column
            at += 1
        for e in range(start[last], start[last + 1]):
            for unknown in range(first[structure[e]], first[structure[e] + 1]):
                row[at] = unknown
                at += 1
    permutation = np.empty(first[n], dtype=np.int64)
    for k in range(n):
        for unknown in range(sizes[order[k]]):
            permutation[offset[order[k]] + unknown] = first[k] + unknown
    return permutation, columns_of, row_start, row, panel_start, supernode_of


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
    """Place in the panels of each number of a pattern."""
    columns_of, row_start, row, panel_start, supernode_of = structure
    target = np.empty(value_start[-1], dtype=np.int64)
    for e in range(len(rows)):
        i, j = rows[e], columns[e]
        for p in range(sizes[i]):
            for q in range(sizes[j]):
                low = min(permutation[offset[i] + p], permutation[offset[j] + q])
                high = max(permutation[offset[i] + p], permutation[offset[j] + q])
                s = supernode_of[low]
                begin, end = row_start[s], row_start[s + 1]
                at = np.searchsorted(row[begin:end], high)
                target[value_start[e] + p * sizes[j] + q] = (
                    panel_start[s] + (low - columns_of[s]) * (end - begin) + at
                )
    return target


@compiled
def _places(wanted: Indices, present: Indices, place: Indices) -> None:
    """place[i] := index of wanted[i] in `present`; both ascending, all wanted are present."""
    at = 0
    for i in range(len(wanted)):
        while present[at] != wanted[i]:
            at += 1
        place[i] = at


@compiled
def factorise(structure: Structure, target: Indices, values: Values) -> tuple[Values, int]:
    """Panels of L, and the permuted unknown whose pivot is not positive (−1 if all are).

    Right-looking: a supernode's dense factorisation, then its outer product L_RJ L_RJᵀ is taken
    from the panels of the rows that it reaches.
    """
    columns_of, row_start, row, panel_start, supernode_of = structure
    panels = np.zeros(panel_start[-1])
    for k in range(len(target)):
        panels[target[k]] = values[k]
    diagonal = np.empty(columns_of[-1])
    for s in range(len(columns_of) - 1):
        m = row_start[s + 1] - row_start[s]
        for k in range(columns_of[s + 1] - columns_of[s]):
            diagonal[columns_of[s] + k] = panels[panel_start[s] + k * m + k]
    longest = np.max(np.diff(row_start))
    place = np.empty(longest, dtype=np.int64)
    update = np.empty(longest)
    for s in range(len(columns_of) - 1):
        width = columns_of[s + 1] - columns_of[s]
        rows = row[row_start[s] : row_start[s + 1]]
        m = len(rows)
        panel = panels[panel_start[s] : panel_start[s + 1]].reshape(width, m)
        for k in range(width):
            pivot = panel[k, k]
            if not pivot > PIVOT_TOLERANCE * diagonal[columns_of[s] + k]:
                return panels, columns_of[s] + k
            root = math.sqrt(pivot)
            for i in range(k, m):
                panel[k, i] /= root
            for later in range(k + 1, width):
                factor = panel[k, later]
                for i in range(later, m):
                    panel[later, i] -= factor * panel[k, i]
        reached = -1
        begin = 0
        for j in range(width, m):
            t = supernode_of[rows[j]]
            high = row_start[t + 1] - row_start[t]
            if t != reached:
                reached = t
                begin = j
                _places(rows[j:], row[row_start[t] : row_start[t + 1]], place)
            for i in range(j, m):
                update[i] = panel[0, j] * panel[0, i]
            for k in range(1, width):
                factor = panel[k, j]
                for i in range(j, m):
                    update[i] += factor * panel[k, i]
            column = panel_start[t] + (rows[j] - columns_of[t]) * high
            for i in range(j, m):
                panels[column + place[i - begin]] -= update[i]
    return panels, -1


@compiled
def solve_in_place(structure: Structure, panels: Values, right: Float[np.ndarray, "n k"]) -> None:
    """Overwrite `right` with (L Lᵀ)⁻¹ right."""
    columns_of, row_start, row, panel_start, _ = structure
    count = len(columns_of) - 1
    many = right.shape[1]
    for s in range(count):
        width = columns_of[s + 1] - columns_of[s]
        rows = row[row_start[s] : row_start[s + 1]]
        m = len(rows)
        panel = panels[panel_start[s] : panel_start[s + 1]].reshape(width, m)
        for k in range(width):
            pivot = right[rows[k]]
            for c in range(many):
                pivot[c] /= panel[k, k]
            for i in range(k + 1, m):
                factor = panel[k, i]
                other = right[rows[i]]
                for c in range(many):
                    other[c] -= factor * pivot[c]
    for s in range(count - 1, -1, -1):
        width = columns_of[s + 1] - columns_of[s]
        rows = row[row_start[s] : row_start[s + 1]]
        m = len(rows)
        panel = panels[panel_start[s] : panel_start[s + 1]].reshape(width, m)
        for k in range(width - 1, -1, -1):
            pivot = right[rows[k]]
            for i in range(k + 1, m):
                factor = panel[k, i]
                other = right[rows[i]]
                for c in range(many):
                    pivot[c] -= factor * other[c]
            for c in range(many):
                pivot[c] /= panel[k, k]


@compiled
def takahashi(structure: Structure, panels: Values) -> Values:
    """The entries of (L Lᵀ)⁻¹ on the pattern of L, lower triangle, in panels like L's."""
    columns_of, row_start, row, panel_start, supernode_of = structure
    inverse = np.zeros_like(panels)
    longest = np.max(np.diff(row_start))
    place = np.empty(longest, dtype=np.int64)
    known = np.empty((longest, longest))
    for s in range(len(columns_of) - 2, -1, -1):
        width = columns_of[s + 1] - columns_of[s]
        rows = row[row_start[s] : row_start[s + 1]]
        m = len(rows)
        panel = panels[panel_start[s] : panel_start[s + 1]].reshape(width, m)
        result = inverse[panel_start[s] : panel_start[s + 1]].reshape(width, m)
        reached = -1
        begin = 0
        for j in range(width, m):
            t = supernode_of[rows[j]]
            high = row_start[t + 1] - row_start[t]
            if t != reached:
                reached = t
                begin = j
                _places(rows[j:], row[row_start[t] : row_start[t + 1]], place)
            column = panel_start[t] + (rows[j] - columns_of[t]) * high
            for i in range(j, m):
                known[j, i] = inverse[column + place[i - begin]]
                known[i, j] = known[j, i]
        # y = L_RJ L_JJ⁻¹ on the rows below, L_JJ⁻¹ (transposed, by columns) on the rows within.
        y = np.zeros((width, m))
        for k in range(width):
            y[k, k] = 1.0 / panel[k, k]
            for i in range(k + 1, width):
                total = 0.0
                for p in range(k, i):
                    total += panel[p, i] * y[k, p]
                y[k, i] = -total / panel[i, i]
        for k in range(width - 1, -1, -1):
            for i in range(width, m):
                y[k, i] = panel[k, i]
            for later in range(k + 1, width):
                factor = panel[k, later]
                for i in range(width, m):
                    y[k, i] -= factor * y[later, i]
            for i in range(width, m):
                y[k, i] /= panel[k, k]
        for k in range(width):
            for j in range(width, m):
                factor = y[k, j]
                for i in range(width, m):
                    result[k, i] -= factor * known[j, i]
        for k in range(width):
            for later in range(k, width):
                total = 0.0
                for i in range(later, width):
                    total += y[k, i] * y[later, i]
                for i in range(width, m):
                    total -= y[k, i] * result[later, i]
                result[k, later] = total
    return inverse
