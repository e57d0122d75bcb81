"""Calibrate submap consistency from maps of single robots, without truth.

A robot's own map a and the others' map b share no measurement. With right covariances
    D = min over rigid motions of (a − b)ᵀ (P_a + P_b − P_ab − P_ba)⁻¹ (a − b)
has mean 2n − 3 for n common landmarks; P_ab comes from shared states of team-wide biases.
`covariance_factor` gives ΣD its expected value. Errors common to all robots show only against true
landmarks (`landmark_sigma`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import brentq

from teamslam.central.config import CentralConfig
from teamslam.central.desk.evaluation.errors import map_errors, rigid_alignment, transform_points
from teamslam.central.monitor import SCALE_WARN
from teamslam.central.tick_fold import join_settings
from teamslam.sim.calibration.figures import Figure, nest_figures
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.team.config import Sensor
from teamslam.team.estimation.contribution import InitialPoseFactor, Stream
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    JoinSettings,
    ages,
    joint_marginal,
    solve_island,
)
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.marginals import joint_cost, scale_of
from teamslam.team.estimation.map_joining.submap_graph import EMPTY_GRAPH, Graph, add_submaps
from teamslam.team.shapes import Float

LEAST_LANDMARKS = 3  # two landmarks have one invariant only, their distance
LEAST_ROBOTS = 3  # least number of robots in all worlds together
FARTHEST_M = 1.0  # largest distance of a measured landmark from its place
SETTLED = 0.02  # relative factor change that ends the iteration
MOST_ROUNDS = 8
EXCESSIVE = 1.0 / SCALE_WARN  # NIS over its least expected value that shows too large sigmas
LASTING = 2.0  # standard deviations of ln `covariance_factor` from 0 that show lasting errors
APART = 2**40  # offset of the single robot's landmark numbers, above all others


class _Disagreement(NamedTuple):
    chi2: float
    dof: int


def central_figures(
    folds: Sequence[Fold],
    scenario: Scenario,
    strays: Sequence[Figure],
    progress: Callable[[str], None],
    true_landmarks: Sequence[Mapping[int, Float[np.ndarray, "2"]]] = (),
) -> tuple[Figure, ...]:
    """Robots' own biases, covariance factor, monitor's normal scale, and landmark sigma."""
    progress("maps of single robots against the rest of their team")
    before = msgspec.to_builtins(scenario.central)
    fields = nest_figures(before, strays, CentralConfig)
    for table in ("bias_sigma", "common_bias_sigma"):
        fields[table] = before[table] | fields[table]
    central = msgspec.convert(fields, CentralConfig)
    factor = covariance_factor(folds, central)
    if factor is None:
        return tuple(strays)
    found = (*strays, factor)
    central = msgspec.structs.replace(central, covariance_factor=factor.value)
    further = [_normal_scale(folds, central)]
    if true_landmarks:
        further.append(landmark_sigma(list(zip(folds, true_landmarks, strict=True)), central))
    return (*found, *(figure for figure in further if figure is not None))


def covariance_factor(teams: Sequence[Fold], central: CentralConfig) -> Figure | None:
    """Factor, at least 1, that gives ΣD its expected value; None below LEAST_ROBOTS."""
    settings = join_settings(central)
    factor = settings.covariance_factor
    for _ in range(MOST_ROUNDS):
        scaled = replace(settings, covariance_factor=factor)
        found = [each for fold in teams for each in disagreements(fold, scaled) if each.dof]
        if len(found) < LEAST_ROBOTS:
            return None
        chi2, dof = np.array(found).T
        ratio = float(chi2.sum() / dof.sum())
        before, factor = factor, max(1.0, factor * ratio)
        if abs(factor / before - 1.0) < SETTLED:
            break
    spread = float(np.std(chi2 / dof, ddof=1) / np.sqrt(len(found)))
    return Figure("covariance_factor", factor, factor * spread / ratio, "")


def factor_by_cost(
    refold: Callable[[CentralConfig], Fold], central: CentralConfig
) -> Figure | None:
    """Factor, at least 1, at which the joint cost equals its degrees of freedom; σ from χ².

    Covers errors that differ between windows. Landmarks are associated anew for each factor.
    """
    factor = central.covariance_factor
    for _ in range(MOST_ROUNDS):
        fold = refold(msgspec.structs.replace(central, covariance_factor=factor))
        found = joint_cost(fold)
        if not fold.contributions or found.dof <= 0:
            return None
        before, factor = factor, max(1.0, factor * found.chi2 / found.dof)
        if abs(factor / before - 1.0) < SETTLED:
            break
    return Figure("covariance_factor", factor, factor * float(np.sqrt(2.0 / found.dof)), "")


def landmark_sigma(
    teams: Sequence[tuple[Fold, Mapping[int, Float[np.ndarray, "2"]]]], central: CentralConfig
) -> Figure | None:
    """σ [m] with Σ χ²(σ) = Σ dof of the maps' shape errors, for P + σ² I; 0 if P suffices.

    Standard deviation: half the range of Σ χ² = Σ dof ± √(2 Σ dof).
    """
    settings = replace(join_settings(central), landmark_sigma=0.0)
    maps = []
    for fold, truth in teams:
        key = fold.main_key
        if key is None:
            continue
        island, _, _ = solve_island(replace(fold.main, settings=settings))
        ids = [id_ for id_ in sorted(island.graph.landmarks) if id_ in truth]
        if len(ids) >= LEAST_LANDMARKS:
            nodes = [island.graph.landmarks[id_] for id_ in ids]
            mean, P = joint_marginal(island, nodes)
            maps.append((mean.reshape(-1, 2), P, np.array([truth[id_] for id_ in ids])))
    if not maps:
        return None
    dof = sum(2 * len(means) - 3 for means, _, _ in maps)

    def excess(sigma: float, of: float) -> float:
        return sum(_shape_chi2(m, P + sigma**2 * np.eye(len(P)), t) for m, P, t in maps) - of

    def solved(of: float) -> float:
        if excess(0.0, of) <= 0.0:
            return 0.0
        return float(brentq(excess, 0.0, FARTHEST_M, args=(of,), xtol=1e-7))

    spread = np.sqrt(2.0 * dof)
    error = 0.5 * (solved(dof - spread) - solved(dof + spread))
    return Figure("landmark_sigma", solved(dof), error, "m")


def _shape_chi2(
    means: Float[np.ndarray, "n 2"], covariance: Float[np.ndarray, "m m"], truth: np.ndarray
) -> float:
    shape = map_errors(means, covariance, truth).shape
    return 0.0 if shape is None else 0.5 * (2 * len(means) - 3) * shape.nees_per_landmark


def _normal_scale(teams: Sequence[Fold], central: CentralConfig) -> Figure | None:
    """Covariance scale of consistent data: geometric mean over the worlds, σ from their scatter, or
    the monitor's.
    """
    settings = join_settings(central)
    scales, sigmas = [], []
    for fold in teams:
        key = fold.main_key
        if key is None:
            continue
        island, _, _ = solve_island(replace(fold.main, settings=settings))
        solved = replace(fold, islands={**fold.islands, key: island})
        found = scale_of(joint_cost(solved).submaps)
        if found is not None:
            scales.append(np.log(found.value))
            sigmas.append(found.log_sigma)
    if not scales:
        return None
    value = float(np.exp(np.mean(scales)))
    spread = float(np.std(scales, ddof=1)) if len(scales) > 1 else float(sigmas[0])
    return Figure("normal_scale", value, value * spread / np.sqrt(len(scales)), "")


def without_excess(
    figures: Sequence[Figure], innovation: Innovation, least: float, sensor: Sensor
) -> tuple[tuple[Figure, ...], tuple[str, ...]]:
    """Figures whose `normal_scale` hides no sigmas that NIS shows too large, with a note on these.

    Right sigmas have a NIS of at least `least`. A smaller one comes from too large sigmas, or from
    unstated errors that outlast windows: then maps of single robots disagree by more than the
    submaps claim, `covariance_factor` is above 1 beyond doubt, and nothing is changed.
    """
    by_name = {figure.name: figure for figure in figures}
    scale, factor = by_name.get("normal_scale"), by_name.get("covariance_factor")
    nis = innovation.per_dof
    if scale is None or factor is None or nis is None or least <= 0.0:
        return tuple(figures), ()
    excess = innovation.squared / least
    lasting = np.log(factor.value) > LASTING * factor.sigma / factor.value
    if not 0.0 < excess < EXCESSIVE or lasting:
        return tuple(figures), ()
    by_name["normal_scale"] = replace(scale, value=scale.value / excess, sigma=scale.sigma / excess)
    times = float(np.sqrt(excess))
    sigmas = ", ".join(
        f"{name} = {times * value:.2g} for {value:g}"
        for name in ("range_sigma", "range_sigma_per_m", "bearing_sigma")
        if (value := float(getattr(sensor, name)))
    )
    note = (
        f"NIS {nis:.2f} per degree of freedom: the stated sigmas are too large by "
        f"{1.0 / times:.2g}: multiply those of sensor and odometry by {times:.2g} "
        f"({sigmas}); normal_scale leaves that share out"
    )
    return tuple(by_name.values()), (note,)


def disagreements(fold: Fold, settings: JoinSettings) -> list[_Disagreement]:
    """D of each robot with at least LEAST_LANDMARKS in common with the others."""
    island = fold.main
    robots = sorted({robot for robot, _ in island.graph.streams})
    found = []
    for robot in robots if len(robots) > 1 else ():
        graph, solved = _separate_robot(island, robot, fold.starts, settings)
        common = [id_ for id_ in sorted(graph.landmarks) if id_ + APART in graph.landmarks]
        if len(common) >= LEAST_LANDMARKS:
            nodes = [graph.landmarks[id_ + of] for of in (APART, 0) for id_ in common]
            found.append(_compare_maps(*joint_marginal(solved, nodes)))
    return found


def _separate_robot(
    island: Island, robot: str, starts: Mapping[Stream, InitialPoseFactor], settings: JoinSettings
) -> tuple[Graph, Island]:
    """One robot's map beside the others', its landmarks numbered from APART."""
    submaps = island.graph.submaps
    id_of = {node: id_ for id_, node in island.graph.landmarks.items()}
    numbers = {
        each.contribution.key: [
            id_of[node] + (APART if each.contribution.robot == robot else 0)
            for node in each.landmarks.tolist()
        ]
        for each in submaps
    }
    graph, state = add_submaps(
        EMPTY_GRAPH,
        np.zeros(0),
        [each.contribution for each in submaps],
        starts,
        settings.bias_sigma,
        settings.common_bias_sigma,
        numbers,
    )
    for own, of_team in zip(graph.submaps, submaps, strict=True):
        own_biases = of_team.contribution.local.biases
        known = len(of_team.nodes) - len(of_team.biases) + len(own_biases)
        for node, there in zip(own.nodes[:known], of_team.nodes[:known], strict=True):
            first, last = island.graph.offset[there : there + 2]
            state[graph.offset[node] : graph.offset[node + 1]] = island.state[first:last]
    solved, _, _ = solve_island(Island(graph, state, ages(len(submaps)), ages(0), settings))
    return graph, solved


def _compare_maps(
    mean: Float[np.ndarray, " m"], covariance: Float[np.ndarray, "m m"]
) -> _Disagreement:
    """D, from stacked means and joint covariance."""
    a, b = mean.reshape(2, -1, 2)
    a_from_b = rigid_alignment(a, b)
    if a_from_b is None:
        return _Disagreement(0.0, 0)
    c, s = np.cos(a_from_b[2]), np.sin(a_from_b[2])
    turn = np.kron(np.eye(len(a)), np.array([[c, -s], [s, c]]))
    difference = np.hstack([np.eye(2 * len(a)), -turn])
    of_difference = difference @ covariance @ difference.T
    shape = map_errors(a, of_difference, transform_points(a_from_b, b)).shape
    dof = 2 * len(a) - 3
    assert shape is not None
    return _Disagreement(0.5 * dof * shape.nees_per_landmark, dof)
