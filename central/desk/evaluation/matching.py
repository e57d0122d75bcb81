"""Match landmarks to true ones by distance."""

from dataclasses import dataclass

import numpy as np

from teamslam.team.shapes import Float, Int64


@dataclass(frozen=True)
class Matching:
    """Number of landmarks within `gate_m` of a true one, one to one."""

    gate_m: float
    matched: int
    of: int

    by: str = "nearest neighbour"

    def __str__(self) -> str:
        return f"{self.by} within {self.gate_m:.3g} m, {self.matched} of {self.of} matched"


@dataclass(frozen=True)
class Gospa:
    """Distance, cut-off, RMS of pairs, missed and false points."""

    distance_m: float
    cut_off_m: float
    localisation_m: float | None
    missed: int
    false: int


def assign(
    found: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "m 2"], gate_m: float
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Assign points one to one within the gate, with least sum of squared distances.

    Returns rows of both sets and squared distances [m²].
    """
    squared = np.minimum(((found[:, None] - true[None]) ** 2).sum(axis=2), gate_m**2)
    rows, columns = _cheapest(squared)
    near = squared[rows, columns] < gate_m**2
    return rows[near], columns[near], squared[rows, columns][near]


def nearest(
    means: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "m 2"]
) -> tuple[Int64[np.ndarray, " n"], Matching] | None:
    """Row of each landmark's true position (−1: none)."""
    gate_m = half_spacing(true)
    if not gate_m:
        return None
    rows, columns, _ = assign(means, true, gate_m)
    found = np.full(len(means), -1, np.int64)
    found[rows] = columns
    return found, Matching(gate_m, len(rows), len(means))


def gospa(
    found: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "m 2"], cut_off_m: float
) -> Gospa:
    """GOSPA of points in the true frame (Rahmathullah, García-Fernández and Svensson 2017).

    With p = 2, α = 2 and cut-off c, GOSPA² = Σ d² + c²/2 · (missed + false).
    """
    assigned = assign(found, true, cut_off_m)[2]
    missed, false = len(true) - len(assigned), len(found) - len(assigned)
    total = float(assigned.sum()) + 0.5 * cut_off_m**2 * (missed + false)
    rms = float(np.sqrt(assigned.mean())) if len(assigned) else None
    return Gospa(float(np.sqrt(total)), cut_off_m, rms, missed, false)


def half_spacing(true: Float[np.ndarray, "m 2"]) -> float | None:
    """Half the median nearest-neighbour distance; None below two landmarks."""
    if len(true) < 2:
        return None
    apart = np.hypot(*(true[:, None] - true[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    return 0.5 * float(np.median(apart.min(axis=1)))


def _cheapest(
    costs: Float[np.ndarray, "n m"],
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Assign min(n, m) rows to columns with least sum of costs, rows ascending.

    Shortest augmenting paths with potentials (Jonker and Volgenant 1987).
    """
    if len(costs) > costs.shape[1]:
        columns, rows = _cheapest(costs.T)
        order = np.argsort(rows)
        return rows[order], columns[order]
    n, m = costs.shape
    of_row, of_column = np.zeros(n), np.zeros(m + 1)  # potentials; column m is the path's begin
    taken = np.full(m + 1, -1)
    for row in range(n):
        taken[m], column = row, m
        least, before = np.full(m, np.inf), np.full(m, m)
        done = np.zeros(m + 1, bool)
        while taken[column] >= 0:
            done[column] = True
            here = taken[column]
            reduced = costs[here] - of_row[here] - of_column[:m]
            nearer = ~done[:m] & (reduced < least)
            least[nearer], before[nearer] = reduced[nearer], column
            column = int(np.argmin(np.where(done[:m], np.inf, least)))
            step = least[column]
            of_row[taken[done]] += step
            of_column[done] -= step
            least[~done[:m]] -= step
        while column != m:
            taken[column], column = taken[before[column]], int(before[column])
    columns = np.flatnonzero(taken[:m] >= 0)
    order = np.argsort(taken[columns])
    return taken[columns][order], columns[order]
