"""Solve a submap graph by Gauss-Newton, with shorter or damped steps where the cost would rise.

Minimises Σ ρ(rᵀ(f P)⁻¹r) + Σ ρ(inter-robot measurement) + Σ ‖initial pose − prior‖² + Σ ρ(bias −
prior) by iterated re-weighting: ρ(χ²) is χ² up to a gate g, and g (2 − g/χ²) beyond, with weight
(g/χ²)². A new factor's gate is wide and narrows with each iteration, so that the chain adapts to a
true loop closure. The prior of a robot's own bias is Student's t of one degree of freedom, with
loss 2 log(1 + χ²). Each landmark of a submap also has a gate and a weight, as additional variance
of that landmark (`core.Estimate`).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from teamslam.team import core
from teamslam.team.association import DEFAULT_PROFILE, AssociationProfile
from teamslam.team.config import Bias
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor, Key, Stream
from teamslam.team.estimation.gaussian import UNSOLVABLE, NotDeterminedError
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.submap_graph import (
    EMPTY_GRAPH,
    NO_NUMBERS,
    CommonBias,
    Graph,
    add_submaps,
    encounter_of,
)
from teamslam.team.shapes import Float, Int64

Values = Float[np.ndarray, " _"]
HALVINGS = 4  # of an undamped step before damping, whose steps are short in curved valleys
MOST_DAMPING = 1e8
STUCK = math.inf  # damping of a point from which no step lowers the cost


def _powers(base: float, exponents: Int64[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Compute powers by repeated squares: a C library's differ between processors."""
    powers, rest = np.ones(len(exponents)), exponents
    while rest.any():
        powers = np.where(rest & 1, powers * base, powers)
        base, rest = base * base, rest >> 1
    return powers


def robust_scale(
    age: Int64[np.ndarray, " k"], start: float, decay: float
) -> Float[np.ndarray, " k"]:
    """Return the widening of the gates after `age` iterations: max(1, start · decay^age)."""
    if decay >= 1.0:  # it never narrows
        return np.maximum(1.0, start * _powers(decay, age))
    narrowing = _narrowing(start, decay)
    scale: Float[np.ndarray, " k"] = narrowing[np.minimum(age, len(narrowing) - 1)]
    return scale


@lru_cache
def _narrowing(start: float, decay: float) -> Float[np.ndarray, " k"]:
    """max(1, start · decay^age) of each age, up to the first 1."""
    count = 1
    while start * _powers(decay, np.array([count - 1]))[0] > 1.0:
        count += 1
    factors: Float[np.ndarray, " k"] = np.maximum(1.0, start * _powers(decay, np.arange(count)))
    return factors


STILL = 1e-3
"""Squared length, in standard deviations per raw submap, of a step that a running map omits
(docs/decisions/25).
"""
LANDMARK_GATE = 13.8  # χ² of two numbers that a sound landmark exceeds with probability 10⁻³
PLAIN = 1e9  # widening of gates beyond every χ²
LIKELY = 0.999  # quantile of χ² above which a cost is suspicious, or a minimum unlikely
SUSPICIOUS = 1.3
"""Factor by which a suspicious cost also exceeds its degrees of freedom: submaps are only nearly
Gaussian.
"""
FULL_AGE = 1_000_000  # iterations after which every robust scale is final


@dataclass(frozen=True)
class JoinSettings:
    """Settings of map joining; docs/scenario.md describes those of a scenario.

    robust: factors beyond their gates are discounted. The gates of χ² are wider by robust_start² at
    first, and by robust_decay² less with each iteration, down to 1. submap_gate: factor on a
    submap's gate. landmark_gate: χ² of two numbers from which a submap's landmark is discounted.
    max_iterations, step_tolerance: end of a full solve, by number or largest change [m, rad].
    alignment_confidence, alignment_heading_sigma: for a merge, quantile of the χ² test and largest
    `Alignment.heading_sigma` [rad]. bias_sigma: scale of Student's t prior on each error of a
    robot's submaps. common_bias_sigma: standard deviation of those that all robots share; "marker":
    share of the range. joined_ranges: see `core.SubmapFactor.at_joined_ranges`. landmark_sigma:
    deviation [m] of the measured point about the landmark's place, added to a map's covariance.
    """

    iterations_per_tick: int = 2
    robust: bool = True
    robust_start: float = 8.0
    robust_decay: float = 0.7
    submap_gate: float = 1.0
    landmark_gate: float = LANDMARK_GATE
    covariance_factor: float = 1.0
    max_iterations: int = 50
    step_tolerance: float = 1e-6
    alignment_confidence: float = 0.999
    alignment_heading_sigma: float = 0.3
    bias_sigma: Mapping[Bias, float] = field(default_factory=dict)
    common_bias_sigma: Mapping[CommonBias, float] = field(default_factory=dict)
    joined_ranges: bool = False
    landmark_sigma: float = 0.0
    association: AssociationProfile = DEFAULT_PROFILE


def ages(count: int) -> Int64[np.ndarray, " count"]:
    """Make the ages of new factors: 0."""
    return np.zeros(count, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Island:
    """One frame: its graph, the state by node, and the ages of the factors.

    age, sighting_age: iterations since each submap and inter-robot measurement was added.
    """

    graph: Graph
    state: Values
    age: Int64[np.ndarray, " F"]
    sighting_age: Int64[np.ndarray, " S"]
    settings: JoinSettings

    @cached_property
    def scale(self) -> Float[np.ndarray, " F"]:
        """Widening of each submap's gates; PLAIN for a saved map (`saved_maps`)."""
        scale = self._scale_at(self.age)
        if self.settings.robust:
            scale[self.graph.saved_maps] = PLAIN
        return scale

    @cached_property
    def sighting_scale(self) -> Float[np.ndarray, " S"]:
        """Widening of each inter-robot measurement's gate."""
        return self._scale_at(self.sighting_age)

    def _scale_at(self, age: Int64[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        settings = self.settings
        if not settings.robust:
            return np.full(len(age), math.inf)
        return robust_scale(age, settings.robust_start, settings.robust_decay)

    @cached_property
    def estimate(self) -> core.Estimate:
        """Costs, weights and normal equations at this state. Raises NotACovarianceError."""
        settings = self.settings
        return core.Estimate(
            self.graph.factors,
            self.state,
            self.scale,
            self.sighting_scale,
            settings.robust,
            settings.submap_gate,
            settings.landmark_gate,
            settings.covariance_factor,
            settings.joined_ranges,
        )

    @property
    def cost(self) -> float:
        """Cost at this state."""
        return self.estimate.cost

    @cached_property
    def posterior(self) -> core.Cholesky:
        """Cholesky factor of the information matrix."""
        with self.determined():
            return self.estimate.posterior

    @contextmanager
    def determined(self) -> Iterator[None]:
        """Raise NotDeterminedError, with the node, for a matrix that has no factor."""
        try:
            yield
        except core.NotPositiveDefiniteError as error:
            raise NotDeterminedError(self.graph.name(error.variable)) from error

    def value(self, node: int) -> Values:
        """Return the state of a node."""
        return self.state[self.graph.offset[node] : self.graph.offset[node + 1]]

    def points(self, nodes: Sequence[int] | Int64[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Return the positions [m] of nodes."""
        at = self.graph.offset[np.asarray(nodes, np.int64)]
        return np.column_stack([self.state[at], self.state[at + 1]])

    def moved(self, step: Values) -> "Island":
        """Add a step to the state, headings wrapped to (−π, π]."""
        state = self.state + step
        headings = state[self.graph.headings]
        state[self.graph.headings] += 2.0 * np.pi * np.floor((np.pi - headings) / (2.0 * np.pi))
        return replace(self, state=state)

    @cached_property
    def selected_covariance(self) -> Values:
        """Covariance entries in the layout of the graph's pattern; fixed nodes: identity."""
        with self.determined():
            return self.estimate.selected_covariance


def empty_island(settings: JoinSettings) -> Island:
    """Make an island without submaps."""
    return Island(EMPTY_GRAPH, np.zeros(0), ages(0), ages(0), settings)


def extend_island(
    island: Island,
    contributions: Sequence[Contribution],
    starts: Mapping[Stream, InitialPoseFactor],
    numbers: Mapping[Key, Sequence[int]] = NO_NUMBERS,
) -> Island:
    """Add submaps to an island, in order (`add_submaps`)."""
    graph, state = add_submaps(
        island.graph,
        island.state,
        contributions,
        starts,
        island.settings.bias_sigma,
        island.settings.common_bias_sigma,
        numbers,
    )
    age = np.concatenate([island.age, ages(len(contributions))])
    return replace(island, graph=graph, state=state, age=age)


def age_factors(island: Island, iterations: int | None) -> Island:
    """Add iterations to the age of every factor; None: reset to 0."""
    if iterations is None:
        age, sighting_age = np.zeros_like(island.age), np.zeros_like(island.sighting_age)
    else:
        age, sighting_age = island.age + iterations, island.sighting_age + iterations
    return replace(island, age=age, sighting_age=sighting_age)


def final_cost(island: Island) -> float:
    """Evaluate the cost at final robust scales."""
    is_final = (island.age >= FULL_AGE).all() and (island.sighting_age >= FULL_AGE).all()
    return island.cost if is_final else age_factors(island, FULL_AGE).cost


def add_sightings(
    island: Island, waiting: Sequence[InterRobotFactor]
) -> tuple[Island, tuple[InterRobotFactor, ...]]:
    """Add the inter-robot measurements within an island; return the others."""
    candidates = [(each, encounter_of(island.graph, each)) for each in waiting]
    found = [between for _, between in candidates if between is not None]
    if not found:
        return island, tuple(waiting)
    graph = replace(island.graph, sightings=(*island.graph.sightings, *found))
    age = np.concatenate([island.sighting_age, ages(len(found))])
    left = tuple(each for each, between in candidates if between is None)
    return replace(island, graph=graph, sighting_age=age), left


def degrees_of_freedom(island: Island) -> int:
    """Count the measured quantities less the unknowns."""
    graph = island.graph
    priors = sum(prior.rank for prior in graph.priors)
    measured = int(graph.dimensions.sum()) + 2 * len(graph.sightings) + priors
    old = graph.condensed
    return measured - graph.unknowns + (0 if old is None else old.redundancy)


def is_suspicious(island: Island, cost: float) -> bool:
    """Return whether the cost is far above its degrees of freedom."""
    dof = degrees_of_freedom(island)
    return dof > 0 and cost > max(SUSPICIOUS * dof, likely_limit(dof))


@lru_cache(maxsize=4096)
def likely_limit(dof: int) -> float:
    """Return the quantile of χ² above which a cost is suspicious."""
    return chi2_limit(dof, 1.0 - LIKELY)


def is_solvable(island: Island) -> bool:
    """Return whether the numbers are finite and every unknown determined (`core.Cholesky`)."""
    try:
        with np.errstate(all="ignore"):
            _, cost = island.posterior, island.cost
    except UNSOLVABLE:
        return False
    return bool(np.isfinite(island.state).all()) and math.isfinite(cost)


def iterate_tick(island: Island) -> Island:
    """Apply the iterations of one tick; with condensed submaps, later ones shorter than STILL are
    omitted.
    """
    damping = 0.0
    bounded = island.graph.condensed is not None
    for k in range(island.settings.iterations_per_tick):
        if k and bounded and damping == 0.0 and _stands_still(island):
            break
        island, damping, _ = take_step(island, damping)
    return island


def _stands_still(island: Island) -> bool:
    with island.determined():
        return island.estimate.squared_length <= STILL * len(island.graph.submaps)


def take_step(island: Island, damping: float) -> tuple[Island, float, float]:
    """Take one step: return the island, the next damping, and the full step's largest change.

    The step −(A + damping · diag A)⁻¹g is applied if it lowers the cost; else, if undamped, a share
    of it; else a more damped one. If none does, the state stays and the next damping is STUCK.
    """
    with island.determined():
        state, damping, change = island.estimate.take_step(
            0.0 if damping == STUCK else damping, HALVINGS, MOST_DAMPING
        )
    older = age_factors(island, 1)
    if state is None:
        return older, STUCK, change
    return replace(older, state=state), damping, change


def solve_island(island: Island) -> tuple[Island, int, float]:
    """Solve in full; return also the number of iterations and the last change [m, rad].

    Least squares comes first: it is the robust solution where no factor is beyond its gate.
    Otherwise the gates narrow anew.
    """
    if island.settings.robust:
        with suppress(*UNSOLVABLE):
            plain, count, change = _descend(
                replace(island, settings=replace(island.settings, robust=False))
            )
            found = age_factors(replace(plain, settings=island.settings), FULL_AGE)
            if not _has_outliers(found):
                return found, count, change
    return _descend(island)


def _has_outliers(island: Island) -> bool:
    at = island.estimate
    weights = at.weights, at.landmark_weights, at.sighting_weights
    return any((each < 1.0).any() for each in weights)


def _descend(island: Island) -> tuple[Island, int, float]:
    settings = island.settings
    island = age_factors(island, None)
    damping, change, count = 0.0, math.inf, 0
    while count < settings.max_iterations:
        scales = np.concatenate([island.scale, island.sighting_scale])
        narrow = not settings.robust or bool(((scales == 1.0) | (scales == PLAIN)).all())
        island, damping, change = take_step(island, damping)
        count += 1
        if narrow and (damping == STUCK or (damping == 0.0 and change < settings.step_tolerance)):
            break
    return island, count, change


def solve_with_fixed(
    island: Island, unknown: int, by: float, iterations: int, *, shortest: float = 0.0
) -> Island:
    """Move one number of the state by `by` and solve for all others.

    With p = −A⁻¹g and q = A⁻¹w of the unit vector w, an iteration is p + λ q whose component along
    w is the remaining displacement, until (p + λ q)ᵀ A (p + λ q) is below `shortest`.
    """
    missing = by
    for _ in range(iterations):
        gradient = island.estimate.gradient
        right = np.column_stack([-gradient, np.zeros(len(island.state))])
        right[unknown, 1] = 1.0
        p, q = island.posterior.solve(right).T
        force = (missing - p[unknown]) / q[unknown]
        step = p + force * q
        squared = float(force * step[unknown] - dense.product(gradient, step))
        island, missing = island.moved(step), missing - float(step[unknown])
        if squared < shortest:
            break
    return island


def joint_marginal(island: Island, nodes: Sequence[int]) -> tuple[Values, Float[np.ndarray, "n n"]]:
    """Compute mean and joint covariance of nodes (`landmark_view.members`); 0 for a fixed one."""
    with island.determined():
        mean, covariance = island.estimate.joint(np.array(nodes, np.int64))
    return mean, covariance
