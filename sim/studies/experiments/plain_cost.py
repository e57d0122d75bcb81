"""An independent implementation of the joined map's cost: plain arrays, and a solver of SciPy's.

It is a reference for the team's map joining and shares no code with it. The same formulas

    Σ ‖L_k⁻¹ (R(θ_s)ᵀ(p − p_s) …, θ_e − θ_s …; minus the submap's mean)‖², L_k L_kᵀ = f P_k
    + Σ ‖L⁻¹ (range, bearing of a teammate; minus the measurement)‖² + Σ ‖prior‖²

are implemented with complex numbers and a dense Jacobian, and solved by MINPACK's
Levenberg-Marquardt (Moré 1978), where the map joining has kernels, a sparse factorisation and
Gauss-Newton steps. The graph provides the measurements, and the indices in the state of each pose
and landmark.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from team.estimation.map_joining.submap_graph import Graph

Values = Float[np.ndarray, " _"]
Rows = Float[np.ndarray, "r _"]
Indices = Int64[np.ndarray, " _"]

TOLERANCE = 1e-12
"""Relative tolerance of cost and step: a solution is much nearer to a minimum than 1 in χ²."""
SOLUTIONS = 6
"""Most restarts along a long curved valley, each from the last solution."""


class Solution(NamedTuple):
    """A state, its cost, and whether the solver converged there."""

    state: Values
    cost: float
    at_rest: bool


class PlainCost:
    """The cost of a graph's states. fixed: coordinates of the state that are not solved for."""

    def __init__(
        self, graph: Graph, covariance_factor: float, fixed: Bool[np.ndarray, " _"]
    ) -> None:
        if graph.biases:
            raise NotImplementedError("the judge knows no biases: front_end.biases must be []")
        self._graph = graph
        self.free: Indices = np.flatnonzero(~fixed)
        self._of_submap = [
            _whitening(covariance_factor * c.local.covariance) for c, *_ in graph.submaps
        ]
        self._of_sighting = [_whitening(each.sighting.covariance) for each in graph.sightings]
        self._of_prior = [np.linalg.cholesky(each.information).T for each in graph.priors]

    def of(self, state: Values) -> float:
        """The χ² of a state."""
        r = self.residuals(state)
        return float(r @ r)

    def residuals(self, state: Values) -> Values:
        """The whitened residuals, term by term; the sum of their squares is the cost."""
        return np.concatenate([W @ r for W, r, _, _ in self._terms(state)])

    def jacobian(self, state: Values) -> Rows:
        """The Jacobian of the whitened residuals with respect to the free coordinates."""
        blocks = []
        for W, _, at, J in self._terms(state):
            block = np.zeros((len(W), len(state)))
            block[:, at] = W @ J
            blocks.append(block[:, self.free])
        return np.concatenate(blocks)

    def solved(self, state: Values) -> Solution:
        """The minimum that the solver reaches from a state."""
        found = Solution(state, self.of(state), at_rest=False)
        for _ in range(SOLUTIONS):
            if found.at_rest:
                break
            found = self._once(found.state)
        return found

    def _once(self, state: Values) -> Solution:
        def at(x: Values) -> Values:
            whole = state.copy()
            whole[self.free] = x
            return whole

        # MINPACK wants as many residuals as unknowns, also where a map is just determined.
        lacking = max(0, len(self.free) - len(self.residuals(state)))

        def residuals(x: Values) -> Values:
            return np.concatenate([self.residuals(at(x)), np.zeros(lacking)])

        def jacobian(x: Values) -> Rows:
            return np.concatenate([self.jacobian(at(x)), np.zeros((lacking, len(x)))])

        result = least_squares(
            residuals,
            state[self.free],
            jacobian,
            method="lm",
            x_scale="jac",
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            gtol=TOLERANCE,
            max_nfev=300,
        )
        end = at(result.x)
        return Solution(end, self.of(end), at_rest=result.status > 0)

    def _terms(self, state: Values) -> Iterator[tuple[Rows, Values, Indices, Rows]]:
        """For each term its whitening matrix, its residual, the indices of its coordinates and its
        Jacobian.
        """
        offset = self._graph.offset
        for W, (contribution, nodes, *_) in zip(self._of_submap, self._graph.submaps, strict=True):
            poses = 1 + len(contribution.local.node_stamps)
            h, at, J = _submap(state, offset[nodes], poses)
            r = h - contribution.local.mean
            headings = np.arange(2, 3 * poses, 3)
            r[headings] = _around(r[headings])
            yield W, r, at, J
        for W, (sighting, observer, teammate) in zip(
            self._of_sighting, self._graph.sightings, strict=True
        ):
            h, at, J = _sighting(state, int(offset[observer]), int(offset[teammate]))
            r = h - sighting.measurement
            r[1:] = _around(r[1:])
            yield W, r, at, J
        for W, (node, mean, _) in zip(self._of_prior, self._graph.priors, strict=True):
            at = int(offset[node]) + np.arange(len(mean))
            r = state[at] - mean
            r[2:] = _around(r[2:])
            yield W, r, at, np.eye(len(mean))


def _submap(state: Values, first: Indices, poses: int) -> tuple[Values, Indices, Rows]:
    """The predicted submap, the indices of its coordinates (start, poses, points), and its
    Jacobian.

    first: the first index of each node in the state.
    """
    s, points = int(first[0]), first[1:]
    turn = np.exp(-1j * state[s + 2])
    local = turn * (state[points] + 1j * state[points + 1] - state[s] - 1j * state[s + 1])
    sizes = np.where(np.arange(len(points)) < poses, 3, 2)
    rows = np.concatenate([[0], np.cumsum(sizes)])
    own = (p + np.arange(k) for p, k in zip(points, sizes, strict=True))
    at = np.concatenate([s + np.arange(3), *own])
    h, J = np.zeros(rows[-1]), np.zeros((rows[-1], 3 + rows[-1]))
    x, y = rows[:-1], rows[:-1] + 1
    h[x], h[y] = local.real, local.imag
    for part, of in ((turn, 0), (1j * turn, 1)):
        J[x, 3 + x + of], J[y, 3 + x + of] = part.real, part.imag
        J[x, of], J[y, of] = -part.real, -part.imag
    J[x, 2], J[y, 2] = (-1j * local).real, (-1j * local).imag
    heading = rows[:poses] + 2
    h[heading] = state[points[:poses] + 2] - state[s + 2]
    J[heading, 3 + heading], J[heading, 2] = 1.0, -1.0
    return h, at, J


def _sighting(state: Values, observer: int, teammate: int) -> tuple[Values, Indices, Rows]:
    """Range and bearing of a teammate, and their Jacobian over both poses."""
    way = complex(state[teammate] - state[observer], state[teammate + 1] - state[observer + 1])
    distance = abs(way)
    h = np.array([distance, np.angle(way) - state[observer + 2]])
    to = np.array([[way.real, way.imag], [-way.imag / distance, way.real / distance]]) / distance
    J = np.zeros((2, 6))
    J[:, :2], J[1, 2], J[:, 3:5] = -to, -1.0, to
    return h, np.concatenate([observer + np.arange(3), teammate + np.arange(3)]), J


def _whitening(covariance: Rows) -> Rows:
    """L⁻¹ with L Lᵀ = P."""
    L = np.linalg.cholesky(covariance)
    return np.asarray(solve_triangular(L, np.eye(len(L)), lower=True))


def _around(angles: Values) -> Values:
    """Angles in (−π, π]."""
    return np.asarray(np.angle(np.exp(1j * angles)))
