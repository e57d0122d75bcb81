"""Matches landmarks without identities to true ones by distance, where no labels are known."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.optimize import linear_sum_assignment

from central.desk.evaluation.gospa import half_spacing


@dataclass(frozen=True)
class Matching:
    """The number of landmarks within `gate_m` of a true one, one to one, `of` all without
    identities.

    The gate also bounds the errors: those of landmarks beyond it are not counted.
    """

    gate_m: float
    matched: int
    of: int

    by: str = "nearest neighbour"

    def __str__(self) -> str:
        return f"{self.by} within {self.gate_m:.3g} m, {self.matched} of {self.of} matched"


def nearest(
    means: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "m 2"]
) -> tuple[Int64[np.ndarray, " n"], Matching] | None:
    """The row of each landmark's true position, −1 where it has none, in the frame of the truth.

    The pairs are those of the least sum of squared distances, one to one, within the gate: half of
    the median distance of a true landmark from its nearest neighbour. None below two true ones.
    """
    gate_m = half_spacing(true)
    if not gate_m:
        return None
    squared = np.minimum(((means[:, None] - true[None]) ** 2).sum(axis=2), gate_m**2)
    rows, columns = linear_sum_assignment(squared)
    near = squared[rows, columns] < gate_m**2
    found = np.full(len(means), -1, np.int64)
    found[rows[near]] = columns[near]
    return found, Matching(gate_m, int(near.sum()), len(means))
