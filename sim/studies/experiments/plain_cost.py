"""An independent implementation of the joined map's cost: plain arrays, and a solver of SciPy's.

It is a reference for the team's map joining and shares no code with it. The same formulas

    Σ ‖L_k⁻¹ (R(θ_s)ᵀ(p − p_s) …, θ_e − θ_s …; minus the submap's mean)‖², L_k L_kᵀ = f P_k
    + Σ ‖L⁻¹ (range, bearing of a teammate; minus the measurement)‖² + Σ ‖prior‖²

are implemented with complex numbers and solved by Levenberg-Marquardt steps (damping as in
Nielsen 1999) through SuperLU, where the map joining has kernels, a factorisation of its own and
Gauss-Newton steps. The graph provides the measurements, and the indices in the state of each pose
and landmark.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import splu

from team.estimation.map_joining.submap_graph import Graph

Values = Float[np.ndarray, " _"]
Rows = Float[np.ndarray, "r _"]
Indices = Int64[np.ndarray, " _"]

AT_REST = 1e-9
"""A state is at rest where an undamped step is expected to lower χ² by less than this."""
SMALL = 1e-5
"""A damped step has to be expected to lower χ² by less than this before that is looked at."""
STEPS = 2000
"""Most steps of a solution: a long curved valley takes many."""
UNDAMPED = 1e-12
"""The least damping: coordinates that nothing determines stay where they are."""
DAMPING = 1e-3
"""First damping, relative to the diagonal of the normal equations."""


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

    def jacobian(self, state: Values) -> sparse.csr_array:
        """The Jacobian of the whitened residuals with respect to the free coordinates."""
        return self._rows((at, W @ J) for W, _, at, J in self._terms(state))

    def solved(self, state: Values) -> Solution:
        """The minimum that the steps reach from a state.

        Each is δ = −(JᵀJ + μ D)⁻¹ Jᵀ r, D = diag JᵀJ, and is taken where it lowers the cost.
        """
        state, cost, damping, growth = state.copy(), self.of(state), DAMPING, 2.0
        N, gradient = self._normal(state)
        for _ in range(STEPS):
            step, foreseen = _step(N, damping, gradient)
            if foreseen < SMALL and _step(N, UNDAMPED, gradient)[1] < AT_REST:
                return Solution(state, cost, at_rest=True)
            tried = state.copy()
            tried[self.free] -= step
            gained = cost - self.of(tried)
            if gained > 0.0:
                state, cost = tried, cost - gained
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gained / foreseen - 1.0) ** 3)
                damping, growth = max(damping, UNDAMPED), 2.0
                N, gradient = self._normal(state)
            else:
                damping, growth = damping * growth, 2.0 * growth
                if damping > 1.0 / UNDAMPED:
                    break
        return Solution(state, cost, at_rest=False)

    def _normal(self, state: Values) -> tuple[sparse.csc_array, Values]:
        """JᵀJ and Jᵀ r."""
        terms = [(W @ r, at, W @ J) for W, r, at, J in self._terms(state)]
        J = self._rows((at, WJ) for _, at, WJ in terms)
        return (J.T @ J).tocsc(), J.T @ np.concatenate([Wr for Wr, *_ in terms])

    def _rows(self, terms: Iterable[tuple[Indices, Rows]]) -> sparse.csr_array:
        """The blocks of rows as one matrix, with the columns of the free coordinates."""
        entries, rows, columns, begin = [], [], [], 0
        for at, J in terms:
            entries.append(J.ravel())
            rows.append(np.repeat(begin + np.arange(len(J)), len(at)))
            columns.append(np.tile(at, len(J)))
            begin += len(J)
        where = (np.concatenate(rows), np.concatenate(columns))
        shape = (begin, int(self._graph.offset[-1]))
        whole = sparse.csc_array((np.concatenate(entries), where), shape=shape)
        return whole[:, self.free].tocsr()

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


def _step(N: sparse.csc_array, damping: float, gradient: Values) -> tuple[Values, float]:
    """δ = (N + μ diag N)⁻¹ g, and by how much −δ lowers a cost that is quadratic."""
    D = damping * N.diagonal()
    step = np.asarray(splu((N + sparse.diags_array(D)).tocsc()).solve(gradient))
    return step, float(step @ (gradient + D * step))


def _whitening(covariance: Rows) -> Rows:
    """L⁻¹ with L Lᵀ = P."""
    L = np.linalg.cholesky(covariance)
    return np.asarray(solve_triangular(L, np.eye(len(L)), lower=True))


def _around(angles: Values) -> Values:
    """Angles in (−π, π]."""
    return np.asarray(np.angle(np.exp(1j * angles)))
