"""Saved maps of earlier days in an island: tests of their landmarks, and landmarks that moved.

A saved map is a Gaussian over its landmarks in a free frame. A displacement e of landmark i from
its place in it lowers the joint cost by

    χ²_i = g_iᵀ M_ii⁻¹ g_i,   g = W r,   M = W − W J Σ Jᵀ W,

with the map's residual r, information W and Jacobian J, and the island's covariance Σ; e = M_ii⁻¹
g_i with covariance M_ii⁻¹ (Baarda 1968). Without a displacement χ²_i has two degrees of freedom. A
landmark beyond the limit gets a second node, its former place, which the map alone observes; the
others are tested again, the worst first. A submap may associate an unnamed landmark with its
neighbour, so two submaps are needed to move it, and the association of one is undone.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import combinations, count
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.contribution import RobotBias, Stream, is_map, named
from teamslam.team.estimation.gaussian import deviation, information
from teamslam.team.estimation.map_joining.alignment import align
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.submap_graph import (
    Graph,
    Joined,
    add_former_place,
    tie_landmarks,
)
from teamslam.team.estimation.se2 import transformed
from teamslam.team.shapes import Bool, Float

FALSE_ALARM = 1e-3  # probability that an unmoved landmark counts as moved in the final map
SEQUENTIAL = 1e-6  # the same of one test in a running map, repeated with every tick
NEGLIGIBLE = 1e-9
"""Share of a landmark's information that the rest of a map must test for a test to count."""
LEAST_SUBMAPS = 2
"""Fewest submaps that place a landmark elsewhere for it to have moved, if it has no number or its
former place is empty.
"""
REMEDY = "load the right map, or save a new one"  # for a saved map that does not join
LEAST_AGREEING = 3  # fewest landmarks that must agree where others disagree
MOST_PAIRS = 2000  # most pairs of shared landmarks from which a frame is proposed


class Displacement(NamedTuple):
    """Displacement [m] of a landmark since a saved map, in the island's frame.

    chi2: of two degrees of freedom. is_apart: it has two nodes.
    """

    landmark: int
    by: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    chi2: float
    is_apart: bool = False

    @property
    def sigma_m(self) -> float:
        """Standard deviation [m] of one coordinate, the mean of both."""
        return deviation(0.5 * float(np.trace(self.covariance)))


def maps_of(graph: Graph) -> list[Joined]:
    """List the saved maps of an island by name, without the station of fixes."""
    found = (
        each
        for each in graph.submaps
        if is_map(each.contribution.stream) and len(each.contribution.local.ids)
    )
    return sorted(found, key=lambda each: each.contribution.stream)


def displacements(
    island: Island, saved: Joined, among: Collection[int] | None = None
) -> list[Displacement]:
    """Estimate the displacement of each landmark of a saved map that others determine, by id.

    among: nodes to test, without those apart; None: all.
    """
    id_of = {node: id_ for id_, node in island.graph.landmarks.items()}
    nodes = saved.landmarks.tolist()
    by_others = _observed_by_others(island.graph, saved) if among is None else among
    tested = [k for k, node in enumerate(nodes) if node in by_others and node in id_of]
    found = [
        Displacement(id_of[nodes[k]], *each)
        for k, each in zip(tested, _tests(island, saved, tested), strict=True)
        if each is not None
    ]
    if among is not None:
        return sorted(found, key=lambda each: each.landmark)
    found += displacements_apart(island, saved.contribution.stream)
    return sorted(found, key=lambda each: each.landmark)


def displacements_apart(island: Island, stream: Stream) -> list[Displacement]:
    """Estimate the displacements of a saved map's landmarks with two nodes."""
    landmarks = island.graph.landmarks
    return [
        _apart(island, id_, former, landmarks[id_])
        for (of, id_), former in island.graph.former.items()
        if of == stream and id_ in landmarks
    ]


def is_confirmed(graph: Graph, saved: Joined, id_: int) -> bool:
    """Return whether LEAST_SUBMAPS other submaps, or a condensed one, observe a landmark."""
    node = graph.landmarks[id_]
    if graph.condensed is not None and (graph.condensed.nodes == node).any():
        return True
    others = (each.landmarks == node for each in graph.submaps if each is not saved)
    return sum(bool(each.any()) for each in others) >= LEAST_SUBMAPS


def _observed_by_others(graph: Graph, saved: Joined) -> set[int]:
    others = {n for each in graph.submaps if each is not saved for n in each.landmarks.tolist()}
    return others if graph.condensed is None else others | {*graph.condensed.nodes.tolist()}


def _tests(
    island: Island, saved: Joined, tested: Sequence[int]
) -> list[tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float] | None]:
    """Compute (displacement, covariance, χ²) of landmarks, by index in the saved map; None if
    undetermined.
    """
    if not tested:
        return []
    graph, state = island.graph, island.state
    factor = island.settings.covariance_factor
    W = saved.contribution.information[3:, 3:] / factor
    start = int(graph.offset[saved.nodes[0]])
    s, c = core.sin_and_cos(state[start + 2])
    rotation = np.array([[c, -s], [s, c]])
    at = graph.offset[saved.landmarks]
    points = np.column_stack([state[at], state[at + 1]])
    inside = dense.product(points - state[start : start + 2], rotation)
    bias_at = graph.offset[saved.nodes[len(saved.nodes) - len(saved.biases) :]]
    shifts = saved.sensitivity[:, 3:] if len(saved.biases) else np.zeros((0, len(W)))
    z = saved.contribution.local.landmarks.ravel()
    residual = z + dense.product(state[bias_at], shifts) - inside.ravel()
    g = dense.product(W, residual)
    columns = np.array([n for k in tested for n in (2 * k, 2 * k + 1)])
    own = W[:, columns]
    # Jᵀ W e: h = Rᵀ(x − t) − bᵀ S of each landmark, by landmark, start pose and biases.
    right = np.zeros((len(state), len(columns)))
    x, y = own[0::2], own[1::2]
    along = np.stack([c * x - s * y, s * x + c * y])
    np.add.at(right, at, along[0])
    np.add.at(right, at + 1, along[1])
    right[start : start + 2] -= along.sum(axis=1)
    right[start + 2] += (inside[:, 1, None] * x - inside[:, 0, None] * y).sum(axis=0)
    right[bias_at] -= dense.product(shifts, own)
    right[np.repeat(graph.fixed, np.diff(graph.offset))] = 0.0
    M = own[columns] - dense.product(right.T, island.posterior.solve(right))
    found: list[tuple[Float[np.ndarray, 2], Float[np.ndarray, "2 2"], float] | None] = []
    for k, first in zip(tested, range(0, len(columns), 2), strict=True):
        block = M[first : first + 2, first : first + 2]
        block = 0.5 * (block + block.T)
        if not _is_tested(block, own[2 * k : 2 * k + 2, first : first + 2]):
            found.append(None)
            continue
        P = information(block, "a displacement")
        e = dense.product(P, g[2 * k : 2 * k + 2])
        chi2 = float(dense.product(e, g[2 * k : 2 * k + 2]))
        turned = dense.product(dense.product(rotation, P), rotation.T)
        found.append((-dense.product(rotation, e), turned, chi2))
    return found


def _is_tested(block: Float[np.ndarray, "2 2"], own: Float[np.ndarray, "2 2"]) -> bool:
    scale, trace = NEGLIGIBLE * float(np.trace(own)), float(block[0, 0] + block[1, 1])
    determinant = float(block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0])
    return bool(block[0, 0] > scale and block[1, 1] > scale) and determinant > scale * trace


def _apart(island: Island, id_: int, former: int, present: int) -> Displacement:
    mean, P = joint_marginal(island, [former, present])
    by = mean[2:] - mean[:2]
    covariance = P[:2, :2] + P[2:, 2:] - P[:2, 2:] - P[2:, :2]
    metric = information(covariance, f"the displacement of landmark {id_}")
    chi2 = float(dense.product(dense.product(by, metric), by))
    return Displacement(id_, by, covariance, chi2, is_apart=True)


def separate(island: Island, saved: Joined, ids: Iterable[int]) -> Island:
    """Add a node for the former place of landmarks of a saved map."""
    graph, state = island.graph, island.state
    stream = saved.contribution.stream
    nodes = {node: k for k, node in enumerate(saved.landmarks.tolist())}
    by_others = _observed_by_others(graph, saved)
    start = int(graph.offset[saved.nodes[0]])
    for id_ in sorted(ids):
        node = graph.landmarks[id_]
        local = saved.contribution.local.landmarks[nodes[node]]
        value = transformed(state[start : start + 3], local)
        graph, state = add_former_place(graph, state, stream, id_, value, shared=node in by_others)
    return replace(island, graph=graph, state=state)


def dissociate(island: Island, saved: Joined, id_: int) -> Island:
    """Assign the other submaps' place of a saved map's landmark to a new unnamed landmark."""
    apart = separate(island, saved, [id_])
    former = dict(apart.graph.former)
    place = former.pop((saved.contribution.stream, id_))
    landmarks = dict(apart.graph.landmarks)
    other = next(number for number in count(UNNAMED) if number not in landmarks)
    landmarks |= {id_: place, other: landmarks[id_]}
    return replace(apart, graph=replace(apart.graph, landmarks=landmarks, former=former))


def reunite(island: Island, stream: Stream, id_: int) -> Island:
    """Tie a landmark's former place to its present one."""
    graph = island.graph
    former = {at: node for at, node in graph.former.items() if at != (stream, id_)}
    node = graph.former[stream, id_]
    aside = max([*graph.landmarks, 0]) + 1
    landmarks = {**graph.landmarks, aside: node}
    graph = replace(graph, former=former, landmarks=landmarks)
    graph, state = tie_landmarks(graph, island.state, {aside: id_})
    return replace(island, graph=graph, state=state)


def next_change(
    island: Island, chance: float, nodes: Collection[int] | None = None
) -> tuple[Joined, Displacement] | None:
    """Find the landmark that disagrees most with its place in a saved map, beyond chance.

    nodes: those to test in a running map, in which an unnamed landmark needs a second submap.
    """
    limit, graph = chi2_limit(2, chance), island.graph
    found = [
        (each.chi2, saved, each)
        for saved in maps_of(graph)
        for each in displacements(island, saved, nodes)
        if not each.is_apart and each.chi2 > limit
        if nodes is None or each.landmark < UNNAMED or is_confirmed(graph, saved, each.landmark)
    ]
    if not found:
        return None
    _, saved, worst = max(found, key=lambda each: each[0])
    return saved, worst


def returned(island: Island, chance: float) -> list[tuple[Stream, int]]:
    """List the landmarks apart whose two places agree within chance."""
    limit = chi2_limit(2, chance)
    return [
        (saved.contribution.stream, each.landmark)
        for saved in maps_of(island.graph)
        for each in displacements(island, saved)
        if each.is_apart and each.chi2 <= limit
    ]


class Replaced(NamedTuple):
    """Error of a robot that differs from a saved map; chi2: one degree of freedom."""

    error: RobotBias
    saved: Stream
    value: float
    before: float
    chi2: float


def replaced_sensors(island: Island) -> list[Replaced]:
    """List the robots' errors that differ from a saved map beyond chance."""
    graph, limit = island.graph, chi2_limit(1, FALSE_ALARM)
    saved_at = {node: of for of, node in graph.remembered.items()}
    found = []
    for prior in graph.priors if saved_at else ():
        if not prior.is_of_robot or len(prior.nodes) == 1:
            continue
        (value, before), P = joint_marginal(island, prior.nodes)
        by = float(value - before)
        chi2 = by * by / float(P[0, 0] + P[1, 1] - 2.0 * P[0, 1])
        if chi2 > limit:
            stream, error = saved_at[prior.nodes[1]]
            found.append(Replaced(error, stream, float(value), float(before), chi2))
    return found


def contradiction(island: Island) -> tuple[Stream, str] | None:
    """Find a saved map with most of today's landmarks elsewhere; return the reason."""
    for saved in maps_of(island.graph):
        stream = saved.contribution.stream
        moved = sum(of == stream for of, _ in island.graph.former)
        nodes = {*saved.landmarks.tolist()} & {*island.graph.landmarks.values()}
        same = len(nodes & _observed_by_others(island.graph, saved))
        if moved >= LEAST_AGREEING and moved >= same:
            return stream, (
                f"{moved} of its {moved + same} landmarks that were seen today are elsewhere: it "
                "is the map of another place, or half of the place has changed"
            )
    return None


def disagreeing(
    main: Island, other: Island, ids: Sequence[int], confidence: float
) -> list[int] | str:
    """Find the landmarks that moved between two islands, one with a saved map.

    Returns the reason if no more than half agree within `confidence`.
    """
    n = len(ids)
    in_main = joint_marginal(main, [main.graph.landmarks[id_] for id_ in ids])
    in_other = joint_marginal(other, [other.graph.landmarks[id_] for id_ in ids])
    a, b = in_main[0].reshape(-1, 2), in_other[0].reshape(-1, 2)
    agree = agreeing(a, in_main[1], b, in_other[1], chi2_limit(2, 1.0 - confidence))
    count = int(agree.sum())
    if count < LEAST_AGREEING or 2 * count <= n:
        return _refusal(main, other, n, count)
    return [id_ for id_, is_same in zip(ids, agree.tolist(), strict=True) if not is_same]


def agreeing(
    a: Float[np.ndarray, "n 2"],
    A: Float[np.ndarray, "m m"],
    b: Float[np.ndarray, "n 2"],
    B: Float[np.ndarray, "m m"],
    limit: float,
) -> Bool[np.ndarray, " n"]:
    """Mark the landmarks of two maps, N(a, A) and N(b, B), that one rigid motion places.

    From the largest set by the motion of a pair, those that disagree are removed, the worst first,
    and those that agree are added.
    """
    agree = np.ones(len(a), np.bool_)
    if _disagreements(a, A, b, B, agree).max() > limit:
        agree = _largest_agreement(a, A, b, B, limit)
        if agree.sum() < LEAST_AGREEING:
            return agree
    for _ in range(len(a)):
        chi2 = _disagreements(a, A, b, B, agree)
        worst = int(np.argmax(np.where(agree, chi2, -np.inf)))
        if chi2[worst] > limit and agree.sum() > LEAST_AGREEING:
            agree[worst] = False
            continue
        best = int(np.argmin(np.where(agree, np.inf, chi2)))
        if agree[best] or chi2[best] > limit:
            break
        agree[best] = True
    return agree


def _refusal(main: Island, other: Island, shared: int, agreeing: int) -> str:
    of = next(each for island in (main, other) for each in maps_of(island.graph))
    return (
        f"{shared} shared landmarks disagree: of {named(of.contribution.stream)} no more than "
        f"{agreeing} are at one place; it is the map of another site, or half of the site has "
        f"changed: {REMEDY}"
    )


def _largest_agreement(
    a: Float[np.ndarray, "n 2"],
    A: Float[np.ndarray, "m m"],
    b: Float[np.ndarray, "n 2"],
    B: Float[np.ndarray, "m m"],
    limit: float,
) -> Bool[np.ndarray, " n"]:
    """Mark the most landmarks that the rigid motion of one pair places within the limit.

    The motion from i and j turns bⱼ − bᵢ to aⱼ − aᵢ and maps middle to middle.
    """
    n = len(a)
    best = np.zeros(n, np.bool_)
    pairs = list(combinations(range(n), 2))
    for i, j in pairs[:: -(-len(pairs) // MOST_PAIRS)]:
        to, of = a[j] - a[i], b[j] - b[i]
        turn = core.atan2(to[1], to[0]) - core.atan2(of[1], of[0])
        s, c = core.sin_and_cos(turn)
        R = np.array([[c, -s], [s, c]])
        d = a - 0.5 * (a[i] + a[j]) - dense.product(b - 0.5 * (b[i] + b[j]), R.T)
        P = _relative(A, i, j) + _turned(_relative(B, i, j), s, c)
        # The direction of the pair is uncertain across it; far from the pair by as much more.
        far = core.hypot(*(a - 0.5 * (a[i] + a[j])).T) / max(core.hypot(*to), 1e-12)
        spread = P[i] + P[j]
        P = P + core.squared(far)[:, None, None] * spread
        determinant = P[:, 0, 0] * P[:, 1, 1] - P[:, 0, 1] * P[:, 1, 0]
        chi2 = (
            P[:, 1, 1] * d[:, 0] * d[:, 0]
            - 2.0 * P[:, 0, 1] * d[:, 0] * d[:, 1]
            + P[:, 0, 0] * d[:, 1] * d[:, 1]
        ) / determinant
        agree = chi2 <= limit
        if agree.sum() > best.sum():
            best = agree
    return best


def _relative(P: Float[np.ndarray, "m m"], i: int, j: int) -> Float[np.ndarray, "n 2 2"]:
    n = len(P) // 2
    grid = P.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)
    own = grid[np.arange(n), np.arange(n)]
    middle = 0.25 * (grid[i, i] + grid[i, j] + grid[j, i] + grid[j, j])
    cross = 0.5 * (grid[:, i] + grid[:, j])
    found: Float[np.ndarray, "n 2 2"] = own + middle - cross - cross.transpose(0, 2, 1)
    return found


def _turned(P: Float[np.ndarray, "n 2 2"], s: float, c: float) -> Float[np.ndarray, "n 2 2"]:
    xx, xy, yy = P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]
    across = 2.0 * c * s * xy
    x, y = c * c * xx - across + s * s * yy, s * s * xx + across + c * c * yy
    between = c * s * (xx - yy) + (c * c - s * s) * xy
    found: Float[np.ndarray, "n 2 2"] = np.stack([x, between, between, y], axis=1).reshape(-1, 2, 2)
    return found


def _disagreements(
    a: Float[np.ndarray, "n 2"],
    A: Float[np.ndarray, "m m"],
    b: Float[np.ndarray, "n 2"],
    B: Float[np.ndarray, "m m"],
    agree: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Compute each landmark's χ² of two degrees of freedom against those that agree.

    With d = a − (R b + t) at the motion of the agreeing landmarks I, their covariance D and
    Jacobian J by the motion of covariance N: in I by the module's equation; any other k is
    predicted as D_kI D_II⁻¹ d_I.
    """
    n, inside = len(a), np.repeat(agree, 2)
    of = np.ix_(inside, inside)
    x, y, turn = align(a[agree], A[of], b[agree], B[of]).a_from_b
    s, c = core.sin_and_cos(turn)
    R = np.array([[c, -s], [s, c]])
    turned = dense.product(b, R.T)
    d = (a - turned - [x, y]).ravel()
    T = np.kron(np.eye(n), R)
    D = A + dense.product(dense.product(T, B), T.T)
    J = np.zeros((2 * n, 3))
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[1::2, 2] = -turned[:, 1], turned[:, 0]
    W = information(D[of], "the shared landmarks of two maps")
    gain = dense.product(D[:, inside], W)
    along = dense.product(W, J[inside])
    N = information(dense.product(J[inside].T, along), "the motion between two maps")
    M = W - dense.product(dense.product(along, N), along.T)
    g = dense.product(W, d[inside])
    G = J - dense.product(gain, J[inside])
    e = d - dense.product(gain, d[inside])
    S = D - dense.product(gain, D[inside]) + dense.product(dense.product(G, N), G.T)
    found = np.empty(n)
    place = np.cumsum(agree) - 1
    for k in range(n):
        at = 2 * int(place[k]) if agree[k] else 2 * k
        block, own = (M, g) if agree[k] else (S, e)
        two = slice(at, at + 2)
        metric = information(0.5 * (block[two, two] + block[two, two].T), "a difference")
        found[k] = float(dense.product(dense.product(own[two], metric), own[two]))
    return found
