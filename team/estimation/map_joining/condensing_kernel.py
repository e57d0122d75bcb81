"""Compiled kernels of condensing: add submaps to a dense quadratic, and that to a block pattern."""

import numpy as np
from jaxtyping import Float, Int64

from team.estimation.compiled import compiled
from team.estimation.map_joining import joining_kernel as kernel
from team.estimation.map_joining.submap_factor import biased_normal

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


@compiled
def add_submaps(
    H: Matrix,
    g: Values,
    place: Indices,
    state: Values,
    offset: Indices,
    factors: kernel.SubmapFactors,
    chosen: Indices,
    weights: Values,
) -> None:
    """Add w JᵀP⁻¹J to H and w JᵀP⁻¹r to g for the chosen submaps.

    place: first row in H of each node, −1 for a constant.
    """
    for f in chosen:
        nodes, at, mean, information, sensitivity = kernel.submap_of(offset, factors, f)
        hessian, slope, _ = biased_normal(state, at, mean, information, sensitivity)
        row = 0
        for i in nodes:
            size = offset[i + 1] - offset[i]
            if place[i] >= 0:
                for p in range(size):
                    g[place[i] + p] += weights[f] * slope[row + p]
                column = 0
                for j in nodes:
                    other = offset[j + 1] - offset[j]
                    if place[j] >= 0:
                        for p in range(size):
                            for q in range(other):
                                H[place[i] + p, place[j] + q] += (
                                    weights[f] * hessian[row + p, column + q]
                                )
                    column += other
            row += size


@compiled
def add_blocks(
    values: Values,
    information: Float[np.ndarray, "n n"],
    sizes: Indices,
    entry: Indices,
    value_start: Indices,
) -> None:
    """Add the blocks of a dense information matrix over some nodes to the values of a pattern."""
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
                        values[base + p * sizes[b] + q] += information[row + p, column + q]
            column += sizes[b]
        row += sizes[a]
