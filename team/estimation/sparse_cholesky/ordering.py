"""A fill-reducing elimination order for a block-sparse symmetric matrix: minimum degree.

The graph has a vertex per block variable (a pose: 3 unknowns, a landmark: 2) and an edge per
non-zero block. Eliminating a vertex makes its neighbours adjacent to each other; next is the vertex
whose neighbours have the fewest unknowns, the smallest index among equals (George & Liu 1989,
without its approximations). The neighbours at that moment are the structure of the vertex's column
in the Cholesky factor, so the order comes with the symbolic factorisation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, UInt64

from team.estimation.compiled import compiled
from team.estimation.placing import put

Indices = Int64[np.ndarray, " _"]
Bits = UInt64[np.ndarray, "_ _"]


class Elimination(NamedTuple):
    """The elimination order and the structure of the factor; arrays indexed by step of elimination.

    order: block eliminated at each step. parent: step at which the first of its column's rows is
    eliminated; −1 at a root. start: column of step k has the rows `structure[start[k] : start[k +
    1]]`. structure: steps at which those rows are eliminated, ascending; without the diagonal.
    """

    order: Indices
    parent: Indices
    start: Indices
    structure: Indices


def minimum_degree(sizes: Indices, column_start: Indices, rows: Indices) -> Elimination:
    """Eliminate by minimum degree, then renumber in postorder (a subtree is contiguous).

    sizes: unknowns per block; blocks (rows[k], j) with column_start[j] ≤ k < column_start[j + 1]
    are the non-zero blocks of the lower triangle, diagonal included or not.
    """
    order, start, structure = _eliminated(sizes, column_start, rows)
    return Elimination(*_postordered(order, start, structure))


@compiled
def _tie(adjacent: Bits, degree: Indices, sizes: Indices, i: int, j: int) -> None:
    bit = np.uint64(1) << np.uint64(j & 63)
    if not adjacent[i, j >> 6] & bit:
        adjacent[i, j >> 6] |= bit
        adjacent[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
        degree[i] += sizes[j]
        degree[j] += sizes[i]


@compiled
def _join(adjacent: Bits, degree: Indices, sizes: Indices, i: int, v: int) -> None:
    """Make i a neighbour of all other neighbours of v, 64 vertices at a time."""
    for word in range(adjacent.shape[1]):
        new = adjacent[v, word] & ~adjacent[i, word]
        if word == i >> 6:
            new &= ~(np.uint64(1) << np.uint64(i & 63))
        adjacent[i, word] |= new
        j = word << 6
        while new:
            if new & np.uint64(1):
                degree[i] += sizes[j]
            new >>= np.uint64(1)
            j += 1


@compiled
def _neighbours(adjacent: Bits, vertex: int, found: Indices) -> int:
    """Write the neighbours of a vertex, ascending, to the front of `found`; return their number."""
    count = 0
    for word in range(adjacent.shape[1]):
        bits = adjacent[vertex, word]
        i = word << 6
        while bits:
            if bits & np.uint64(1):
                found[count] = i
                count += 1
            bits >>= np.uint64(1)
            i += 1
    return count


@compiled
def _least(degree: Indices, eliminated: Bool[np.ndarray, " n"]) -> int:
    least = -1
    for i in range(len(degree)):
        if not eliminated[i] and (least < 0 or degree[i] < degree[least]):
            least = i
    return least


@compiled
def _eliminated(
    sizes: Indices, column_start: Indices, rows: Indices
) -> tuple[Indices, Indices, Indices]:
    n = len(sizes)
    adjacent = np.zeros((n, (n + 63) // 64), dtype=np.uint64)
    degree = np.zeros(n, dtype=np.int64)
    for j in range(n):
        for i in rows[column_start[j] : column_start[j + 1]]:
            if i != j:
                _tie(adjacent, degree, sizes, i, j)
    order = np.empty(n, dtype=np.int64)
    start = np.zeros(n + 1, dtype=np.int64)
    structure = np.empty(max(8 * n, 1), dtype=np.int64)
    eliminated = np.zeros(n, dtype=np.bool_)
    for step in range(n):
        v = _least(degree, eliminated)
        eliminated[v] = True
        order[step] = v
        begin = start[step]
        if begin + n > len(structure):
            grown = np.empty(2 * len(structure) + n, dtype=np.int64)
            put(grown, 0, structure[:begin])
            structure = grown
        end = begin + _neighbours(adjacent, v, structure[begin:])
        start[step + 1] = end
        for a in range(begin, end):
            i = structure[a]
            adjacent[i, v >> 6] &= ~(np.uint64(1) << np.uint64(v & 63))
            degree[i] -= sizes[v]
            _join(adjacent, degree, sizes, i, v)
    return order, start, structure[: start[n]].copy()


@compiled
def _postorder(parent: Indices) -> Indices:
    """Order the steps of a forest with every subtree before its root, children ascending."""
    n = len(parent)
    child = np.full(n + 1, -1, dtype=np.int64)
    sibling = np.full(n, -1, dtype=np.int64)
    for step in range(n - 1, -1, -1):
        above = parent[step] if parent[step] >= 0 else n
        sibling[step] = child[above]
        child[above] = step
    visited = np.empty(n, dtype=np.int64)
    count = 0
    root = child[n]
    while root >= 0:
        step = root
        while True:
            while child[step] >= 0:
                down = child[step]
                child[step] = -1
                step = down
            visited[count] = step
            count += 1
            if step == root:
                break
            step = sibling[step] if sibling[step] >= 0 else parent[step]
        root = sibling[root]
    return visited


@compiled
def _postordered(
    order: Indices, start: Indices, structure: Indices
) -> tuple[Indices, Indices, Indices, Indices]:
    n = len(order)
    step_of = np.empty(n, dtype=np.int64)
    for step in range(n):
        step_of[order[step]] = step
    parent = np.full(n, -1, dtype=np.int64)
    for step in range(n):
        if start[step + 1] > start[step]:
            parent[step] = np.min(step_of[structure[start[step] : start[step + 1]]])
    old_of_new = _postorder(parent)
    new_of_old = np.empty(n, dtype=np.int64)
    for new in range(n):
        new_of_old[old_of_new[new]] = new
    new_order = np.empty(n, dtype=np.int64)
    new_parent = np.full(n, -1, dtype=np.int64)
    new_start = np.zeros(n + 1, dtype=np.int64)
    new_structure = np.empty_like(structure)
    for new in range(n):
        old = old_of_new[new]
        new_order[new] = order[old]
        if parent[old] >= 0:
            new_parent[new] = new_of_old[parent[old]]
        begin = new_start[new]
        end = begin
        for k in range(start[old], start[old + 1]):
            new_structure[end] = new_of_old[step_of[structure[k]]]
            end += 1
        put(new_structure, begin, np.sort(new_structure[begin:end]))
        new_start[new + 1] = end
    return new_order, new_parent, new_start, new_structure
