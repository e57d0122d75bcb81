"""Learnt figures with their uncertainty by the jackknife."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from sim.calibration.data import Reference

GROUPS = 5
"""Least number of parts that are left out in turn; fewer robots are cut into equal stretches of
time.
"""

HUBER = 2.0
"""The loss is linear beyond this number of standard deviations."""

Fit = Callable[[Sequence[Reference]], Mapping[str, float]]


class CalibrationError(ValueError):
    """The data do not determine a figure; the text says what is missing."""


@dataclass(frozen=True)
class Figure:
    """One learnt number: its place in a scenario, its value, its standard deviation and its
    unit.
    """

    name: str
    value: float
    sigma: float
    unit: str


def huber(
    residual: Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " n"]],
    sigma: Float[np.ndarray, " n"],
    start: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """The parameters that minimise Huber's loss of residual/sigma, linear beyond HUBER."""

    def weighted(p: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        return np.asarray(residual(p) / sigma)

    found = least_squares(weighted, start, loss="huber", f_scale=HUBER, x_scale=0.1)
    return np.asarray(found.x)


def groups_of(data: Sequence[Reference]) -> list[list[Reference]]:
    """Groups that are as independent as possible: the robots of each data set, or stretches of time
    of each.
    """
    pieces = -(-GROUPS // len(data))
    if pieces == 1:
        return [[each] for each in data]
    groups = []
    for each in data:
        first, last = int(each.intervals.end_ns[0]), int(each.intervals.end_ns[-1]) + 1
        edges = np.linspace(first, last, pieces + 1).astype(np.int64)
        groups += [[each.between(int(a), int(b))] for a, b in pairwise(edges)]
    return groups


def jackknifed(fit: Fit, data: Sequence[Reference], units: Mapping[str, str]) -> tuple[Figure, ...]:
    """The fit of all data, with σ² = (G − 1)/G Σ (fit without a group − their mean)²; Efron and
    Stein 1981.

    Errors may be correlated within a group; between groups they are independent. A figure that the
    data without one group do not determine is left out.
    """
    groups = groups_of(data)
    values = fit([part for group in groups for part in group])
    rest = [
        fit([part for j, group in enumerate(groups) if j != i for part in group])
        for i in range(len(groups))
    ]
    figures = []
    for name, value in values.items():
        if not all(name in each for each in rest):
            continue
        left_out = np.array([each[name] for each in rest])
        spread = float(np.sum((left_out - left_out.mean()) ** 2))
        sigma = float(np.sqrt((len(groups) - 1) / len(groups) * spread))
        figures.append(Figure(name, float(value), sigma, units[name]))
    return tuple(figures)
