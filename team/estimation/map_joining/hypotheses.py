"""Diagnosis: the causes of a misfit, each with its evidence, the best one first.

A hypothesis adds unknowns θ to the graph: a second place of a landmark, a jump of a robot between
two submaps. Its evidence is the cost that they remove,

  e = min_x cost(x) − min_{x, θ} cost(x, θ),

with the robust loss: without a fault χ² of dim θ degrees of freedom, times the covariance scale. A
scan of single submaps proposes hypotheses. The best by evidence per degree of freedom stays in the
graph while the others are tested again.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import is_map
from teamslam.team.estimation.map_joining.gauss_newton import (
    LANDMARK_GATE,
    Island,
    final_cost,
    joint_marginal,
)
from teamslam.team.estimation.map_joining.marginals import scale_of, terms
from teamslam.team.estimation.map_joining.splitting import resolved, robust, split, without
from teamslam.team.estimation.map_joining.submap_graph import Graph
from teamslam.team.estimation.se2 import Pose, compose, inverse, wrapped
from teamslam.team.shapes import Bool, Float, Int64

Values = Float[np.ndarray, " _"]
Costs = Float[np.ndarray, "..."]
Places = Int64[np.ndarray, " n"]
Covariance = Float[np.ndarray, "k k"]

CHANCE = 1e-3  # probability that chance gives any hypothesis enough evidence
SplitCause = Literal["landmark_moved", "identity_shared", "carried_off"]
MOVED: Final = "landmark_moved"
SHARED: Final = "identity_shared"
CARRIED_OFF: Final = "carried_off"
LEAST_SPOILT = 3  # least number of submaps spoilt by one identity of two landmarks
SPOILT = 0.6  # least share of spoilt submaps among those with a landmark elsewhere
FAR = 50.0  # bound of an observation's χ² in a scan, so that an outlier does not decide it
STRAY = 0.1
"""Least share of a landmark's observations at a second place, unless they agree with each other: of
easily misread markers up to 6 of 177 submaps are elsewhere, scattered (UTIAS set 2, landmark 15).
"""
ITERATIONS = 8  # most rounds of the search for two places
SIGMAS = 4.0  # least size of an effect in its standard deviations
JUMP_SIGMAS = 8.0
"""Least size of a robot's jump: a submap with misread landmarks shows one of 4 to 6."""
RESOLVED = 1.5  # least size of an effect in standard deviations of one submap
AT_ONCE = 32  # number of places that a scan evaluates at once
POSE = 3  # degrees of freedom of a jump
LEAST_SIDE = 2  # least number of submaps on each side of a split
PROPOSED = 3  # most hypotheses of a kind solved in a round, by their evidence in the scan
ROUNDS = 6  # most causes that are accepted


ALL = slice(None)  # every observation


class Sights(NamedTuple):
    """Observations of one landmark by time: submap's place in the graph, position [m] and
    covariance (xx, xy, yy) [m²].
    """

    places: Places
    end_ns: Places
    points: Float[np.ndarray, "n 2"]
    spread: Float[np.ndarray, "n 3"]


class Hypothesis(NamedTuple):
    """A cause: the solved graph, the cost that it removes, and its degrees of freedom.

    robots: those that observe the less frequent place, or jump. at_ns: of a jump; 0 at a stream's
    start, whose initial pose is wrong by `value`.
    """

    cause: SplitCause
    subject: int | str
    robots: frozenset[str]
    at_ns: int
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    evidence: float
    dof: int
    island: Island


def sights_of(island: Island, beyond: float = -math.inf) -> dict[int, Sights]:
    """Tabulate the observations of each named landmark whose χ² about one place exceeds a bound."""
    graph, nodes = island.graph, island.graph.landmark_nodes
    points, spread = island.estimate.observations
    scatter = core.scatter_of_landmarks(points, spread, nodes, len(graph.fixed), FAR)
    scattered = set(np.flatnonzero(scatter > beyond).tolist())
    found = {}
    for id_, node in sorted(graph.landmarks.items()):
        if node not in scattered or id_ >= UNNAMED:
            continue
        at = np.flatnonzero(nodes == node)
        of = np.searchsorted(graph.landmark_start, at, side="right") - 1
        keys = [graph.submaps[place].contribution.key for place in of.tolist()]
        order = sorted(range(len(keys)), key=keys.__getitem__)
        if order:
            end_ns = np.array([keys[k][0] for k in order], np.int64)
            found[id_] = Sights(of[order], end_ns, points[at[order]], spread[at[order]])
    return found


class _Two(NamedTuple):
    """Observations at the second place, and the scan's evidence."""

    second: Bool[np.ndarray, " n"]
    evidence: float


def _chi2_about(
    sights: Sights, point: Float[np.ndarray, "*k 2"], own: slice | Bool[np.ndarray, " n"] = ALL
) -> Costs:
    away = sights.points[own] - point
    x, y = away[..., 0], away[..., 1]
    xx, xy, yy = sights.spread[own].T
    chi2: Costs = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    bounded: Costs = np.minimum(chi2, FAR)
    return bounded


def _centre(sights: Sights, own: Bool[np.ndarray, " n"]) -> Values:
    return median(sights.points[own])


def median(values: Float[np.ndarray, "..."]) -> Values:
    """Compute the median over the first axis; faster than `numpy.median` for a few values."""
    ordered, n = np.sort(values, axis=0), len(values)
    middle: Values = 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
    return middle


def _least_side(n: int) -> int:
    return max(LEAST_SIDE, math.ceil(STRAY * n))


def _is_shared(sights: Sights, second: Bool[np.ndarray, " n"]) -> bool:
    """Return whether both places have a share of STRAY, or two observations that agree and are most
    of those elsewhere.
    """
    few = _less_frequent(second)
    count = int(few.sum())
    if count < LEAST_SIDE:
        return False
    if count >= _least_side(len(few)):
        return True
    elsewhere = _chi2_about(sights, _centre(sights, ~few)) > LANDMARK_GATE
    agree = elsewhere & (_chi2_about(sights, _centre(sights, few)) < LANDMARK_GATE)
    return int(agree.sum()) >= max(LEAST_SIDE, SPOILT * int(elsewhere.sum()))


def _less_frequent(second: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    return second if 2 * int(second.sum()) <= len(second) else ~second


def _price(second: Bool[np.ndarray, " n"]) -> float:
    """χ² of the choice of k of n: 2 log((n + 1) n!/(k! (n − k)!)), every k equally likely."""
    n, k = len(second), int(second.sum())
    ratios = np.arange(n - k + 1.0, n + 1.0) / np.arange(1.0, k + 1.0)
    return 2.0 * float(core.log(n + 1.0) + core.log(ratios).sum())


def _split_by(sights: Sights, second: Bool[np.ndarray, " n"], price: float) -> _Two:
    """χ² about one place, less χ² about two and the price of the choice."""
    one = float(_chi2_about(sights, median(sights.points)).sum())
    parts = (
        float(_chi2_about(sights, _centre(sights, own))[own].sum()) for own in (~second, second)
    )
    return _Two(second, one - sum(parts) - price)


def change_of(sights: Sights) -> _Two | None:
    """Find the time at which a landmark's place changes most."""
    n = len(sights.places)
    found = core.change_of(sights.points, sights.spread, _least_side(n), FAR)
    return None if found is None else _Two(np.arange(n) >= found[0], found[1])


def clusters_of(sights: Sights, scale: float, enough: float) -> _Two | None:
    """Find two places among a landmark's observations, in any order.

    scale: the covariance scale, which multiplies the price.
    """
    n = len(sights.places)
    one = _chi2_about(sights, median(sights.points))
    if float(one.sum()) <= enough + scale * _price(np.arange(n) < LEAST_SIDE):
        return None
    gains = [
        np.maximum(one - _chi2_about(sights, sights.points[k : k + AT_ONCE, None]), 0.0).sum(axis=1)
        for k in range(0, n, AT_ONCE)
    ]
    second = _chi2_about(sights, sights.points[int(np.argmax(np.concatenate(gains)))]) < one
    for _ in range(ITERATIONS):
        if not second.any() or second.all():
            return None
        places = [_centre(sights, own) for own in (~second, second)]
        nearer = _chi2_about(sights, places[1]) < _chi2_about(sights, places[0])
        if (nearer == second).all():
            break
        second = nearer
    return _split_by(sights, second, scale * _price(second)) if _is_shared(sights, second) else None


@dataclass(frozen=True, eq=False)
class _Solved:
    """The island with all accepted causes as unknowns, and its covariance scale."""

    island: Island
    scale: float

    @cached_property
    def cost(self) -> float:
        return final_cost(self.island)

    def explained_by(
        self,
        cause: SplitCause,
        subject: int | str,
        robots: frozenset[str],
        found: tuple[Island, float],
        effect: tuple[Values, Covariance],
        *,
        dof: int,
        at_ns: int = 0,
        price: float = 0.0,
    ) -> Hypothesis:
        """Make a hypothesis of a solution with its cost, and of the effect N(value, P)."""
        (island, cost), (value, P) = found, effect
        sigma = tuple(np.sqrt(np.diagonal(P) * self.scale).tolist())
        evidence = self.cost - cost - price
        size = tuple(value.tolist())
        return Hypothesis(cause, subject, robots, at_ns, size, sigma, evidence, dof, island)


def _solved(island: Island) -> _Solved:
    scale = scale_of(terms(island).submaps)
    return _Solved(island, 1.0 if scale is None else max(1.0, scale.value))


def _difference(island: Island, before: int, after: int) -> tuple[Values, Covariance]:
    mean, P = joint_marginal(island, [before, after])
    k = len(mean) // 2
    difference = mean[k:] - mean[:k]
    difference[2:] = wrapped(difference[2:])
    return difference, P[:k, :k] + P[k:, k:] - P[:k, k:] - P[k:, :k]


def _begin_ns(island: Island, place: int) -> int:
    """Return the end of the stream's preceding submap; 0 for the first."""
    own = island.graph.submaps[place].contribution
    ends = (
        each.contribution.end_ns
        for each in island.graph.submaps
        if (each.contribution.stream, each.contribution.sequence + 1) == (own.stream, own.sequence)
    )
    return next(ends, 0)


def _is_misread(base: _Solved, id_: int, own: Sights, second: Bool[np.ndarray, " n"]) -> bool:
    island, gate = base.island, base.scale * LANDMARK_GATE
    return any(
        float(np.median(_chi2_about(own, island.value(node), second))) < gate
        for other, node in island.graph.landmarks.items()
        if other != id_ and other < UNNAMED
    )


def _robots_of(island: Island, places: Places) -> frozenset[str]:
    return frozenset(island.graph.submaps[at].contribution.robot for at in places.tolist())


def _landmark_hypotheses(base: _Solved, level: float) -> Iterator[Hypothesis]:
    enough = base.scale * level
    sights = sights_of(base.island, enough)
    proposals: list[tuple[float, int, SplitCause, Bool[np.ndarray, " n"]]] = []
    for id_, own in sights.items():
        if len(own.places) < 2 * LEAST_SIDE:
            continue
        moved, shared = change_of(own), clusters_of(own, base.scale, enough)
        if moved is not None and moved.evidence > enough:
            proposals.append((moved.evidence, id_, MOVED, moved.second))
        if shared is None or shared.evidence <= enough:
            continue
        if not _is_misread(base, id_, own, shared.second):
            proposals.append((shared.evidence, id_, SHARED, shared.second))
    proposals.sort(key=lambda each: (-each[0], each[1], each[2]))
    graph = base.island.graph
    for _, id_, cause, second in proposals[: 2 * PROPOSED]:
        own, node = sights[id_], graph.landmarks[id_]
        late = set(own.places[second].tolist())
        trial = split(base.island, node, late, _centre(own, second))
        trial.value(node)[:] = _centre(own, ~second)
        found = resolved(trial)
        if found is None:
            continue
        shift = _difference(found[0], node, len(graph.fixed))
        own_sigma = math.sqrt(base.scale * float(np.median(own.spread[:, [0, 2]].max(axis=1))))
        if float(core.hypot(*shift[0])) < RESOLVED * own_sigma and base.scale > 1.0:
            continue
        robots = _robots_of(base.island, own.places[_less_frequent(second)])
        if cause == SHARED:
            price, at_ns = base.scale * _price(second), 0
        else:
            price, at_ns = 0.0, _begin_ns(base.island, int(own.places[second.argmax()]))
        yield base.explained_by(cause, id_, robots, found, shift, dof=2, at_ns=at_ns, price=price)


def _seam_hypotheses(base: _Solved, level: float) -> Iterator[Hypothesis]:
    """Solve the hypotheses of a jump beside a submap that disagrees with the rest, without the
    submap first, since a jump removes no more cost. Before a first submap it is an error of the
    initial pose.
    """
    island, graph = base.island, base.island.graph
    costs = terms(island).submaps
    beyond = (costs.dof >= 1.0) & (costs.chi2 > base.scale * (costs.dof + level))
    ratios = (costs.chi2[beyond] / costs.dof[beyond]).tolist()
    places = np.flatnonzero(beyond).tolist()
    worst = sorted((-ratio, at) for ratio, at in zip(ratios, places, strict=True))
    for _, at in worst[:PROPOSED]:
        joined = graph.submaps[at]
        start, end = int(joined.nodes[0]), int(joined.nodes[1])
        robot, stamp = joined.contribution.robot, joined.contribution.end_ns
        own = joined.contribution.local
        new, before = len(graph.fixed), _begin_ns(island, at)
        of_robot = robot, frozenset({robot})
        dropped = resolved(without(island, [at]))
        if dropped is not None:
            motion = own.end_pose, own.covariance[:3, :3]
            jump = motion_beyond(dropped[0], start, end, *motion)
            yield base.explained_by(
                CARRIED_OFF, *of_robot, dropped, jump, dof=len(own.mean), at_ns=stamp
            )
            if base.cost - dropped[1] <= base.scale * (level + 2.0 * POSE):
                continue
        there = compose(island.value(start), own.end_pose)
        trials = [(split(island, end, {at}, there), stamp, (new, end))]
        if before or _is_known_start(graph, at):
            back = compose(island.value(end), inverse(own.end_pose))
            trials.append((split(island, start, {at}, back), before, (start, new)))
        for trial, at_ns, nodes in trials:
            found = resolved(trial)
            if found is not None:
                jump = _difference(found[0], *nodes)
                yield base.explained_by(CARRIED_OFF, *of_robot, found, jump, dof=POSE, at_ns=at_ns)


def _is_known_start(graph: Graph, place: int) -> bool:
    start = int(graph.submaps[place].nodes[0])
    if is_map(graph.submaps[place].contribution.stream):
        return False
    return bool(graph.fixed[start]) or any(each.nodes == (start,) for each in graph.priors)


def motion_beyond(
    island: Island, start: int, end: int, motion: Pose, covariance: Covariance
) -> tuple[Values, Covariance]:
    """Return the motion between two poses less a measured one N(motion, covariance), which is in
    the frame of the start, in the map's frame.
    """
    mean, P = joint_marginal(island, [start, end])
    predicted = compose(mean[:3], motion)
    s, c = core.sin_and_cos(float(mean[2]))
    J = np.zeros((3, 6))
    J[:, 3:] = np.eye(3)
    J[:, :3] = -np.eye(3)
    J[0, 2], J[1, 2] = predicted[1] - mean[1], mean[0] - predicted[0]
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    jump = mean[3:] - predicted
    jump[2:] = wrapped(jump[2:])
    return jump, dense.congruent(J, P) + dense.congruent(R, covariance)


def _spoilt_by_identity(base: _Solved, _level: float) -> Iterator[Hypothesis]:
    """Propose that one number of two landmarks spoils submaps that observed both: most have that
    landmark worst, between its two places.
    """
    island, graph = base.island, base.island.graph
    chi2 = graph.factors.landmark_chi2(island.state, island.settings.covariance_factor)
    if int((chi2 > base.scale * FAR).sum()) < LEAST_SPOILT:
        return
    worst: list[tuple[int, int]] = []
    for at, joined in enumerate(graph.submaps):
        of = chi2[int(graph.landmark_start[at]) : int(graph.landmark_start[at + 1])]
        if len(of) and float(of.max()) > base.scale * FAR:
            worst.append((at, int(joined.landmarks[int(np.argmax(of))])))
    nodes = [node for _, node in worst]
    id_of = {node: id_ for id_, node in graph.landmarks.items() if id_ < UNNAMED}
    node = max(sorted(set(nodes)), key=nodes.count, default=-1)
    count = nodes.count(node)
    if node not in id_of or count < LEAST_SPOILT or count < SPOILT * len(nodes):
        return
    own = sights_of(island)[id_of[node]]
    if count < STRAY * len(own.places):
        return
    spoilt = [at for at, of in worst if of == node]
    found = resolved(without(island, spoilt))
    if found is None:
        return
    solved, cost = found
    away = own.points[np.isin(own.places, spoilt)] - solved.value(node)
    farthest = away[int(np.argmax(core.hypot(away[:, 0], away[:, 1])))]
    sigma = np.sqrt(np.diagonal(graph.pattern.block(island.selected_covariance, node, node)))
    yield Hypothesis(
        SHARED,
        id_of[node],
        _robots_of(island, np.array(spoilt)),
        0,
        tuple(farthest.tolist()),
        tuple(sigma.tolist()),
        base.cost - cost,
        2 * count,
        solved,
    )


def _is_beyond_doubt(each: Hypothesis, scale: float, level: float) -> bool:
    sizes = [(math.hypot(*each.value[:2]), max(each.sigma[:2]))]
    sizes += [
        (abs(turn), sigma) for turn, sigma in zip(each.value[2:], each.sigma[2:], strict=True)
    ]
    least = JUMP_SIGMAS if each.cause == CARRIED_OFF else SIGMAS
    enough = scale * (level + 2.0 * each.dof)
    return each.evidence > enough and any(size > least * sigma for size, sigma in sizes)


def explain(island: Island) -> tuple[list[Hypothesis], Island]:
    """Find landmarks with two places and robots carried off, and the island with these unknowns."""
    base = _solved(robust(island))
    graph = base.island.graph
    tests = 2 * len(graph.submaps) + len(graph.landmark_nodes)
    level = -2.0 * core.log(CHANCE / max(tests, 1))
    accepted: list[Hypothesis] = []
    for _ in range(ROUNDS):
        found = [
            each
            for propose in (_landmark_hypotheses, _spoilt_by_identity, _seam_hypotheses)
            for each in propose(base, level)
            if _is_beyond_doubt(each, base.scale, level)
        ]
        if not found:
            break
        best = max(found, key=lambda each: each.evidence / each.dof)
        accepted.append(best)
        base = _solved(best.island)
    return _told_apart(accepted, base, level), base.island


def _told_apart(accepted: list[Hypothesis], base: _Solved, level: float) -> list[Hypothesis]:
    """Drop repetitions, and the apparent effects of another fault.

    One number of two landmarks bends paths. Jumps at several places without a sound submap beside
    one are wild measurements, as is a second place that this robot alone observes.
    """
    jumps = [each.subject for each in accepted if each.cause == CARRIED_OFF]
    wild = {
        each.robots
        for each in accepted
        if each.cause == CARRIED_OFF
        and jumps.count(each.subject) > 1
        and not _is_beside_sound(each, base, level)
    }
    is_bent = any(each.cause == SHARED and each.robots not in wild for each in accepted)
    found: dict[tuple[int | str, int], Hypothesis] = {}
    for each in accepted:
        is_jump = each.cause == CARRIED_OFF
        if not (is_jump and is_bent) and each.robots not in wild:
            found.setdefault((each.subject, each.at_ns if is_jump else 0), each)
    return list(found.values())


def _is_beside_sound(jump: Hypothesis, base: _Solved, level: float) -> bool:
    island = base.island
    costs = terms(island).submaps
    is_sound = (costs.chi2 <= base.scale * (costs.dof + level)).tolist()
    return any(
        is_sound[at]
        for at in costs.of_robots.get(str(jump.subject), ())
        if jump.at_ns in (island.graph.submaps[at].contribution.end_ns, _begin_ns(island, at))
    )
