"""Decide by the cost whether map and truth lie in the same minimum.

Whether a solution from the truth has less cost, or ends elsewhere about as likely, and the rise of
the cost with the truth fixed (likelihood ratio, χ² of the fixed coordinates).
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import splu

from teamslam.central.desk.evaluation.errors import Path, interpolate_truth
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.tick_fold import TickFold
from teamslam.team import translate
from teamslam.team.estimation.consistency import chi2_quantile
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import Fold, solve_fold
from teamslam.team.estimation.map_joining.submap_graph import Graph
from teamslam.team.shapes import Bool, Float, Int64
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample

Values = Float[np.ndarray, " _"]
Rows = Float[np.ndarray, "_ _"]
Blocks = Float[np.ndarray, "K r m"]
Indices = Int64[np.ndarray, " _"]

AT_REST = 1e-9  # expected decrease of χ² by an undamped step of a converged state
SMALL = 1e-5  # expected decrease of χ² by a damped step before a test of convergence
STEPS = 2000  # most steps of a solution
UNDAMPED = 1e-12  # least damping: undetermined coordinates keep their values
DAMPING = 1e-3  # first damping, relative to the diagonal of the normal equations


class _Solution(NamedTuple):
    state: Values
    cost: float
    at_rest: bool


class _Whitened(NamedTuple):
    residuals: Float[np.ndarray, "K r"]
    jacobians: Float[np.ndarray, "K r m"]
    at: Int64[np.ndarray, "K m"]


class _PlainCost:
    def __init__(
        self, graph: Graph, covariance_factor: float, fixed: Bool[np.ndarray, " _"]
    ) -> None:
        if graph.biases:
            raise NotImplementedError("this cost has no biases: front_end.biases must be []")
        self.free: Indices = np.flatnonzero(~fixed)
        self._terms_of: Kinds = [
            *_submaps(graph, covariance_factor), *_sightings(graph), *_priors(graph)
        ]  # fmt: skip
        self._column = np.full(len(fixed), len(self.free))
        self._column[self.free] = np.arange(len(self.free))

    def of(self, state: Values) -> float:
        """The χ² of a state."""
        r = self.residuals(state)
        return float(r @ r)

    def residuals(self, state: Values) -> Values:
        """Whitened residuals, kind by kind."""
        found = [each.residuals.ravel() for each in self._terms(state)]
        return np.concatenate([np.zeros(0), *found])

    def jacobian(self, state: Values) -> sparse.csr_array:
        """Jacobian of the residuals by the free coordinates."""
        entries, rows, columns, begin = [np.zeros(0)], [np.zeros(0, int)], [np.zeros(0, int)], 0
        for each in self._terms(state):
            row = begin + np.arange(each.residuals.size).reshape(*each.residuals.shape, 1)
            column = self._column[each.at][:, None, :]
            shape = each.jacobians.shape
            entries.append(each.jacobians.ravel())
            rows.append(np.broadcast_to(row, shape).ravel())
            columns.append(np.broadcast_to(column, shape).ravel())
            begin += each.residuals.size
        where = (np.concatenate(rows), np.concatenate(columns))
        free = len(self.free)
        whole = sparse.csc_array((np.concatenate(entries), where), shape=(begin, free + 1))
        return whole[:, :free].tocsr()

    def solved(self, state: Values) -> _Solution:
        """Minimise from a state.

        Steps δ = −(JᵀJ + μ D)⁻¹ Jᵀ r, D = diag JᵀJ, are taken if they lower the cost.
        """
        state, cost, damping, growth = state.copy(), self.of(state), DAMPING, 2.0
        N, gradient = self._normal(state)
        for _ in range(STEPS):
            step, foreseen = _step(N, damping, gradient)
            if foreseen < SMALL and _step(N, UNDAMPED, gradient)[1] < AT_REST:
                return _Solution(state, cost, at_rest=True)
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
        return _Solution(state, cost, at_rest=False)

    def _normal(self, state: Values) -> tuple[sparse.csc_array, Values]:
        J = self.jacobian(state)
        return (J.T @ J).tocsc(), J.T @ self.residuals(state)

    def _terms(self, state: Values) -> list[_Whitened]:
        return [kind.whitened(state) for kind in self._terms_of]


class _Submaps(NamedTuple):
    """K submaps of equal size; at: state indices of start, poses and landmarks; points: first
    indices of the latter two.
    """

    whitening: Float[np.ndarray, "K n n"]
    means: Float[np.ndarray, "K n"]
    at: Int64[np.ndarray, "K m"]
    points: Int64[np.ndarray, "K p"]
    poses: int

    def whitened(self, state: Values) -> _Whitened:
        poses, count = self.poses, self.points.shape[1]
        x = np.concatenate([3 * np.arange(poses), 3 * poses + 2 * np.arange(count - poses)])
        y, heading = x + 1, 3 * np.arange(poses) + 2
        start, turned = state[self.at[:, 0]] + 1j * state[self.at[:, 1]], state[self.at[:, 2]]
        turn = np.exp(-1j * turned)[:, None]
        local = turn * (state[self.points] + 1j * state[self.points + 1] - start[:, None])
        h, J = np.zeros(self.means.shape), np.zeros((*self.means.shape, self.at.shape[1]))
        h[:, x], h[:, y] = local.real, local.imag
        for part, of in ((turn, 0), (1j * turn, 1)):
            J[:, x, 3 + x + of], J[:, y, 3 + x + of] = part.real, part.imag
            J[:, x, of], J[:, y, of] = -part.real, -part.imag
        J[:, x, 2], J[:, y, 2] = (-1j * local).real, (-1j * local).imag
        h[:, heading] = state[self.points[:, :poses] + 2] - turned[:, None]
        J[:, heading, 3 + heading], J[:, heading, 2] = 1.0, -1.0
        r = h - self.means
        r[:, heading] = _around(r[:, heading])
        return _whiten(self, r, J)


class _Sightings(NamedTuple):
    """K inter-robot measurements; at: coordinates of observer and observed."""

    whitening: Float[np.ndarray, "K 2 2"]
    means: Float[np.ndarray, "K 2"]
    at: Int64[np.ndarray, "K 6"]

    def whitened(self, state: Values) -> _Whitened:
        pose = state[self.at]
        x, y = pose[:, 3] - pose[:, 0], pose[:, 4] - pose[:, 1]
        distance = np.hypot(x, y)
        r = np.stack([distance, np.arctan2(y, x) - pose[:, 2]], axis=1) - self.means
        r[:, 1] = _around(r[:, 1])
        to = np.array([[x, y], [-y / distance, x / distance]]) / distance
        J = np.zeros((len(x), 2, 6))
        J[:, :, 3:5] = np.moveaxis(to, 2, 0)
        J[:, :, :2], J[:, 1, 2] = -J[:, :, 3:5], -1.0
        return _whiten(self, r, J)


class _Priors(NamedTuple):
    """K Gaussians of coordinates; the third, if any, is a heading."""

    whitening: Float[np.ndarray, "K n n"]
    means: Float[np.ndarray, "K n"]
    at: Int64[np.ndarray, "K n"]

    def whitened(self, state: Values) -> _Whitened:
        r = state[self.at] - self.means
        r[:, 2:] = _around(r[:, 2:])
        return _whiten(self, r, np.broadcast_to(np.eye(r.shape[1]), (*r.shape, r.shape[1])))


Kinds = list[_Submaps | _Sightings | _Priors]


def _submaps(graph: Graph, covariance_factor: float) -> Iterator[_Submaps]:
    kinds = defaultdict(list)
    for contribution, nodes, *_ in graph.submaps:
        kinds[1 + len(contribution.local.node_stamps), len(nodes) - 1].append((contribution, nodes))
    for (poses, count), submaps in kinds.items():
        first = graph.offset[np.array([nodes for _, nodes in submaps])]
        sizes = np.array([3] * (1 + poses) + [2] * (count - poses))
        own = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        yield _Submaps(
            np.array(
                [_whitening_matrix(covariance_factor * c.local.covariance) for c, _ in submaps]
            ),
            np.array([c.local.mean for c, _ in submaps]),
            np.repeat(first, sizes, axis=1) + own,
            first[:, 1:],
            poses,
        )


def _sightings(graph: Graph) -> Iterator[_Sightings]:
    if graph.sightings:
        sightings = [each for each, *_ in graph.sightings]
        first = graph.offset[np.array([nodes for _, *nodes in graph.sightings])]
        yield _Sightings(
            np.array([_whitening_matrix(each.covariance) for each in sightings]),
            np.array([each.measurement for each in sightings]),
            (first[:, :, None] + np.arange(3)).reshape(-1, 6),
        )


def _priors(graph: Graph) -> Iterator[_Priors]:
    for each in graph.priors:
        whitening = np.linalg.cholesky(each.information).T
        at = graph.offset[each.nodes[0]] + np.arange(len(each.mean))
        yield _Priors(whitening[None], each.mean[None], at[None])


def _whiten(kind: _Submaps | _Sightings | _Priors, r: Rows, J: Blocks) -> _Whitened:
    return _Whitened((kind.whitening @ r[:, :, None])[:, :, 0], kind.whitening @ J, kind.at)


def _step(N: sparse.csc_array, damping: float, gradient: Values) -> tuple[Values, float]:
    """δ = (N + μ diag N)⁻¹ g, and the decrease of a quadratic cost by −δ."""
    D = damping * N.diagonal()
    step = np.asarray(splu((N + sparse.diags_array(D)).tocsc()).solve(gradient))
    return step, float(step @ (gradient + D * step))


def _whitening_matrix(covariance: Rows) -> Rows:
    """L⁻¹ with L Lᵀ = P."""
    L = np.linalg.cholesky(covariance)
    return np.asarray(solve_triangular(L, np.eye(len(L)), lower=True))


def _around(angles: Float[np.ndarray, "*_"]) -> Float[np.ndarray, "*_"]:
    return np.asarray(np.angle(np.exp(1j * angles)))


LOWER = 1.0  # decrease of the cost that indicates another minimum
LIKELY = 0.999  # quantile of χ² beyond which a place, or the truth, is excluded
NEARBY = 3  # number of initial states near the truth, besides the truth
NEARBY_RAD = 0.1  # standard deviation [rad] of these states' headings about the truth


class TrueMinimum(NamedTuple):
    """The map's minimum beside that of a solution from the truth.

    lower: by how much the latter's cost is less. other_minimum: it ends outside the map's 99.9 %
    ellipsoid, at a cost that does not exclude it. rise: of the cost with landmarks and first
    submaps' ends fixed at the truth; dof: of these.
    """

    lower: float
    other_minimum: bool
    rise: float
    dof: int

    @property
    def wrong(self) -> bool:
        """Whether map and truth lie in different minima."""
        return self.lower > LOWER or self.other_minimum

    @property
    def excluded(self) -> bool:
        """Whether the submaps exclude the truth with 99.9 %."""
        return self.rise > float(chi2_quantile(LIKELY, self.dof))


def true_minimum(samples: Iterable[Sample], run: Evaluation) -> TrueMinimum | None:
    """Figures of the final map under `join`; None without a known initial pose."""
    fold = final_fold(samples)
    if run.map is None or not fold.starts:
        return None
    landmarks = dict(
        zip(run.map.ids[run.map.known].tolist(), run.map.truth[run.map.known], strict=True)
    )
    return compare_minima(
        fold.main, landmarks, {name: each.truth for name, each in run.robots.items()}
    )


def final_fold(
    samples: Iterable[Sample], *, is_robust: bool = False, has_biases: bool = False
) -> Fold:
    """Recompute the final fold, by default with plain squares."""
    log = Recorded()
    log.take_all(samples)
    ticks = TickFold(log.central_config()[0], limits=None)
    sightings = log.sightings()
    for stream, measurements in log.measurements.items():
        start = measurements.get(0)
        value = translate.start_of(start) if isinstance(start, m.InitialPose) else None
        if value is not None:
            ticks.add_start(value)
        for sequence, submap in sorted(log.submaps().get(stream, {}).items()):
            none = {} if has_biases else {"biases": (), "sensitivity": b"", "curvature": b""}
            taken = msgspec.structs.replace(submap, **none)
            ticks.add_submap(taken, b"", sightings.get((*stream, sequence), ()))
    ticks.fold_until(float("inf"))
    return solve_fold(ticks.fold, replace(ticks.settings, robust=is_robust))


def compare_minima(
    island: Island,
    landmarks: Mapping[int, Float[np.ndarray, "2"]],
    paths: Mapping[str, Path],
) -> TrueMinimum:
    """Figures of an island in the truth's frame."""
    graph, settings = island.graph, island.settings
    if settings.robust:
        raise NotImplementedError("this cost has plain squares, without a robust loss")
    if settings.joined_ranges:
        raise NotImplementedError("this cost has no central.joined_ranges: leave it out")
    fixed = np.repeat(graph.fixed, np.diff(graph.offset))
    cost = _PlainCost(graph, settings.covariance_factor, fixed)
    ours = cost.of(island.state)
    truth, known = _at_truth(island, landmarks, paths)
    headings = graph.headings[~fixed[graph.headings]]
    rng = np.random.default_rng(0)
    found = [cost.solved(truth)]
    for _ in range(NEARBY):
        near = truth.copy()
        near[headings] += NEARBY_RAD * rng.normal(size=len(headings))
        found.append(cost.solved(near))
    ends = found[0]
    away = ends.state - island.state
    away[graph.headings] = np.angle(np.exp(1j * away[graph.headings]))
    whitened = cost.jacobian(island.state) @ away[cost.free]
    place = float(chi2_quantile(LIKELY, 3))
    other = ends.at_rest and whitened @ whitened > place and ends.cost - ours < place
    firsts = {nodes[1] for nodes in graph.streams.values()}
    pinned_nodes = sorted(({*graph.landmarks.values()} | firsts) & known)
    spans = [np.arange(graph.offset[node], graph.offset[node + 1]) for node in pinned_nodes]
    pinned = fixed.copy()
    pinned[np.concatenate([np.zeros(0, np.int64), *spans])] = True
    given = _PlainCost(graph, settings.covariance_factor, pinned)
    from_ours = np.where(pinned, truth, island.state)
    rise = min(given.solved(state).cost for state in (truth, from_ours)) - ours
    dof = len(cost.free) - len(given.free)
    lower = ours - min(each.cost for each in found)
    return TrueMinimum(lower, bool(other), rise, dof)


def _at_truth(
    island: Island, landmarks: Mapping[int, Float[np.ndarray, "2"]], paths: Mapping[str, Path]
) -> tuple[Values, set[int]]:
    graph, state = island.graph, island.state.copy()
    known: set[int] = set()

    def place(node: int, value: Values) -> None:
        state[graph.offset[node] : graph.offset[node + 1]] = value
        known.add(node)

    for id_, node in graph.landmarks.items():
        if id_ in landmarks:
            place(node, landmarks[id_])
    for contribution, nodes, *_ in graph.submaps:
        path = paths[contribution.robot]
        stamps = np.array([contribution.end_ns, *contribution.local.node_stamps.tolist()])
        poses, there = interpolate_truth(path, stamps)
        for node, pose, is_known in zip(nodes[1:], poses, there, strict=False):
            if is_known:
                place(int(node), pose)
        if contribution.sequence == 0 and not graph.fixed[nodes[0]] and len(path.poses):
            place(int(nodes[0]), path.poses[0])
    return state, known
