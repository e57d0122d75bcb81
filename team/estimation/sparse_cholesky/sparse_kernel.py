"""Compiled kernels of the sparse Cholesky factorisation, its solutions and its selected inverse.

They traverse the panels of `sparse_layout`. Inner loops add a multiple of one contiguous column to
another, which vectorises without changing the order of any sum. `panel_products` has those of big
panels.
"""

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.compiled import compiled, inlined
from team.estimation.dense_kernel import matrix_product
from team.estimation.placing import put
from team.estimation.sparse_cholesky import panel_products as products
from team.estimation.sparse_cholesky.sparse_layout import Structure

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
FEW = 2
"""Number of columns up to which a solution goes column by column."""
PIVOT_TOLERANCE = 1e-14
"""Ratio of a pivot to its diagonal entry below which it is rounding noise: the unknown is
undetermined.
"""


@inlined
def _panel(
    structure: Structure, panels: Values, s: int
) -> tuple[Indices, Float[np.ndarray, "w m"]]:
    """Rows of a supernode and a view of its panel, one row per column of the matrix."""
    columns_of, row_start, row, panel_start, _ = structure
    rows = row[row_start[s] : row_start[s + 1]]
    width = columns_of[s + 1] - columns_of[s]
    return rows, panels[panel_start[s] : panel_start[s + 1]].reshape(width, len(rows))


@inlined
def _places(requested: Indices, present: Indices, place: Indices) -> None:
    """place[i] := index of requested[i] in `present`; both ascending, all are present."""
    at = 0
    for i in range(len(requested)):
        while present[at] != requested[i]:
            at += 1
        place[i] = at


@compiled
def _factorise_panel(panel: Float[np.ndarray, "w m"], least: Values) -> int:
    width, m = panel.shape
    if products.is_big(width, m):
        return products.factorise_by_blocks(panel, least)
    return products.factorise_columns(panel, 0, width, least)


@compiled
def _subtract_product(structure: Structure, panels: Values, s: int, place: Indices) -> None:
    """Subtract L_RJ L_RJᵀ of supernode s from the panels of the rows R below it."""
    columns_of, row_start, row, panel_start, supernode_of = structure
    rows, panel = _panel(structure, panels, s)
    width, m = panel.shape
    big = products.is_big(width, m)
    below = np.ascontiguousarray(panel[:, width:]) if big else np.empty((0, 0))
    product = np.empty((1, m))
    reached = -1
    begin = 0
    for j in range(width, m):
        t = supernode_of[rows[j]]
        present = row[row_start[t] : row_start[t + 1]]
        if t != reached:
            reached = t
            begin = j
            _places(rows[j:], present, place)
        if big:
            within = (j - width) % products.CHUNK
            if within == 0:
                last = min(j - width + products.CHUNK, m - width)
                product = products.rows_of_product(below, j - width, last)
            update = product[within, within:]
        else:
            update = product[0, : m - j]
            update[:] = 0.0
            products.add_products(update, panel[:, j], panel, j, 1.0)
        column = panel_start[t] + (rows[j] - columns_of[t]) * len(present)
        for i in range(j, m):
            panels[column + place[i - begin]] -= update[i - j]


@compiled
def factorise(structure: Structure, target: Indices, values: Values) -> tuple[Values, int]:
    """Compute the panels of L, and the permuted unknown whose pivot is not positive, or −1.

    Right-looking: a supernode's dense factorisation, then its outer product L_RJ L_RJᵀ is
    subtracted from the panels of the rows that it reaches.
    """
    columns_of, row_start, _, panel_start, _ = structure
    panels = np.zeros(panel_start[-1])
    for k in range(len(target)):
        panels[target[k]] = values[k]
    least = np.empty(columns_of[-1])
    for s in range(len(columns_of) - 1):
        _, panel = _panel(structure, panels, s)
        for k in range(len(panel)):
            least[columns_of[s] + k] = PIVOT_TOLERANCE * abs(panel[k, k])
    place = np.empty(np.max(np.diff(row_start)), dtype=np.int64)
    for s in range(len(columns_of) - 1):
        _, panel = _panel(structure, panels, s)
        failed = _factorise_panel(panel, least[columns_of[s] : columns_of[s + 1]])
        if failed >= 0:
            return panels, columns_of[s] + failed
        _subtract_product(structure, panels, s, place)
    return panels, -1


@compiled
def _solve_column(
    structure: Structure, panels: Values, right: Float[np.ndarray, "n k"], first: int, c: int
) -> None:
    """Solve one column in place, gathering a panel's numbers so that a loop follows its row."""
    count = len(structure[0]) - 1
    x = np.empty(len(right))
    for s in range(first, count):
        rows, panel = _panel(structure, panels, s)
        width, m = panel.shape
        for i in range(m):
            x[i] = right[rows[i], c]
        for k in range(width):
            row = panel[k]
            x[k] /= row[k]
            for i in range(k + 1, m):
                x[i] -= row[i] * x[k]
        for i in range(m):
            right[rows[i], c] = x[i]
    for s in range(count - 1, first - 1, -1):
        rows, panel = _panel(structure, panels, s)
        width, m = panel.shape
        for i in range(m):
            x[i] = right[rows[i], c]
        for k in range(width - 1, -1, -1):
            row = panel[k]
            for i in range(k + 1, m):
                x[k] -= row[i] * x[i]
            x[k] /= row[k]
            right[rows[k], c] = x[k]


@compiled
def _solve_many(
    structure: Structure, panels: Values, right: Float[np.ndarray, "n k"], first: int
) -> None:
    """Solve many columns in place, with a loop along a row of them."""
    count = len(structure[0]) - 1
    many = right.shape[1]
    for s in range(first, count):
        rows, panel = _panel(structure, panels, s)
        width, m = panel.shape
        for k in range(width):
            pivot = right[rows[k]]
            for c in range(many):
                pivot[c] /= panel[k, k]
            for i in range(k + 1, m):
                factor = panel[k, i]
                other = right[rows[i]]
                for c in range(many):
                    other[c] -= factor * pivot[c]
    for s in range(count - 1, first - 1, -1):
        rows, panel = _panel(structure, panels, s)
        width, m = panel.shape
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
def solve_in_place(
    structure: Structure, panels: Values, right: Float[np.ndarray, "n k"], first: int
) -> None:
    """Overwrite `right` with (L Lᵀ)⁻¹ right.

    Numbers of supernodes before `first` must be zero, and are not changed.
    """
    if right.shape[1] > FEW:
        _solve_many(structure, panels, right, first)
        return
    for c in range(right.shape[1]):
        _solve_column(structure, panels, right, first, c)


@compiled
def _gather(
    structure: Structure, inverse: Values, s: int, place: Indices, known: Float[np.ndarray, "h h"]
) -> None:
    """known[R, R] := the entries of the inverse on the rows R below supernode s, symmetric."""
    columns_of, row_start, row, panel_start, supernode_of = structure
    rows = row[row_start[s] + columns_of[s + 1] - columns_of[s] : row_start[s + 1]]
    reached = -1
    begin = 0
    for j in range(len(rows)):
        t = supernode_of[rows[j]]
        present = row[row_start[t] : row_start[t + 1]]
        if t != reached:
            reached = t
            begin = j
            _places(rows[j:], present, place)
        column = panel_start[t] + (rows[j] - columns_of[t]) * len(present)
        for i in range(j, len(rows)):
            known[j, i] = inverse[column + place[i - begin]]
            known[i, j] = known[j, i]


@compiled
def _over_own_triangle(panel: Float[np.ndarray, "w m"]) -> Float[np.ndarray, "w m"]:
    """L_JJ⁻¹ on the supernode's own rows, Y = L_RJ L_JJ⁻¹ on those below (same layout)."""
    width, m = panel.shape
    y = np.zeros((width, m))
    for k in range(width):
        own = y[k]
        own[k] = 1.0 / panel[k, k]
        for p in range(k, width):
            row = panel[p]
            if p > k:
                own[p] = -own[p] / row[p]
            for i in range(p + 1, width):
                own[i] += row[i] * own[p]
    for k in range(width - 1, -1, -1):
        put(y[k], width, panel[k, width:])
        for later in range(k + 1, width):
            factor = panel[k, later]
            for i in range(width, m):
                y[k, i] -= factor * y[later, i]
        for i in range(width, m):
            y[k, i] /= panel[k, k]
    return y


@compiled
def takahashi(structure: Structure, panels: Values) -> Values:
    """Compute the entries of (L Lᵀ)⁻¹ on the pattern of L, lower triangle, in panels like L's."""
    columns_of, row_start, _, _, _ = structure
    inverse = np.zeros_like(panels)
    below = np.max(np.diff(row_start) - np.diff(columns_of))
    place = np.empty(below, dtype=np.int64)
    space = np.empty(below * below)
    for s in range(len(columns_of) - 2, -1, -1):
        _, panel = _panel(structure, panels, s)
        _, result = _panel(structure, inverse, s)
        width, m = panel.shape
        known = space[: (m - width) ** 2].reshape(m - width, m - width)
        _gather(structure, inverse, s, place, known)
        if products.is_big(width, m):
            products.selected_by_blocks(panel, known, result)
            continue
        y = _over_own_triangle(panel)
        across = np.ascontiguousarray(y.T)
        for k in range(width):
            below = result[k, width:]
            products.add_products(below, y[k, width:], known, 0, -1.0)
            own = np.zeros(k + 1)
            products.add_products(own, y[k, k:width], across[k:], 0, 1.0)
            products.add_products(own, below, across[width:], 0, -1.0)
            for later in range(k + 1):
                result[later, k] = own[later]
    return inverse


@compiled
def has_big_panel(structure: Structure) -> bool:
    """Whether `panel_products` handles one of the panels."""
    columns_of, row_start, _, _, _ = structure
    for s in range(len(columns_of) - 1):
        width = columns_of[s + 1] - columns_of[s]
        if products.is_big(width, row_start[s + 1] - row_start[s]):
            return True
    return False


@compiled
def _first_columns(structure: Structure) -> Indices:
    """Return the first column of each supernode's subtree, whose columns directly precede its
    own.
    """
    columns_of, row_start, row, _, supernode_of = structure
    first = columns_of[:-1].copy()
    for s in range(len(first)):
        below = row_start[s] + columns_of[s + 1] - columns_of[s]
        if below < row_start[s + 1]:
            parent = supernode_of[row[below]]
            first[parent] = min(first[parent], first[s])
    return first


@compiled
def inverse_among(
    structure: Structure, panels: Values, requested: Indices
) -> Float[np.ndarray, "k k"]:
    """Compute (L Lᵀ)⁻¹ among ascending unknowns: Wᵀ W with L W = their unit vectors.

    A unit vector fills the supernodes from its own up to the root, so at each supernode only the
    unit vectors of its subtree take part, and those are neighbours.
    """
    columns_of, _, _, _, _ = structure
    first = _first_columns(structure)
    solution = np.zeros((columns_of[-1], len(requested)))
    for c in range(len(requested)):
        solution[requested[c], c] = 1.0
    result = np.zeros((len(requested), len(requested)))
    for s in range(len(columns_of) - 1):
        begin = np.searchsorted(requested, first[s])
        end = np.searchsorted(requested, columns_of[s + 1])
        if begin == end:
            continue
        rows, panel = _panel(structure, panels, s)
        width, m = panel.shape
        own = np.ascontiguousarray(solution[columns_of[s] : columns_of[s + 1], begin:end])
        products.solve_forward(panel, own)
        if m > width:
            reached = matrix_product(np.ascontiguousarray(panel[:, width:].T), own)
            for i in range(width, m):
                for c in range(begin, end):
                    solution[rows[i], c] -= reached[i - width, c - begin]
        product = matrix_product(np.ascontiguousarray(own.T), own)
        for i in range(begin, end):
            for c in range(begin, end):
                result[i, c] += product[i - begin, c - begin]
    return result


@compiled
def quadratic(
    values: Values,
    rows: Indices,
    columns: Indices,
    value_start: Indices,
    offset: Indices,
    x: Values,
) -> float:
    """Compute xᵀAx of a symmetric A, given by the blocks of one triangle row by row.

    Block k, of the variables rows[k] and columns[k], begins at values[value_start[k]].
    """
    total = 0.0
    for k in range(len(rows)):
        here, there = offset[rows[k]], offset[columns[k]]
        width = offset[columns[k] + 1] - there
        block = 0.0
        for i in range(offset[rows[k] + 1] - here):
            for j in range(width):
                block += x[here + i] * values[value_start[k] + i * width + j] * x[there + j]
        total += block if rows[k] == columns[k] else 2.0 * block
    return total
