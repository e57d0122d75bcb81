"""A robot's pose in the team's map: the broadcast prior times the robot's own later submaps.

The prior (the joint marginal of the robot's last joined end pose and the landmarks) and the submaps
that are not in it are independent, so their product is exact, up to linearisation. A landmark that
a submap sees where everything else contradicts it (a misread barcode) is left out of that submap,
for this pose only: nothing is remembered, so nobody is locked out. The result is for display and
control; it never enters anything that the robot sends for fusion.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64, UInt32
from scipy.stats import chi2

from team.estimation.gaussian import information
from team.estimation.geometry import compose, transformed, wrapped
from team.estimation.submap import LocalMap
from team.estimation.submap_factor import submap_normal

ITERATIONS = 3
GATE = float(chi2.ppf(0.9999, 2))
"""χ² beyond which what a submap says of a landmark is taken for another landmark's: some twenty are
tested for each pose, and a good one that is left out costs little."""
REDUNDANT = 1e-6
"""The least share of a landmark's information that must be redundant for it to be tested."""
Values = Float[np.ndarray, " _"]


class RobotPrior(NamedTuple):
    """A robot's last joined end pose and landmarks: joint covariance of (x, y, θ, x₁, y₁, …).

    In the frame of the robot's island [m, rad]; ids ascending. A row of zeros is a known constant.
    """

    pose: Float[np.ndarray, "3"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]


class _Link(NamedTuple):
    """A submap of the chain as a factor: where its nodes lie in the state, and its Gaussian."""

    at: Int64[np.ndarray, " nodes"]
    span: Int64[np.ndarray, " m"]
    mean: Values
    information: Float[np.ndarray, "n n"]


class _Solution(NamedTuple):
    """The state of prior pose, landmarks and chain, its covariance, and the chain's factors."""

    state: Values
    spread: Float[np.ndarray, "n n"]
    links: list[_Link]


def team_pose(
    prior: RobotPrior, pending: Sequence[LocalMap], open_window: LocalMap | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """N(pose, covariance) of the robot now, in the prior's frame.

    pending: the robot's submaps behind the prior's pose, in order; open_window: the Gaussian of the
    window in progress. Three Gauss-Newton iterations over the poses of the chain and the landmarks
    that it sees; of the prior only their marginal is used, which is exact. Then, one by one, what
    `_worst` names is left out, and all is solved again.
    """
    chain = [each.without_nodes for each in (*pending, open_window) if each is not None]
    if not chain:
        return prior.pose, prior.covariance[:3, :3]
    while True:
        solution = _solved(prior, chain)
        wrong = _worst(solution)
        if wrong is None:
            last = int(solution.links[-1].at[1])
            pose = solution.state[last : last + 3].copy()
            pose[2] = wrapped(pose[2])
            return pose, solution.spread[last : last + 3, last : last + 3]
        link, landmark = wrong
        chain[link] = _without(chain[link], landmark)


def _solved(prior: RobotPrior, chain: Sequence[LocalMap]) -> _Solution:
    """Gauss-Newton over the chain, and the covariance at its result."""
    seen = np.unique(np.concatenate([local.ids for local in chain]))
    index = np.flatnonzero(np.isin(prior.ids, seen))
    kept = np.concatenate([np.arange(3), *(3 + 2 * k + np.arange(2) for k in index)])
    covariance = prior.covariance[np.ix_(kept, kept)]
    free = np.diag(covariance) > 0.0
    metric = np.zeros_like(covariance)
    metric[np.ix_(free, free)] = information(covariance[np.ix_(free, free)], "the team's prior")
    mean = np.concatenate([prior.pose, prior.means[index].ravel()])
    state, links = _chained(mean, prior.ids[index], chain)
    unknown = np.concatenate([free, np.ones(len(state) - len(free), dtype=np.bool_)])
    for _ in range(ITERATIONS):
        hessian, gradient = _normal(state, mean, metric, links)
        state[unknown] -= np.linalg.solve(hessian[np.ix_(unknown, unknown)], gradient[unknown])
    hessian, _ = _normal(state, mean, metric, links)
    spread = np.zeros_like(hessian)
    spread[np.ix_(unknown, unknown)] = information(
        hessian[np.ix_(unknown, unknown)], "the information of the team's pose"
    )
    return _Solution(state, spread, links)


def _worst(solution: _Solution) -> tuple[int, int] | None:
    """The (link, place in it) of the landmark that the rest contradicts most; None within GATE.

    Baarda's test of a shift of one landmark in one submap: with v = r at the solution, W = P⁻¹ and
    Q = P − J Σ Jᵀ, T = (W v)ₗᵀ ((W Q W)ₗₗ)⁻¹ (W v)ₗ is by how much the cost falls if that submap
    says nothing about that landmark; χ² with two degrees of freedom. Where nothing else says where
    the landmark is, W Q W is zero there and nothing can be tested.
    """
    worst, found = GATE, None
    for k, link in enumerate(solution.links):
        own, slope, _ = submap_normal(solution.state, link.at, link.mean, link.information)
        of_residual = own[:, 3:]  # Jᵀ W, since J is the identity behind the start pose
        span = solution.spread[np.ix_(link.span, link.span)]
        for place in range(len(link.at) - 2):
            at = slice(3 + 2 * place, 5 + 2 * place)
            weight = own[3:, 3:][at, at]
            tested = weight - of_residual[:, at].T @ span @ of_residual[:, at]
            if np.linalg.eigvalsh(tested)[0] < REDUNDANT * np.linalg.eigvalsh(weight)[0]:
                continue
            gain = float(slope[3:][at] @ np.linalg.solve(tested, slope[3:][at]))
            if gain > worst:
                worst, found = gain, (k, place)
    return found


def _without(local: LocalMap, place: int) -> LocalMap:
    """The map as if it had not seen its landmark at this place."""
    rows = np.delete(np.arange(len(local.mean)), [3 + 2 * place, 4 + 2 * place])
    ids = np.delete(local.ids, place)
    return LocalMap(ids, local.mean[rows], local.covariance[np.ix_(rows, rows)])


def _chained(
    mean: Values, ids: UInt32[np.ndarray, " _"], chain: Sequence[LocalMap]
) -> tuple[Values, list[_Link]]:
    """The state (prior pose, prior landmarks, then what each submap adds) and the factors."""
    place = {id_: 3 + 2 * k for k, id_ in enumerate(ids.tolist())}
    parts, length = [mean], len(mean)
    start, pose = 0, mean[:3]
    links = []
    for local in chain:
        end = length
        parts.append(compose(pose, local.end_pose))
        length += 3
        for id_, point in zip(local.ids.tolist(), local.landmarks, strict=True):
            if id_ not in place:
                place[id_] = length
                parts.append(transformed(pose, point))
                length += 2
        at = np.array([start, end, *(place[id_] for id_ in local.ids.tolist())], dtype=np.int64)
        sizes = [3, 3, *([2] * len(local.ids))]
        span = np.concatenate([np.arange(a, a + k) for a, k in zip(at, sizes, strict=True)])
        links.append(_Link(at, span, local.mean, information(local.covariance, "a submap")))
        start, pose = end, compose(pose, local.end_pose)
    return np.concatenate(parts), links


def _normal(
    state: Values, mean: Values, metric: Float[np.ndarray, "p p"], links: Sequence[_Link]
) -> tuple[Float[np.ndarray, "n n"], Values]:
    """Σ JᵀWJ and Σ JᵀWr of the prior and the chain."""
    n, p = len(state), len(mean)
    hessian, gradient = np.zeros((n, n)), np.zeros(n)
    residual = state[:p] - mean
    residual[2] = wrapped(residual[2])
    hessian[:p, :p], gradient[:p] = metric, metric @ residual
    for link in links:
        own, slope, _ = submap_normal(state, link.at, link.mean, link.information)
        hessian[np.ix_(link.span, link.span)] += own
        gradient[link.span] += slope
    return hessian, gradient
