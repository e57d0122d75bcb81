"""Gaussian back end of one robot: its own map, and its pose in the team's map.

The own map joins the submaps one by one into one Gaussian (Brooks & Bailey 2008, "HybridSLAM";
Williams 2001); the identity of two landmarks is an observation without noise. Without
relinearisation the map is overconfident after many joins.

The pose in the team's map is the broadcast prior (joint marginal of the robot's last joined end
pose and landmarks) times the later submaps, solved as at the centre (decision 21), with the
centre's estimates of their shared errors. A landmark observation that everything else contradicts
is left out; no fused message contains this solution.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Bias
from teamslam.team.core import WholeMap
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.gaussian import (
    NotACovarianceError,
    NotDeterminedError,
    PoseGaussian,
)
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Bool, Float, UInt32

INDEFINITE, SINGULAR = 1, 2
"""Faults of the core: the covariance of all known landmarks' innovation is not positive definite,
or that of one landmark is singular.
"""


def initial_map(
    pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"] | None
) -> WholeMap:
    """Make a map with a pose only; covariance None: exact."""
    spread = np.zeros((3, 3)) if covariance is None else covariance
    return WholeMap(np.zeros(0, dtype=np.uint32), pose, spread)


def join_submap(whole: WholeMap, local: LocalMap) -> WholeMap:
    """Compose the local map onto the current pose: known landmarks fused, new ones added.

    Raises NotACovarianceError.
    """
    local = local.without_nodes
    after, fault = whole.joined(local.ids, local.mean, local.covariance)
    _raise_fault(fault)
    return after


def _raise_fault(fault: int) -> None:
    if fault == INDEFINITE:
        raise NotACovarianceError("the known landmarks' innovation", "not positive definite")
    if fault == SINGULAR:
        raise NotACovarianceError("a known landmark's innovation", "singular")


GATE = 18.420680744107813
"""`chi2_quantile(0.9999, 2)`, beyond which an observation is attributed to another landmark."""
MAX_ITERATIONS, STEP_TOLERANCE = 50, 1e-6  # end of a solve, by number or largest change [m, rad]
CONTRADICTED = 1e-6  # probability below which the cost of a prior and submaps is a contradiction
FEWEST = 2  # number of rejected landmarks from which a submap as a whole is in doubt
NO_COVARIANCE = 2  # fault of the core: a map of the chain has no covariance


class SubmapCorrection(NamedTuple):
    """Corrections of a robot's submaps: covariance factor f, biases b (name, estimate, sigma)."""

    covariance_factor: float = 1.0
    biases: tuple[tuple[Bias, float, float], ...] = ()

    def taken(self, local: LocalMap) -> LocalMap:
        """Correct a submap: N(mean + Σ (S b + ½ D b²), f P + S'ᵀ diag(σ²) S'), S' = S + b D, with
        sensitivity S and curvature D.

        The uncertainty of b counts as independent of the map. A bias without an estimate is zero.
        """
        if self.covariance_factor == 1.0 and not local.biases:
            return local
        rows = {name: row for row, name in enumerate(local.biases)}
        mean, covariance = core.corrected(
            local.mean,
            local.covariance,
            self.covariance_factor,
            local.sensitivity,
            local.curvature,
            [(value, sigma, rows[name]) for name, value, sigma in self.biases if name in rows],
        )
        return LocalMap(local.ids, mean, covariance, local.node_stamps)


class RobotPrior(NamedTuple):
    """A robot's last joined end pose and landmarks: joint covariance of (x, y, θ, x₁, y₁, …).

    In the island's frame [m, rad], ids ascending; a row of zeros is a known constant. shared:
    corrections of the robot's submaps.
    """

    pose: Float[np.ndarray, "3"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]
    shared: SubmapCorrection = SubmapCorrection()

    @property
    def whole(self) -> WholeMap:
        """The prior as a `WholeMap`."""
        return WholeMap(self.ids, np.concatenate([self.pose, self.means.ravel()]), self.covariance)


class Followed(NamedTuple):
    """A robot's map after its later submaps, with their agreement.

    known: number of each submap's landmarks in the map or another submap. refused: those that the
    rest contradicts. cost: χ² of `dof` degrees of freedom without these. disputed: it is too large,
    or most of a submap would be refused.
    """

    whole: WholeMap
    known: tuple[int, ...] = ()
    refused: tuple[int, ...] = ()
    cost: float = 0.0
    dof: int = 0
    disputed: bool = False


class Posed(NamedTuple):
    """N(pose, covariance); numbers of the window's landmarks that the map contains, and refuses."""

    pose: PoseGaussian
    known: int = 0
    refused: int = 0


def join_pending(whole: WholeMap, pending: Iterable[LocalMap]) -> Followed:
    """Join the submaps that follow the map's pose, in order, by least squares.

    Landmarks beyond the gate are left out. If that is most of a submap, or the rest is
    contradictory, Cauchy's loss on whole submaps and on the map finds the fault. Raises
    NotACovarianceError, NotDeterminedError.
    """
    submaps = [each.without_nodes for each in pending]
    if not submaps:
        return Followed(whole)
    found = _solve_chain(whole, submaps)
    known, refused = tuple(found.known.tolist()), (0,) * len(submaps)
    in_doubt = False
    if (found.landmark_chi2 > GATE).any():
        from teamslam.team.estimation.map_joining.contradictions import find_beyond

        beyond = find_beyond(whole, submaps, GATE)
        refused = tuple(int(each.sum()) for each in beyond)
        in_doubt = any(map(is_majority, refused, known))
        if not in_doubt:
            found = _solve_chain(whole, [*map(remove_landmarks, submaps, beyond)])
    joint = found.map
    largest = chi2_limit(found.dof, CONTRADICTED) if found.dof > 0 else math.inf
    disputed = in_doubt or found.cost > largest
    if disputed:
        from teamslam.team.estimation.map_joining.contradictions import join_robustly

        joint = join_robustly(whole, submaps, GATE)
    return Followed(joint, known, refused, found.cost, found.dof, disputed)


def _solve_chain(whole: WholeMap, submaps: Sequence[LocalMap]) -> core.ChainSolution:
    chain = core.Chain(whole)
    for each in submaps:
        chain.append(each.ids, each.mean, each.covariance)
    found = chain.solve(MAX_ITERATIONS, STEP_TOLERANCE)
    if found.fault == NO_COVARIANCE:
        what = f"the robot's submap {found.at} behind the prior" if found.at else "the prior"
        raise NotACovarianceError(what, "not positive definite")
    if found.fault:
        raise NotDeterminedError("the robot's map")
    return found


def is_majority(refused: int, known: int) -> bool:
    """Return whether too many landmarks are refused for a fault in single ones."""
    return refused >= FEWEST and 2 * refused > known


def remove_landmarks(local: LocalMap, beyond: Bool[np.ndarray, " L"]) -> LocalMap:
    """Remove the marked landmarks from a local map."""
    stays = np.concatenate(
        [np.ones(len(local.mean) - 2 * len(beyond), np.bool_), np.repeat(~beyond, 2)]
    )
    covariance = local.covariance[np.ix_(stays, stays)]
    return LocalMap(local.ids[~beyond], local.mean[stays], covariance, local.node_stamps)


def compose_pose(whole: WholeMap, open_window: WholeMap | None) -> Posed:
    """Compose a map's pose with the window in progress: N(pose, covariance) of the robot.

    Landmarks that the others contradict by more than GATE are left out, worst first: T = zₗᵀ
    ((S⁻¹)ₗₗ)⁻¹ zₗ with z = S⁻¹ y is χ² of two degrees of freedom (Baarda). Raises
    NotACovarianceError.
    """
    if open_window is None:
        return Posed(PoseGaussian(*whole.pose()))
    pose, covariance, known, refused, fault = whole.pose_after(open_window, GATE)
    _raise_fault(fault)
    return Posed(PoseGaussian(pose, covariance), known, refused)
