"""A robot's pose in the team's map: the broadcast prior times the robot's own later submaps.

The prior (the joint marginal of the robot's last joined end pose and the landmarks) and the submaps
that are not in it are independent, so their product is exact; what the centre knows of the errors
that all of a robot's submaps share is applied to them first. It is one least-squares problem, the
centre's own with the prior in the place of all earlier submaps, and linearised where they all
agree: joined one after the other, each on the guess before, the first of them would be linearised
where a poor prior has the robot (decision 0031). A landmark that a submap sees where everything
else contradicts it (a misread barcode) is left out of that submap, for this solution only: the next
submap and the next prior judge all of them anew, so nobody is locked out. The result is for display
and control; it never enters anything that the robot sends for fusion.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt32
from scipy.special import chdtri

from team.config import Bias
from team.estimation.consistency import chi2_quantile
from team.estimation.contribution import Contribution
from team.estimation.gaussian import PoseGaussian
from team.estimation.geometry import tangent
from team.estimation.map_joining.gauss_newton import Island, JoinSettings, joint_marginal, settled
from team.estimation.map_joining.joining_kernel import landmark_chi2
from team.estimation.map_joining.merging import ages
from team.estimation.map_joining.submap_graph import EMPTY_GRAPH, extended
from team.estimation.map_joining.whole_map import WholeMap, end_pose, without
from team.estimation.submap import LocalMap

GATE = float(chi2_quantile(0.9999, 2))
"""χ² beyond which what a submap says of a landmark is taken for another landmark's: some twenty are
tested for each pose, and a good one that is left out costs little."""
CONTRADICTED = 1e-6
"""A prior and submaps agree so badly by chance once in a million times: then they contradict."""
TRUSTING = JoinSettings()
"""Least squares."""
DOUBTING = JoinSettings(robust_c=1e3, landmark_gate=GATE)
"""Each landmark of a submap is discounted beyond the gate, which narrows; no submap as a whole."""
DISPUTED = JoinSettings(robust_c=2.0, landmark_gate=GATE)
"""Where they contradict each other a whole submap, or the map, is wrong: it counts for less."""
FEWEST = 2
"""One landmark that is refused is a misread one, whatever else is seen."""
SELF = ("self", 0)
"""The stream of the prior and the robot's submaps in the graph that is solved."""


class Shared(NamedTuple):
    """How the centre takes a robot's submaps: their covariances times a factor f, their biases.

    biases: of each error b that they share its name, the centre's estimate and its sigma.
    """

    covariance_factor: float = 1.0
    biases: tuple[tuple[Bias, float, float], ...] = ()

    def taken(self, local: LocalMap) -> LocalMap:
        """N(mean + Sᵀ b, f P + Sᵀ diag(σ²) S): a submap as the centre takes it, S its sensitivity.

        What is not known of b is taken as independent of the map; the map is correlated with it
        such that this is rather too much than too little. A bias that is not named is zero.
        """
        mean, covariance = local.mean, self.covariance_factor * local.covariance
        for name, value, sigma in self.biases:
            if name in local.biases:
                column = local.sensitivity[local.biases.index(name)]
                mean = mean + value * column
                covariance += sigma * sigma * np.outer(column, column)
        return LocalMap(local.ids, mean, covariance, local.node_stamps)


class RobotPrior(NamedTuple):
    """A robot's last joined end pose and landmarks: joint covariance of (x, y, θ, x₁, y₁, …).

    In the frame of the robot's island [m, rad]; ids ascending. A row of zeros is a known constant.
    shared: how the submaps that are in it were taken, and those that are not are to be.
    """

    pose: Float[np.ndarray, "3"]
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Float[np.ndarray, "n n"]
    shared: Shared = Shared()

    @property
    def whole(self) -> WholeMap:
        """The same as a map."""
        return WholeMap(self.ids, np.concatenate([self.pose, self.means.ravel()]), self.covariance)


class Followed(NamedTuple):
    """A robot's map behind some submaps. known: landmarks of each submap that others or the map
    have, too; refused: how many of them everything else contradicts. cost: χ² of least squares over
    the map and what is left of the submaps, in `dof` degrees of freedom; disputed: it is too much,
    or most of a submap would have to go: something larger than a landmark is wrong.
    """

    whole: WholeMap
    known: tuple[int, ...] = ()
    refused: tuple[int, ...] = ()
    cost: float = 0.0
    dof: int = 0
    disputed: bool = False


class Posed(NamedTuple):
    """N(pose, covariance), and of the window's landmarks: how many the map has, and refuses."""

    pose: PoseGaussian
    known: int = 0
    refused: int = 0


def followed(whole: WholeMap, pending: Iterable[LocalMap]) -> Followed:
    """A robot's map times its submaps behind the map's pose, in order.

    Of the team's prior and the submaps that are not in it: the robot's team map. Least squares; if
    then a landmark of a submap lies beyond the gate, the landmarks are discounted one by one as the
    gate narrows, those that end beyond it are left out, and what remains is solved again. Where
    most of a submap would be left out, or what remains is contradictory still, no single landmark
    is at fault: Cauchy's loss on whole submaps and on the map, with all landmarks, finds what is,
    and the covariance is that of its weights.
    Raises NotACovarianceError, or NotDeterminedError where the numbers are beyond solving.
    """
    submaps = [each.without_nodes for each in pending]
    if not submaps:
        return Followed(whole)
    island, _, _ = settled(_island(whole, submaps, TRUSTING))
    known, refused = tuple(_shared(whole, submaps)), tuple(0 for _ in submaps)
    if any(beyond.any() for beyond in _beyond_gate(island)):
        doubted, _, _ = settled(replace(island, settings=DOUBTING))
        beyond = _beyond_gate(doubted)
        refused = tuple(int(each.sum()) for each in beyond)
        if not any(is_majority(*pair) for pair in zip(refused, known, strict=True)):
            kept = [_without(*pair) for pair in zip(submaps, beyond, strict=True)]
            island, _, _ = settled(_island(whole, kept, TRUSTING))
    cost, dof = float(island.chi2.sum()), _degrees(island)
    disputed = cost > _most(dof) or any(
        is_majority(*pair) for pair in zip(refused, known, strict=True)
    )
    if disputed:
        island, _, _ = settled(_island(whole, submaps, DISPUTED))
    graph = island.graph
    ids = sorted(graph.landmarks)
    nodes = [graph.streams[SELF][-1], *(graph.landmarks[id_] for id_ in ids)]
    mean, covariance = joint_marginal(island, nodes)
    joint = WholeMap(np.array(ids, dtype=np.uint32), mean, covariance)
    return Followed(joint, known, refused, cost, dof, disputed)


def is_majority(refused: int, known: int) -> bool:
    """Whether so many of the known landmarks are refused that it is not they that are wrong."""
    return refused >= FEWEST and 2 * refused > known


def _degrees(island: Island) -> int:
    return int(island.graph.dimensions.sum()) - island.graph.unknowns


def _most(dof: int) -> float:
    """The cost beyond which a map and submaps contradict each other."""
    return float(chdtri(dof, CONTRADICTED)) if dof > 0 else math.inf


def _island(whole: WholeMap, submaps: Sequence[LocalMap], settings: JoinSettings) -> Island:
    """The graph of the map, as a submap that begins at the origin of its frame, and of submaps."""
    chain = [LocalMap(whole.ids, whole.mean, whole.covariance), *submaps]
    taken = [Contribution(*SELF, k, k, each) for k, each in enumerate(chain)]
    graph, state = extended(EMPTY_GRAPH, np.zeros(0), taken, {}, {})
    return Island(graph, state, ages(len(taken)), ages(0), settings)


def _beyond_gate(island: Island) -> list[Bool[np.ndarray, " L"]]:
    """Which landmarks of each submap lie beyond the gate, by their own covariance."""
    factors = island.graph.factors
    beyond = landmark_chi2(island.state, island.graph.offset, factors, 1.0) > GATE
    return np.split(beyond, factors.block_start[1:-1])[1:]


def _without(local: LocalMap, beyond: Bool[np.ndarray, " L"]) -> LocalMap:
    for place in np.flatnonzero(beyond)[::-1]:
        local = without(local, int(place))
    return local


def _shared(whole: WholeMap, submaps: Sequence[LocalMap]) -> Iterator[int]:
    """How many landmarks of each submap the map or another submap has, too."""
    ids, counts = np.unique(
        np.concatenate([whole.ids, *(each.ids for each in submaps)]), return_counts=True
    )
    for each in submaps:
        yield int(np.isin(each.ids, ids[counts > 1]).sum())


def pose_now(whole: WholeMap, open_window: LocalMap | None) -> Posed:
    """N(pose, covariance) of the robot: a map's pose times the window in progress.

    Of the map only the marginal of the landmarks that the window sees is used, which is exact.
    """
    if open_window is None:
        return Posed(PoseGaussian(whole.mean[:3], whole.covariance[:3, :3]))
    pose, refused = end_pose(whole, open_window, GATE)
    return Posed(pose, int(np.isin(open_window.ids, whole.ids).sum()), refused)


def curved(pose: PoseGaussian) -> PoseGaussian:
    """The covariance of (x, y, θ) about pose ∘ Exp(ξ), ξ = (f, l, φ) ~ N(0, S), to second order.

    A robot whose heading is known badly lies on an arc, not in an ellipse: the position is
    (f, l) + φ/2 (−l, f) to second order, so what is known to σ_f along the way is spread across it
    by E[φ²l²]/4 = (S_φφ S_ll + 2 S_lφ²)/4, and so on (moments of a Gaussian; Isserlis 1918). Far
    from where the heading was known that is larger than σ_f². The mean stays the most likely pose.
    """
    T = tangent(float(pose.mean[2]))
    S = T.T @ pose.covariance @ T
    turn = S[:2, 2]
    of_squares = S[2, 2] * S[:2, :2] + 2.0 * np.outer(turn, turn)
    (ff, fl), (_, ll) = 0.25 * of_squares
    spread = np.array([[ll, -fl], [-fl, ff]])
    covariance = pose.covariance.copy()
    covariance[:2, :2] += T[:2, :2] @ spread @ T[:2, :2].T
    return PoseGaussian(pose.mean, covariance)
