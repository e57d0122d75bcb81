"""The solution of a submap graph: Gauss-Newton, with shorter or damped steps where the cost would
rise.

Minimises Σ ρ(rᵀ(f P)⁻¹r) + Σ ρ(inter-robot measurement) + Σ ‖initial pose − prior‖² + Σ ρ(bias −
prior), where ρ is the identity, or Cauchy's loss on √(χ²/dim) per factor, by iterated re-weighting.
A robust factor enters with a wide scale that narrows with each iteration since it was added, so
that a true loop closure is not taken for an outlier before the chain has adapted to it.

With a robust loss each landmark of a submap has a weight of its own as well, so that a mistaken
landmark does not break the robot's chain: beyond the gate g its χ² counts g (1 + log(χ²/g)), whose
slope, the weight, is g/χ². The weight enters as additional variance of that landmark alone
(`joining_kernel.discounted_information`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64

from team import core
from team.association import DEFAULT_PROFILE, AssociationProfile
from team.config import Bias
from team.estimation import dense
from team.estimation.dense_kernel import add_product
from team.estimation.gaussian import NotACovarianceError
from team.estimation.map_joining import inter_robot_kernel as sightings
from team.estimation.map_joining import joining_kernel as kernel
from team.estimation.map_joining.condensing_kernel import add_blocks
from team.estimation.map_joining.least_squares import (
    LEAST_DAMPING,
    MOST_DAMPING,
    ROUNDING,
    SHARES,
    STUCK,
    Values,
    robust_scale,
)
from team.estimation.map_joining.priors_kernel import add_priors, prior_terms
from team.estimation.map_joining.resting_kernel import own_blocks, symmetric_of
from team.estimation.map_joining.submap_graph import CommonBias, Graph

LEAST_WEIGHT = 1e-6
"""Lower bound of a landmark's weight, so that each landmark stays determined."""
STILL = 1e-3
"""Squared length, in standard deviations and per raw submap, of a step that a running map omits: a
tenth of the shift by condensing (docs/decisions/25).
"""
FULL_AGE = 1_000_000
"""Number of iterations after which every robust scale has reached its final value."""


@dataclass(frozen=True)
class JoinSettings:
    """Settings of map joining.

    iterations_per_tick: Gauss-Newton iterations of `folded`. robust_c: Cauchy's scale on √(χ²/dim)
    of a factor; None for least squares. The scale begins at robust_start · c and is multiplied by
    robust_decay with each iteration until it is c. landmark_gate: χ² of two numbers from which a
    submap's landmark is discounted, with a robust loss; it narrows with the scale.
    covariance_factor: factor on every submap's covariance. max_iterations, step_tolerance: a full
    solve ends when no unknown changes by more than step_tolerance [m, rad], or after
    max_iterations. alignment_confidence: quantile of the χ² test for a merge of islands.
    alignment_heading_sigma: for the same, largest standard deviation [rad] of the heading from the
    shape of the shared landmarks. bias_sigma: prior standard deviation of each error that a robot's
    submaps share. common_bias_sigma: the same for errors that all robots share, in addition;
    "marker": the share of the range by which all robots measure one landmark too far.
    joined_ranges: whether errors of ranges are proportional to the range in the joined map
    (`joining_kernel.with_joined_ranges`). landmark_sigma: standard deviation [m], per direction, of
    the measured point, the same for all robots, about the landmark's place: part of a map's
    covariance, not of the measurements' weights.
    """

    iterations_per_tick: int = 2
    robust_c: float | None = None
    robust_start: float = 8.0
    robust_decay: float = 0.7
    landmark_gate: float = 13.8
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


class NotDeterminedError(ValueError):
    """The submaps leave a node of the graph undetermined."""

    def __init__(self, node: str) -> None:
        super().__init__(f"{node} is not determined by the submaps")
        self.node = node


UNSOLVABLE = (NotDeterminedError, NotACovarianceError, np.linalg.LinAlgError)
"""Exceptions of a solve without a solution: a case to decide on, not a defect."""


@dataclass(frozen=True, eq=False)
class Island:
    """One frame: its graph, the state (poses and landmarks by node) and the ages of the factors.

    age, sighting_age: number of iterations since each submap and inter-robot measurement was added;
    the robust scale follows from it.
    """

    graph: Graph
    state: Values
    age: Int64[np.ndarray, " F"]
    sighting_age: Int64[np.ndarray, " S"]
    settings: JoinSettings

    @cached_property
    def scale(self) -> Float[np.ndarray, " F"]:
        """Robust scale c of each submap at its age."""
        return self._scale_at(self.age)

    @cached_property
    def sighting_scale(self) -> Float[np.ndarray, " S"]:
        """Robust scale c of each inter-robot measurement at its age."""
        return self._scale_at(self.sighting_age)

    def _scale_at(self, age: Int64[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        settings = self.settings
        return robust_scale(age, settings.robust_c, settings.robust_start, settings.robust_decay)

    @cached_property
    def _submaps(self) -> kernel.SubmapFactors:
        factors = self.graph.factors
        if not self.settings.joined_ranges:
            return factors
        return kernel.with_joined_ranges(self.state, self.graph.offset, factors)

    @cached_property
    def _landmark_chi2_and_gate(self) -> tuple[Values, Values]:
        factors, settings = self._submaps, self.settings
        if settings.robust_c is None:
            return np.zeros(len(factors.block)), np.ones(len(factors.block))
        chi2 = kernel.landmark_chi2(
            self.state, self.graph.offset, factors, settings.covariance_factor
        )
        gate = settings.landmark_gate * core.squared(self.scale / settings.robust_c)
        return chi2, np.repeat(gate, np.diff(factors.block_start))

    @cached_property
    def landmark_weight(self) -> Float[np.ndarray, " B"]:
        """Weight of each landmark of each submap: 1 up to its gate or without a robust loss."""
        chi2, gate = self._landmark_chi2_and_gate
        weight, beyond = np.ones(len(chi2)), chi2 > gate
        weight[beyond] = np.maximum(gate[beyond] / chi2[beyond], LEAST_WEIGHT)
        return weight

    @cached_property
    def factors(self) -> kernel.SubmapFactors:
        """The submaps with the covariances of discounted landmarks enlarged."""
        return self._discounted(self.landmark_weight)

    def _discounted(self, weight: Values) -> kernel.SubmapFactors:
        factors = self._submaps
        if (weight == 1.0).all():
            return factors
        return factors._replace(information=kernel.discounted_information(factors, weight))

    @cached_property
    def dimensions(self) -> Float[np.ndarray, " F"]:
        """Dimension of each submap, a discounted landmark counting by its weight."""
        factors = self.graph.factors
        of = np.repeat(np.arange(len(self.graph.submaps)), np.diff(factors.block_start))
        lost = np.bincount(of, 2.0 * (1.0 - self.landmark_weight), len(self.graph.submaps))
        return self.graph.dimensions - lost.astype(np.float64)

    @cached_property
    def chi2(self) -> Float[np.ndarray, " F"]:
        """rᵀ(f P)⁻¹r of each submap, with discounted landmarks."""
        factor = self.settings.covariance_factor
        return kernel.costs(self.state, self.graph.offset, self.factors, factor)

    @cached_property
    def whole_chi2(self) -> Float[np.ndarray, " F"]:
        """rᵀ(f P)⁻¹r of each submap, without discounting."""
        if self.factors is self._submaps:
            return self.chi2
        factor = self.settings.covariance_factor
        return kernel.costs(self.state, self.graph.offset, self._submaps, factor)

    @cached_property
    def counted_chi2(self) -> Float[np.ndarray, " F"]:
        """χ² of each submap in which each landmark's share w χ² counts w times.

        `dimensions` counts its numbers by the same weight: the agreement test leaves out
        down-weighted terms.
        """
        if self.factors is self._submaps:
            return self.chi2
        factors = self._discounted(core.squared(self.landmark_weight))
        factor = self.settings.covariance_factor
        return kernel.costs(self.state, self.graph.offset, factors, factor)

    @property
    def weight(self) -> Float[np.ndarray, " F"]:
        """Robust weight of each submap, 1 without a robust loss."""
        relative: Values = self.chi2 / (self.graph.dimensions * core.squared(self.scale))
        return 1.0 / (1.0 + relative)

    @cached_property
    def sighting_chi2(self) -> Float[np.ndarray, " S"]:
        """rᵀR⁻¹r of each inter-robot measurement."""
        return sightings.sighting_costs(self.state, self.graph.offset, self.graph.sighting_factors)

    @property
    def sighting_weight(self) -> Float[np.ndarray, " S"]:
        """Robust weight of each inter-robot measurement, 1 without a robust loss."""
        return 1.0 / (1.0 + self.sighting_chi2 / (2.0 * core.squared(self.sighting_scale)))

    @cached_property
    def prior_chi2(self) -> Float[np.ndarray, " priors"]:
        """χ² of each prior, of an initial pose or of a bias."""
        return self._prior_terms[1]

    @cached_property
    def _prior_terms(self) -> tuple[Float[np.ndarray, "priors 3"], Values]:
        return prior_terms(self.state, self.graph.prior_factors)

    def prior_slope(self, k: int) -> Values:
        """P⁻¹r of a prior."""
        return self._prior_terms[0][k, : self.graph.prior_factors.size[k]]

    @cached_property
    def prior_weight(self) -> Float[np.ndarray, " priors"]:
        """Robust weight of each prior: Cauchy's for a robot's own bias, 1 for all others.

        A sensor changed since its calibration is one robot's: its prior is an outlier, and must not
        draw the other robots' biases away through the common errors. Markers do not change; the
        error of a marker seen from one side only is distinguished from its landmark's position by
        its prior alone.
        """
        if self.settings.robust_c is None:
            return np.ones(len(self.graph.priors))
        of_bias = self.graph.of_bias
        weight: Values = 1.0 / (1.0 + self.prior_chi2 / core.squared(self.settings.robust_c))
        return np.where(of_bias, weight, 1.0)

    def cost_of(self, other: "Island") -> float:
        """Evaluate Σ w χ² of another state with the weights and noise of this one, which an
        iteration lowers.

        The robust cost then falls too, since each loss lies below its parabola.
        """
        settings = self.settings
        if other is self or (settings.robust_c is None and not settings.joined_ranges):
            costs = other.chi2
        else:
            factor = settings.covariance_factor
            costs = kernel.costs(other.state, self.graph.offset, self.factors, factor)
        chi2 = float((self.weight * costs).sum())
        seen = float((self.sighting_weight * other.sighting_chi2).sum())
        seen += float((self.prior_weight * other.prior_chi2).sum())
        return chi2 + seen + other.condensed_terms[0]

    @cached_property
    def cost(self) -> float:
        """The minimised cost, at the present robust scales."""
        graph = self.graph
        sizes = len(self.age), len(self.sighting_age), len(graph.priors)
        submaps, seen, priors = (np.ones(size, np.bool_) for size in sizes)
        return self.cost_of_factors(submaps, seen, priors) + self.condensed_terms[0]

    @cached_property
    def condensed_terms(self) -> tuple[float, Values]:
        """Cost and half the gradient of the condensed factor; zero and none without one."""
        old = self.graph.condensed
        return (0.0, np.zeros(0)) if old is None else old.at_state(self.state, self.graph.boundary)

    def cost_of_factors(
        self,
        submaps: Bool[np.ndarray, " F"],
        sightings: Bool[np.ndarray, " S"],
        priors: Bool[np.ndarray, " priors"],
    ) -> float:
        """Sum the cost of the marked factors."""
        if self.settings.robust_c is None:
            chi2 = float(self.chi2[submaps].sum() + self.prior_chi2[priors].sum())
            return chi2 + float(self.sighting_chi2[sightings].sum())
        scale = (core.squared(self.scale) * self.graph.dimensions)[submaps]
        cost = float((scale * core.log1p(self.chi2[submaps] / scale)).sum())
        cost += self._prior_cost(priors)
        own, gate = self._landmark_chi2_and_gate
        of = np.repeat(submaps, np.diff(self.graph.factors.block_start))
        beyond = (own > gate) & of
        cost += float((gate[beyond] * core.log(own[beyond] / gate[beyond])).sum())
        scale = 2.0 * core.squared(self.sighting_scale[sightings])
        return cost + float((scale * core.log1p(self.sighting_chi2[sightings] / scale)).sum())

    def _prior_cost(self, chosen: Bool[np.ndarray, " priors"]) -> float:
        c2 = 1.0 if self.settings.robust_c is None else core.squared(self.settings.robust_c)
        of_bias = (self.prior_weight < 1.0) & chosen
        robust = float((c2 * core.log1p(self.prior_chi2[of_bias] / c2)).sum())
        return robust + float(self.prior_chi2[chosen & ~of_bias].sum())

    @cached_property
    def normal_equations(self) -> tuple[Values, Values]:
        """A = Σ w JᵀP⁻¹J in the layout of the graph's pattern, and half the gradient, Σ w
        JᵀP⁻¹r.
        """
        graph, pattern = self.graph, self.graph.pattern
        values, gradient, _ = kernel.normal_equations(
            self.state,
            graph.offset,
            graph.fixed,
            self.factors,
            self.settings.covariance_factor,
            self.scale,
            graph.entry,
            pattern.column_start,
            pattern.value_start,
        )
        sightings.add_sightings(
            values,
            gradient,
            self.state,
            graph.offset,
            graph.fixed,
            graph.sighting_factors,
            self.sighting_scale,
            graph.entry,
            pattern.value_start,
        )
        if graph.condensed is not None:
            old = graph.condensed
            gradient[graph.boundary] += self.condensed_terms[1]
            sizes = np.diff(graph.offset)[old.nodes]
            add_blocks(values, old.information, sizes, graph.condensed_entry, pattern.value_start)
        at = pattern.value_start[pattern.column_start[graph.prior_factors.node]]
        slopes = self._prior_terms[0]
        add_priors(values, gradient, graph.prior_factors, slopes, self.prior_weight, at)
        return values, gradient

    @cached_property
    def step(self) -> Values:
        """The full step, −A⁻¹g."""
        return -self.posterior.solve(self.normal_equations[1])

    @cached_property
    def posterior(self) -> core.Cholesky:
        """Cholesky factor of the information matrix at this state."""
        return self.factorised(self.normal_equations[0])

    def factorised(self, values: Values) -> core.Cholesky:
        """Factorise a matrix in the layout of the graph's pattern."""
        try:
            return core.Cholesky(self.graph.pattern, values)
        except core.NotPositiveDefiniteError as error:
            raise NotDeterminedError(self.graph.name(error.variable)) from error

    def moved(self, step: Values, older: int = 1) -> "Island":
        """Add `step` to the state, headings wrapped to (−π, π], and `older` iterations to every
        factor.
        """
        state = self.state + step
        headings = state[self.graph.headings]
        state[self.graph.headings] += 2.0 * np.pi * np.floor((np.pi - headings) / (2.0 * np.pi))
        ages = self.age + older, self.sighting_age + older
        return replace(self, state=state, age=ages[0], sighting_age=ages[1])

    @cached_property
    def selected_covariance(self) -> Values:
        """Entries of the covariance in the layout of the graph's pattern; fixed nodes: identity."""
        return self.posterior.selected_inverse()

    @cached_property
    def resting_points(self) -> Float[np.ndarray, "L 2"]:
        """Positions [m] of the landmarks at rest, if there are some."""
        old = self.graph.condensed
        assert old is not None
        assert old.resting is not None
        moved = old.moved(self.state, self.graph.boundary)
        points: Values = old.resting.means + dense.product(old.resting.gain, moved)
        return points.reshape(-1, 2)

    @cached_property
    def boundary_covariance(self) -> Float[np.ndarray, "n n"]:
        """Joint covariance of the condensed factor's nodes, if there is one."""
        graph, old = self.graph, self.graph.condensed
        assert old is not None
        return symmetric_of(
            self.selected_covariance,
            np.diff(graph.offset)[old.nodes],
            graph.condensed_entry,
            graph.pattern.value_start,
            len(old.at),
        )

    @cached_property
    def resting_spread(self) -> Float[np.ndarray, "r n"]:
        """G R of the landmarks at rest, with their gain G and R Rᵀ of the nodes that they depend
        on.
        """
        old = self.graph.condensed
        assert old is not None
        assert old.resting is not None
        spread = np.zeros(old.resting.gain.shape)
        root = dense.cholesky(self.boundary_covariance)
        add_product(old.resting.gain, root, spread, (0, 0), False, True)
        return spread

    @cached_property
    def resting_blocks(self) -> Float[np.ndarray, "L 2 2"]:
        """Covariance [m²] of each landmark at rest, if there are some."""
        old = self.graph.condensed
        assert old is not None
        assert old.resting is not None
        return own_blocks(old.resting.upper, self.resting_spread)


def aged(island: Island, iterations: int | None) -> Island:
    """Add iterations to the age of every factor; None: every factor begins anew."""
    if iterations is None:
        age, sighting_age = np.zeros_like(island.age), np.zeros_like(island.sighting_age)
    else:
        age, sighting_age = island.age + iterations, island.sighting_age + iterations
    return replace(island, age=age, sighting_age=sighting_age)


def final_cost(island: Island) -> float:
    """Evaluate the cost with final robust scales, for comparison of islands."""
    return aged(island, FULL_AGE).cost


def is_solvable(island: Island) -> bool:
    """Whether the island has a solution: finite numbers, every unknown determined.

    The pivots of the factorisation are judged by their diagonal entries (`core.Cholesky`), so units
    and the size of covariances have no influence.
    """
    try:
        with np.errstate(all="ignore"):
            _, cost = island.posterior, island.cost
    except UNSOLVABLE:
        return False
    return bool(np.isfinite(island.state).all()) and math.isfinite(cost)


def iterated(island: Island) -> Island:
    """Apply the iterations of one tick.

    With condensed submaps, iterations after the first are omitted whose step is shorter than STILL:
    a function of the state, and condensing displaces the map by more. A robust scale that still
    narrows continues at the next tick.
    """
    damping = 0.0
    bounded = island.graph.condensed is not None
    for k in range(island.settings.iterations_per_tick):
        if k and bounded and damping == 0.0 and _stands_still(island):
            break
        island, (damping, _) = _iteration(island, damping)
    return island


def _stands_still(island: Island) -> bool:
    """Whether a full step is shorter than STILL: gᵀA⁻¹g bounds how far any number moves."""
    squared = -float(dense.product(island.normal_equations[1], island.step))
    return squared <= STILL * len(island.graph.submaps)


class Iteration(NamedTuple):
    """The outcome of one step: the next damping (or STUCK), and the full step's largest change."""

    damping: float
    change: float


def _iteration(island: Island, damping: float) -> tuple[Island, Iteration]:
    """Take one step; the island ages by one even where no step lowers the cost."""
    after, outcome = take_step(island, _eased(damping))
    return aged(island, 1) if after is island else after, outcome


def take_step(island: Island, damping: float) -> tuple[Island, Iteration]:
    """Take one step: return the next island and the outcome of the step.

    The step −(A + damping · diag A)⁻¹g is taken if it lowers the cost; else, if undamped, a share
    of it; else a more damped one. Where no damping helps the island is returned unchanged, with the
    change of the first step.
    """
    values, gradient = island.normal_equations
    before = island.cost_of(island)
    refused = None
    while damping < MOST_DAMPING:
        if damping:
            damped = values.copy()
            damped[island.graph.pattern.diagonal] *= 1.0 + damping
            step = -island.factorised(damped).solve(gradient)
        else:
            step = island.step
        for share in (1.0,) if damping else SHARES:
            moved = island.moved(share * step)
            if island.cost_of(moved) <= before * (1.0 + ROUNDING) + ROUNDING:
                eased = damping / 10.0 if damping > LEAST_DAMPING else 0.0
                return moved, Iteration(eased, _largest(step))
        refused = _largest(step) if refused is None else refused
        damping = max(10.0 * damping, LEAST_DAMPING)
    return island, Iteration(STUCK, math.inf if refused is None else refused)


def _largest(step: Values) -> float:
    return float(np.abs(step).max(initial=0.0))


def _eased(damping: float) -> float:
    return 0.0 if damping == STUCK else damping


def settled(island: Island) -> tuple[Island, int, float]:
    """Solve in full from this state; return also the number of iterations and the last change [m,
    rad].

    The robust scale of every factor is annealed anew. The solve ends when converged, after
    `max_iterations`, or where no step lowers the cost; the last change shows whether it converged.
    """
    settings = island.settings
    island = aged(island, None)
    damping, change, count = 0.0, math.inf, 0
    while count < settings.max_iterations:
        scales = np.concatenate([island.scale, island.sighting_scale])
        narrow = settings.robust_c is None or bool((scales == settings.robust_c).all())
        island, (damping, change) = _iteration(island, damping)
        count += 1
        if narrow and (damping == STUCK or (damping == 0.0 and change < settings.step_tolerance)):
            break
    return island, count, change


def solved_with_fixed(
    island: Island, unknown: int, by: float, iterations: int, *, shortest: float = 0.0
) -> Island:
    """Move one number of the state by `by` and solve for all others given that.

    With the step p = −A⁻¹g and q = A⁻¹w of the unit vector w, an iteration is p + λ q whose
    component along w is the remaining displacement: the point on the constraint with the least cost
    to second order. An iteration whose squared length (p + λ q)ᵀ A (p + λ q), in standard
    deviations, is below `shortest` is the last one.
    """
    missing = by
    for _ in range(iterations):
        gradient = island.normal_equations[1]
        right = np.column_stack([-gradient, np.zeros(len(island.state))])
        right[unknown, 1] = 1.0
        p, q = island.posterior.solve(right).T
        force = (missing - p[unknown]) / q[unknown]
        step = p + force * q
        squared = float(force * step[unknown] - dense.product(gradient, step))
        island, missing = island.moved(step, 0), missing - float(step[unknown])
        if squared < shortest:
            break
    return island


def joint_marginal(island: Island, nodes: Sequence[int]) -> tuple[Values, Float[np.ndarray, "n n"]]:
    """Compute mean and joint covariance of `nodes`, in order; a fixed node has covariance 0."""
    graph = island.graph
    spans = [np.arange(graph.offset[node], graph.offset[node + 1]) for node in nodes]
    unknowns = np.concatenate([np.zeros(0, dtype=np.int64), *spans])
    covariance = island.posterior.inverse_block(unknowns)
    constant = np.repeat(graph.fixed[list(nodes)], [len(span) for span in spans])
    covariance[constant] = 0.0
    covariance[:, constant] = 0.0
    return island.state[unknowns], covariance
