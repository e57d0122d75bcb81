"""Marginals of a joined map, and the agreement of its submaps, in the frame of an island."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress, pairwise, repeat
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from teamslam.team.config import UNNAMED, Bias
from teamslam.team.estimation.consistency import Scale, chi2_quantile, covariance_scale
from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.gaussian import UNSOLVABLE, deviation
from teamslam.team.estimation.map_joining.condensed import SubmapCosts
from teamslam.team.estimation.map_joining.conditioning import RobotPrior, SubmapCorrection
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal, solve_island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.landmark_view import (
    blocks_of,
    joint,
    known,
    points_of,
)
from teamslam.team.estimation.map_joining.submap_graph import Graph
from teamslam.team.shapes import Bool, Float, UInt32

BELIEVED = 0.5  # least weight of a landmark in a submap for the submap to be believed about it

STEP = 0.1  # step of a derivative along a bias, in its standard deviations
FAR_TOO_SMALL = 3.0
"""Covariance scale from which the robust loss distorts it: at 4 by a few per cent, at 25 by 1.7."""
ALL = slice(None)  # every submap
MOST_CORRELATED = 0.97  # largest correlation of a submap's error with that of the next one


class LandmarkMap(NamedTuple):
    """Landmarks by ascending id: means [m], joint covariance [m²] of (x₁, y₁, x₂, …)."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]


class LandmarkBlocks(NamedTuple):
    """Landmarks by ascending id: means [m], each with its own covariance [m²]."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariances: Float[np.ndarray, "L 2 2"]


class Trajectory(NamedTuple):
    """Smoothed poses in their order, each with its covariance."""

    poses: Float[np.ndarray, "K 3"]
    covariances: Float[np.ndarray, "K 3 3"]


class EndPoses(NamedTuple):
    """End poses of a stream's submaps, each with its covariance.

    crosses: covariance of each pose with the previous one, first the start.
    """

    poses: Float[np.ndarray, "K 3"]
    covariances: Float[np.ndarray, "K 3 3"]
    start: Float[np.ndarray, "3"]
    start_covariance: Float[np.ndarray, "3 3"]
    crosses: Float[np.ndarray, "K 3 3"]


class BiasEstimate(NamedTuple):
    """Estimate and standard deviation of an error that a stream's submaps share."""

    stream: Stream
    bias: Bias
    value: float
    sigma: float


class SightingCost(NamedTuple):
    """Unweighted χ² of an inter-robot measurement, of at most 2 degrees of freedom."""

    robot: str
    teammate: str
    chi2: float


class Agreement(NamedTuple):
    """Joint cost Σ w χ² and its degrees of freedom, in total, per robot (an inter-robot measurement
    counts for its observer) and per submap; unweighted χ² of the inter-robot measurements, oldest
    first. A discounted landmark counts by its weight.
    """

    chi2: float
    dof: float
    robots: dict[str, tuple[float, float]]
    submaps: SubmapCosts
    sightings: tuple[SightingCost, ...] = ()


def bias_estimates(fold: Fold) -> list[BiasEstimate]:
    """Estimate each stream's shared errors (the robot's plus the team's), in its island."""
    return sorted(each for island in fold.islands.values() for each in _biases_in(island))


_BIASES: WeakKeyDictionary[Island, list[BiasEstimate]] = WeakKeyDictionary()
"""Cache of the biases of present islands."""


def _biases_in(island: Island) -> list[BiasEstimate]:
    found = _BIASES.get(island)
    if found is None:
        found = _BIASES[island] = _found_biases(island)
    return found


def _found_biases(island: Island) -> list[BiasEstimate]:
    common = island.graph.common
    own = sorted(island.graph.biases.items())
    joined = [(node, common[bias]) for (_, bias), node in own if bias in common]
    union = sorted({node for pair in joined for node in pair})
    among = joint_marginal(island, union)[1] if union else np.empty((0, 0))
    place = {node: k for k, node in enumerate(union)}
    found = []
    for (stream, bias), node in own:
        if bias in common:
            pair = [node, common[bias]]
            mean = island.state[island.graph.offset[pair]]
            of = [place[node] for node in pair]
            covariance = among[np.ix_(of, of)]
        else:
            mean, covariance = _own_marginal(island, node)
        sigma = deviation(covariance.sum())
        found.append(BiasEstimate(stream, bias, float(mean.sum()), sigma))
    return found


class Scatter(NamedTuple):
    """Standard deviation of a shared error by the submaps' scatter, and its square's freedom."""

    sigma: float
    freedom: float


def scatter_of(fold: Fold, of: BiasEstimate) -> Scatter:
    """Estimate the standard deviation of a bias from the scatter of the submaps' contributions.

    With c = A⁻¹u, where u picks the bias, submap k moves the estimate by s_k = −c · ∇(w χ²_k)/2.
    Errors that last longer than a window correlate the s_k of a stream, here as an autoregressive
    process of first order with coefficient ρ: variance and degrees of freedom are

        g Σ_k s_k²,   (Σ_r v_r)²/(g Σ_r v_r²/n_r),   g = (1 + ρ)/(1 − ρ),

    with v_r = Σ s_k² of the n_r submaps of stream r (Welch 1947). ρ is that of all streams, less
    its bias in short series (Kendall 1954), at least 0. Independent errors with the submaps'
    covariances give `of.sigma`. Condensed submaps are not counted.
    """
    key = of.stream, of.bias
    island = next(each for each in fold.islands.values() if key in each.graph.biases)
    graph, now = island.graph, island.estimate
    nodes = [graph.biases[key]]
    nodes += [node for bias, node in graph.common.items() if bias == of.bias]
    c = island.posterior.inverse_columns(graph.offset[nodes]).sum(axis=1)
    step = STEP / of.sigma * c
    rise = island.moved(step).estimate.counted_chi2 - island.moved(-step).estimate.counted_chi2
    moves = -0.25 * of.sigma / STEP * now.weights * rise
    chains: dict[Stream, list[tuple[int, int]]] = {}
    for k, each in enumerate(graph.submaps):
        chains.setdefault(each.contribution.stream, []).append((each.contribution.sequence, k))
    return scatter_of_series(
        [moves[[k for _, k in sorted(chain)]] for _, chain in sorted(chains.items())]
    )


def scatter_of_series(chains: Sequence[Float[np.ndarray, " _"]]) -> Scatter:
    """Estimate the standard deviation of the sum of autoregressive series of mean 0."""
    squares = np.array([(s * s).sum() for s in chains])
    total = float(squares.sum())
    if total == 0.0:
        return Scatter(0.0, math.inf)
    counts = np.array([len(s) for s in chains])
    rho = math.fsum(float((s[1:] * s[:-1]).sum()) for s in chains) / total
    rho = min(max(rho + (1.0 + 3.0 * rho) / float(counts.sum()), 0.0), MOST_CORRELATED)
    longer = (1.0 + rho) / (1.0 - rho)
    freedom = total**2 / (longer * float((squares * squares / counts).sum()))
    return Scatter(math.sqrt(longer * total), freedom)


def confirmed(fold: Fold, submaps: int, unnamed: int = 1) -> list[int]:
    """List the main island's landmarks in at least `submaps` submaps where their weight is at least
    BELIEVED, unnamed ones in the larger of `submaps` and `unnamed`, and those of a saved map.
    """
    island = fold.main
    if submaps <= 1 and unnamed <= 1:
        return known(island)
    nodes = np.concatenate([each.landmarks for each in island.graph.submaps])
    found, counts = np.unique(
        nodes[island.estimate.landmark_weights >= BELIEVED], return_counts=True
    )
    count_of = dict(zip(found.tolist(), counts.tolist(), strict=True))
    before = island.graph.departed.believed
    graph, node_of = island.graph, island.graph.landmarks
    maps = (graph.submaps[k].landmarks.tolist() for k in graph.saved_maps.tolist())
    saved = {node for each in maps for node in each}
    return [
        id_
        for id_ in known(island)
        if node_of.get(id_, -1) in saved
        or count_of.get(node_of.get(id_, -1), 0) + before.get(id_, 0)
        >= (max(submaps, unnamed) if id_ >= UNNAMED else submaps)
    ]


def landmark_map(fold: Fold, ids: Sequence[int] | None = None) -> LandmarkMap:
    """Return landmarks of the main island with joint covariance, including `landmark_sigma`."""
    chosen = known(fold.main) if ids is None else sorted(ids)
    mean, covariance = joint(fold.main, [], chosen)
    covariance = covariance + fold.main.settings.landmark_sigma**2 * np.eye(len(covariance))
    return LandmarkMap(np.array(chosen, dtype=np.uint32), mean.reshape(-1, 2), covariance)


def landmark_blocks(fold: Fold, ids: Sequence[int] | None = None) -> LandmarkBlocks:
    """Return landmarks of the main island with separate covariances, including `landmark_sigma`."""
    island = fold.main
    own = island.settings.landmark_sigma**2 * np.eye(2)
    chosen = known(island) if ids is None else sorted(ids)
    covariances = blocks_of(island, chosen) + own
    return LandmarkBlocks(np.array(chosen, dtype=np.uint32), points_of(island, chosen), covariances)


def last_pose(fold: Fold, stream: Stream) -> Float[np.ndarray, "3"]:
    """Return the end pose of the stream's last submap, in its island's frame."""
    island = fold.islands[fold.home[stream]]
    return island.value(island.graph.streams[stream][-1])


def main_priors(
    fold: Fold, streams: Sequence[Stream], most: int, chosen: Sequence[int]
) -> dict[Stream, RobotPrior]:
    """Make the priors of streams of the main island: last end pose and landmarks, jointly.

    chosen: landmarks by ascending id, of which a prior has the `most` that are nearest to its pose.
    """
    island, priors = fold.main, {}
    ids, biases = np.array(chosen, np.uint32), _biases_in(fold.main)
    places = points_of(island, ids.tolist())
    for stream in streams:
        node = island.graph.streams[stream][-1]
        offsets = places - island.value(node)[:2]
        order = np.argsort((offsets * offsets).sum(axis=1), kind="stable")
        nearest = ids[np.sort(order[:most])]
        mean, covariance = joint(island, [node], nearest.tolist())
        own = tuple((b.bias, b.value, b.sigma) for b in biases if b.stream == stream)
        shared = SubmapCorrection(island.settings.covariance_factor, own)
        points = mean[3:].reshape(-1, 2)
        priors[stream] = RobotPrior(mean[:3], nearest, points, covariance, shared)
    return priors


def trajectory(fold: Fold, robot: str, incarnation: int) -> EndPoses:
    """Return the end poses of a stream's submaps, in its island's frame."""
    island = fold.island(robot, incarnation)
    nodes = island.graph.streams[(robot, incarnation)]
    (start, start_covariance), *ends = (_own_marginal(island, node) for node in nodes)
    return EndPoses(
        np.array([pose for pose, _ in ends]),
        np.array([spread for _, spread in ends]),
        start,
        start_covariance,
        np.array([_cross(island, after, before) for before, after in pairwise(nodes)]),
    )


def _cross(island: Island, row: int, column: int) -> Float[np.ndarray, "3 3"]:
    if island.graph.fixed[row] or island.graph.fixed[column]:
        return np.zeros((3, 3))
    return island.graph.pattern.block(island.selected_covariance, row, column)


class Terms(NamedTuple):
    """Agreement of each factor: submaps, then priors, then inter-robot measurements.

    submaps: without discounts. robots: of each factor. counted: w χ² and dof of the joint cost.
    """

    submaps: SubmapCosts
    robots: tuple[str, ...]
    counted: Float[np.ndarray, "2 n"]

    def add_to(
        self, before: Mapping[str, tuple[float, float]], which: Bool[np.ndarray, " n"] | None = None
    ) -> dict[str, tuple[float, float]]:
        """Add all or some factors to the Σ w χ² and Σ dof of each robot."""
        robots = dict(before)
        marks = repeat(True) if which is None else which.tolist()
        of = zip(self.robots, *self.counted.tolist(), strict=True)
        for robot, chi2, dof in compress(of, marks):
            sums = robots.get(robot, (0.0, 0.0))
            robots[robot] = (sums[0] + chi2, sums[1] + dof)
        return robots


_TERMS: WeakKeyDictionary[Island, Terms] = WeakKeyDictionary()
"""Cache of the terms of present islands."""


def terms(island: Island) -> Terms:
    """Evaluate the agreement of each factor."""
    found = _TERMS.get(island)
    if found is None:
        with island.determined():
            found = _TERMS[island] = _terms(island)
    return found


def _terms(island: Island) -> Terms:
    graph, now = island.graph, island.estimate
    weight = now.weights
    taken = weight * now.explained
    left = graph.dimensions - taken
    of = [each.contribution for each in graph.submaps]
    costs = np.array([now.whole_chi2, left, weight, chi2_quantile(0.5, left)])
    ranks = np.array([each.rank for each in graph.priors], np.int64)
    of_priors, of_sightings = now.prior_weights, now.sighting_weights
    chi2 = weight * now.counted_chi2, of_priors * now.prior_chi2, of_sightings * now.sighting_chi2
    dof = (
        now.dimensions - taken,
        ranks - of_priors * now.explained_by_priors,
        2.0 - of_sightings * now.explained_by_sightings,
    )
    counted = np.array([np.concatenate(chi2), np.concatenate(dof)])
    robots = (
        *(each.robot for each in of),
        *_robots_of_priors(graph),
        *(each.sighting.robot for each in graph.sightings),
    )
    return Terms(SubmapCosts(tuple(each.stream for each in of), costs), robots, counted)


def _robots_of_priors(graph: Graph) -> list[str]:
    """Return the robot of each prior; a common bias counts for the frame's."""
    robots = {nodes[0]: stream[0] for stream, nodes in graph.streams.items()}
    robots |= {node: stream[0] for (stream, _), node in graph.biases.items()}
    robots |= {node: stream[0] for (stream, _), node in graph.remembered.items()}
    robots |= dict.fromkeys(graph.common.values(), min(graph.streams)[0])
    return [robots[each.nodes[0]] for each in graph.priors]


def scale_of(costs: SubmapCosts, of: Sequence[int] | slice = ALL) -> Scale | None:
    """Estimate the covariance scale of some submaps; None with too few degrees of freedom."""
    chi2, dof, _, medians = costs.table[:, of]
    return covariance_scale(chi2, dof, medians)


def unbounded_costs(island: Island) -> SubmapCosts:
    """Evaluate the agreement of the submaps without distortion by the robust loss.

    Where covariances are far too small, the island is solved with their scale; the costs are for
    its own covariances.
    """
    found, settings = terms(island).submaps, island.settings
    scale = scale_of(found)
    if not settings.robust or scale is None or scale.value < FAR_TOO_SMALL:
        return found
    try:
        again = terms(_widened(island, scale.value)).submaps
    except UNSOLVABLE:
        return found
    return replace(again, table=again.table * [[scale.value], [1.0], [1.0], [1.0]])


def _widened(island: Island, factor: float) -> Island:
    settings = replace(
        island.settings, covariance_factor=factor * island.settings.covariance_factor
    )
    solved, *_ = solve_island(replace(island, settings=settings))
    return solved


def widen_covariances(fold: Fold, factor: float) -> Fold:
    """Solve the main island with the submaps' covariances times a factor; unchanged without a
    solution, or with fixes, which may be at fault.
    """
    if factor == 1.0 or fold.main_key is None:
        return fold
    if any(each.sighting.is_fix for each in fold.main.graph.sightings):
        return fold
    try:
        with np.errstate(all="ignore"):
            island = _widened(fold.main, factor)
    except UNSOLVABLE:
        return fold
    return replace(fold, islands={**fold.islands, fold.main_key: island})


def with_unbounded_costs(agreement: Agreement, fold: Fold) -> Agreement:
    """Replace the submaps' costs by `unbounded_costs`."""
    condensed = len(agreement.submaps.streams) - len(fold.main.graph.submaps)
    before = agreement.submaps.select(range(condensed))
    return agreement._replace(submaps=before.followed_by(unbounded_costs(fold.main)))


def joint_cost(fold: Fold) -> Agreement:
    """Evaluate the agreement of the main island's submaps, condensed ones as of condensing."""
    found, departed = terms(fold.main), fold.main.graph.departed
    robots = dict(sorted(found.add_to(departed.robots).items()))
    return Agreement(
        sum(chi2 for chi2, _ in robots.values()),
        sum(dof for _, dof in robots.values()),
        robots,
        departed.submaps.followed_by(found.submaps),
        tuple(_sighting_costs(fold.main)),
    )


def _own_marginal(
    island: Island, node: int
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    block = island.graph.pattern.block(island.selected_covariance, node, node)
    fixed = bool(island.graph.fixed[node])
    return island.value(node), np.zeros_like(block) if fixed else block


def _sighting_costs(island: Island) -> list[SightingCost]:
    costs = zip(island.graph.sightings, island.estimate.sighting_chi2.tolist(), strict=True)
    in_order = sorted(costs, key=lambda each: each[0].sighting.key)
    return [SightingCost(of.sighting.robot, of.sighting.teammate, chi2) for of, chi2 in in_order]
