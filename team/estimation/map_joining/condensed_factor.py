"""What old submaps say, as one quadratic over the nodes of a graph that are left of them.

Around the state `at` at which they were taken up,

    cost(x) = cost + 2 slopeᵀ d + dᵀ information d,   d = x − at (headings wrapped),

with the poses that only they had eliminated (Schur's complement): exact but for the linearisation,
which stays that of `at`, and the robust weights, which stay those that they had there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.estimation.contribution import Stream
from team.estimation.map_joining.condensing_kernel import add_blocks

Indices = Int64[np.ndarray, " _"]
Values = Float[np.ndarray, " _"]


class SubmapCost(NamedTuple):
    """How one submap agrees with the rest: χ² should be near dof.

    chi2 is unweighted, nothing discounted; dof = dim − w tr(JᵀP⁻¹J Σ) is the part of its dimension
    that the solution does not take up (its redundancy, Baarda 1968); weight w is robust, 1 without
    a robust loss.
    """

    stream: Stream
    sequence: int
    chi2: float
    dof: float
    weight: float


class Path(NamedTuple):
    """Where the eliminated start and end poses of a stream were when they left.

    is_fixed: whether the start is a constant.
    """

    poses: Float[np.ndarray, "K 3"]
    is_fixed: bool


class Departed(NamedTuple):
    """What the agreement keeps of factors that were taken up, as they agreed at that moment.

    robots: Σ w χ² and Σ dof of each robot. submaps: the newest of each stream, oldest first.
    believed: how many submaps that are believed have each landmark. paths: for when they are
    linearised again.
    """

    robots: Mapping[str, tuple[float, float]]
    submaps: tuple[SubmapCost, ...]
    believed: Mapping[int, int]
    paths: Mapping[Stream, Path]


NOBODY = Departed({}, (), {}, {})


@dataclass(frozen=True, eq=False)
class Condensed:
    """The quadratic (see above) over `nodes`, ascending, none of them fixed.

    headings: which of its numbers are headings. submaps: how many it stands for. redundancy: the
    numbers that were measured less the unknowns that were eliminated.
    """

    nodes: Indices
    at: Values
    headings: Bool[np.ndarray, " _"]
    information: Float[np.ndarray, "n n"]
    slope: Values
    cost: float
    submaps: int
    redundancy: int
    departed: Departed = field(default=NOBODY)

    def moved(self, state: Values, offset: Indices) -> Values:
        """d: how far the state is from where this was linearised."""
        d: Values = state[places(offset, self.nodes)] - self.at
        turn = d[self.headings]
        d[self.headings] = turn + 2.0 * np.pi * np.floor((np.pi - turn) / (2.0 * np.pi))
        return d

    def cost_at(self, state: Values, offset: Indices) -> float:
        """cost(x)."""
        d = self.moved(state, offset)
        return self.cost + float(2.0 * (self.slope @ d) + d @ (self.information @ d))

    def gradient_at(self, state: Values, offset: Indices) -> Values:
        """Half of the derivative: slope + information d."""
        gradient: Values = self.slope + self.information @ self.moved(state, offset)
        return gradient

    def add(
        self,
        values: Values,
        gradient: Values,
        state: Values,
        offset: Indices,
        entry: Indices,
        value_start: Indices,
    ) -> None:
        """Add to the normal equations; entry: those of the pattern of each pair of `nodes`."""
        gradient[places(offset, self.nodes)] += self.gradient_at(state, offset)
        sizes = np.diff(offset)[self.nodes]
        add_blocks(values, self.information, sizes, entry, value_start)


def places(offset: Indices, nodes: Indices) -> Indices:
    """Where the numbers of some nodes lie in the state, in their order."""
    sizes = offset[nodes + 1] - offset[nodes]
    first = np.repeat(offset[nodes] - np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes)
    found: Indices = first + np.arange(len(first))
    return found
