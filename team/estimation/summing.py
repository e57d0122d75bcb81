"""The sum of many numbers within kernels, in the order that NumPy sums them.

It goes by halves down to blocks of BLOCK numbers, whose sums are in eight lanes, so rounding grows
with the logarithm of the count (Higham 2002, section 4.2).
"""

import numpy as np
from jaxtyping import Float

from team.estimation.compiled import compiled

BLOCK = 128
DEEPEST = 64
"""No array can be halved so often."""


@compiled
def total(values: Float[np.ndarray, " n"]) -> float:
    """Σ values, with the bits of `np.add.reduce`."""
    begins, counts = np.empty(2 * DEEPEST, np.int64), np.empty(2 * DEEPEST, np.int64)
    halved, sums = np.zeros(2 * DEEPEST, np.bool_), np.zeros(DEEPEST)
    begins[0], counts[0], top, known = 0, len(values), 0, 0
    while top >= 0:
        begin, count = begins[top], counts[top]
        if count <= BLOCK:
            sums[known] = _of_block(values, begin, begin + count)
            known, top = known + 1, top - 1
        elif halved[top]:
            known, top = known - 1, top - 1
            sums[known - 1] += sums[known]
        else:
            half = count // 2 - (count // 2) % 8
            halved[top] = True
            begins[top + 1], counts[top + 1], halved[top + 1] = begin + half, count - half, False
            begins[top + 2], counts[top + 2], halved[top + 2] = begin, half, False
            top += 2
    return float(sums[0])


@compiled
def _of_block(values: Float[np.ndarray, " n"], begin: int, end: int) -> float:
    """The sum of the values from `begin` to `end` − 1: eight lanes in pairs, then the rest."""
    lanes, behind = np.zeros(8), end - (end - begin) % 8
    for i in range(begin, behind, 8):
        for j in range(8):
            lanes[j] += values[i + j]
    found = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + (
        (lanes[4] + lanes[5]) + (lanes[6] + lanes[7])
    )
    for i in range(behind, end):
        found += values[i]
    return float(found)
