"""How sure submaps are: maps of single robots against the rest of their team, without the truth.

A robot's own map a and the map b of the others share no measurement. Where the covariances are
right,

    D = min over rigid motions of (a − b)ᵀ (P_a + P_b)⁻¹ (a − b)

has the mean 2n − 3 for the n landmarks of both. `covariance_factor` is what makes Σ D that of all
robots of all worlds: it stands for errors that last longer than a window, and for a robust loss,
which weighs down what fits, too. What is wrong alike for all robots is not seen.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from central.config import CentralConfig
from central.desk.evaluation.errors import map_errors, moved, rigid_alignment
from central.tick_fold import join_settings
from sim.calibration.figures import Figure
from team.estimation.consistency import covariance_scale
from team.estimation.contribution import InitialPoseFactor, Stream
from team.estimation.gaussian import LandmarkGaussian
from team.estimation.map_joining.gauss_newton import Island, JoinSettings, joint_marginal, settled
from team.estimation.map_joining.joining import Fold
from team.estimation.map_joining.marginals import joint_cost
from team.estimation.map_joining.merging import ages
from team.estimation.map_joining.submap_graph import EMPTY_GRAPH, extended

LEAST_LANDMARKS = 3
"""Two have one number between them: their distance."""
LEAST_ROBOTS = 3
"""In all worlds together: fewer say little."""
SETTLED = 0.02
"""A factor that moves by a smaller share than this is found."""
MOST_ROUNDS = 8


class Disagreement(NamedTuple):
    """D of one robot, and the numbers that it is a sum over."""

    chi2: float
    dof: int


def covariance_factor(teams: Sequence[Fold], central: CentralConfig) -> Figure | None:
    """The factor under which single robots' maps differ from the rest as they should, at least 1.

    ± from the scatter over the robots. None where there are not three robots with a map to compare.
    """
    settings = join_settings(central)
    factor = settings.covariance_factor
    for _ in range(MOST_ROUNDS):
        told = replace(settings, covariance_factor=factor)
        found = [each for fold in teams for each in disagreements(fold, told) if each.dof]
        if len(found) < LEAST_ROBOTS:
            return None
        chi2, dof = np.array(found).T
        ratio = float(chi2.sum() / dof.sum())
        before, factor = factor, max(1.0, factor * ratio)
        if abs(factor / before - 1.0) < SETTLED:
            break
    spread = float(np.std(chi2 / dof, ddof=1) / np.sqrt(len(found)))
    return Figure("covariance_factor", factor, factor * spread / ratio, "")


def normal_scale(teams: Sequence[Fold], central: CentralConfig) -> Figure | None:
    """The monitor's covariance scale under these settings: what it says where all is right.

    The geometric mean over the worlds, ± from their scatter (of one world: as the monitor knows
    it). None where there are too few submaps to say.
    """
    settings = join_settings(central)
    scales, sigmas = [], []
    for fold in teams:
        key = fold.main_key
        if key is None:
            continue
        island, _, _ = settled(replace(fold.main, settings=settings))
        solved = replace(fold, islands={**fold.islands, key: island})
        submaps = joint_cost(solved).submaps
        chi2, dof = np.array([(each.chi2, each.dof) for each in submaps]).reshape(-1, 2).T
        found = covariance_scale(chi2, dof)
        if found is not None:
            scales.append(np.log(found.value))
            sigmas.append(found.log_sigma)
    if not scales:
        return None
    value = float(np.exp(np.mean(scales)))
    spread = float(np.std(scales, ddof=1)) if len(scales) > 1 else float(sigmas[0])
    return Figure("normal_scale", value, value * spread / np.sqrt(len(scales)), "")


def disagreements(fold: Fold, settings: JoinSettings) -> list[Disagreement]:
    """Of each robot of the main island that shares three landmarks and more with the others."""
    island = fold.main
    robots = sorted({robot for robot, _ in island.graph.streams})
    found = []
    for robot in robots if len(robots) > 1 else ():
        own = _map_of(island, [robot], fold.starts, settings)
        rest = _map_of(island, [r for r in robots if r != robot], fold.starts, settings)
        common = np.intersect1d(own.ids, rest.ids)
        if len(common) >= LEAST_LANDMARKS:
            found.append(_between(_part(own, common), _part(rest, common)))
    return found


def _map_of(
    island: Island,
    robots: Collection[str],
    starts: Mapping[Stream, InitialPoseFactor],
    settings: JoinSettings,
) -> LandmarkGaussian:
    """The map of some robots' submaps alone, solved from where the whole team has it."""
    submaps = [each for each in island.graph.submaps if each.contribution.robot in robots]
    graph, state = extended(
        EMPTY_GRAPH,
        np.zeros(0),
        [each.contribution for each in submaps],
        starts,
        settings.bias_sigma,
        settings.common_bias_sigma,
    )
    for own, of_team in zip(graph.submaps, submaps, strict=True):
        for node, there in zip(own.nodes, of_team.nodes, strict=True):
            first, last = island.graph.offset[there : there + 2]
            state[graph.offset[node] : graph.offset[node + 1]] = island.state[first:last]
    solved, _, _ = settled(Island(graph, state, ages(len(submaps)), ages(0), settings))
    ids = sorted(graph.landmarks)
    mean, covariance = joint_marginal(solved, [graph.landmarks[id_] for id_ in ids])
    return LandmarkGaussian(np.array(ids, np.uint32), mean.reshape(-1, 2), covariance)


def _part(of: LandmarkGaussian, ids: np.ndarray) -> LandmarkGaussian:
    at = np.searchsorted(of.ids, ids)
    numbers = np.column_stack([2 * at, 2 * at + 1]).ravel()
    return LandmarkGaussian(ids, of.means[at], of.covariance[np.ix_(numbers, numbers)])


def _between(a: LandmarkGaussian, b: LandmarkGaussian) -> Disagreement:
    a_from_b = rigid_alignment(a.means, b.means)
    if a_from_b is None:
        return Disagreement(0.0, 0)
    c, s = np.cos(a_from_b[2]), np.sin(a_from_b[2])
    turn = np.kron(np.eye(len(a.ids)), np.array([[c, -s], [s, c]]))
    covariance = a.covariance + turn @ b.covariance @ turn.T
    shape = map_errors(a.means, covariance, moved(a_from_b, b.means)).shape
    dof = 2 * len(a.ids) - 3
    assert shape is not None
    return Disagreement(0.5 * dof * shape.nees_per_landmark, dof)
