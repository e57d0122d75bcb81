"""Calibrate single robots' sensor constants and their variation between worlds.

A constant of robot r in world w is v = m + a_r + e_rw. Each robot's value is its mean over worlds,
shrunk towards the mean of all robots by the spread s of e (robust, at least that of the fit):
    m + (v̄_r − m) τ²/(τ² + s²/n_r),    τ² = var(v̄_r) − mean(s²/n_r).
Robots are alike unless, with W the joint covariance of one world's constants, Σ_r n_r (v̄_r − m)ᵀ
W⁻¹ (v̄_r − m)/(p (R − 1)) exceeds the F distribution of p (R − 1) and Σ(n_r − 1) degrees of
freedom.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import f as f_distribution

from teamslam.sim.calibration.data import Reference
from teamslam.sim.calibration.figures import CalibrationError, Figure, groups_of
from teamslam.sim.calibration.sensor import MAD_TO_SIGMA, UNITS, joint_constants, shares_by_landmark
from teamslam.team.shapes import Float

LEAST_ROBOTS = 3
LEAST_LANDMARKS = 4
BEYOND_DOUBT = 0.99
COMMON_DOF = 2  # prior of the common range scale, as a number of further worlds
BIAS_OF = {
    "bearing_offset": "bearing",
    "range_offset": "range_offset",
    "range_scale": "range_scale",
}
"""Bias that the centre estimates for each constant."""


class _Own(NamedTuple):
    """robots: sensor figures of each, empty if alike. strays: σ of each bias in a further world,
    √(s² + variance of the figure).
    """

    robots: Mapping[str, tuple[Figure, ...]]
    strays: tuple[Figure, ...]


NOTHING_OF_ITS_OWN = _Own({}, ())


def own_constants(data: Sequence[Reference], *, depth: bool) -> _Own:
    """Each robot's constants over worlds, or time stretches."""
    found: dict[str, list[Mapping[str, float]]] = {}
    covariances = []
    worlds: dict[str, list[str]] = {}
    for group in groups_of(data):
        try:
            values, covariance = joint_constants(group, depth=depth)
        except CalibrationError:
            continue
        covariances.append(covariance)
        found.setdefault(group[0].robot, []).append(values.figures)
        worlds.setdefault(group[0].robot, []).append(group[0].name.rpartition(" ")[0])
    found = {robot: each for robot, each in sorted(found.items()) if len(each) > 1}
    if len(found) < LEAST_ROBOTS:
        return NOTHING_OF_ITS_OWN
    counts = np.array([len(each) for each in found.values()], dtype=float)
    robots: dict[str, list[Figure]] = {robot: [] for robot in found}
    strays, off, spreads = [], [], []
    of_fit = np.mean(covariances, axis=0)
    sigmas = np.sqrt(np.diag(of_fit))
    dof = len(counts) - 1, int(counts.sum()) - len(counts)
    for name, sigma_of_fit in zip(next(iter(found.values()))[0], sigmas, strict=True):
        parts = [np.array([values[name] for values in each]) for each in found.values()]
        means = np.array([part.mean() for part in parts])
        stray = max(_spread_in_robot(parts), float(sigma_of_fit))
        of_means = stray**2 / counts
        between = float(np.var(means, ddof=1))
        off.append(np.sqrt(counts) * (means - means.mean()))
        spreads.append(stray)
        tau2 = max(between - float(of_means.mean()), 0.0)
        share = tau2 / (tau2 + of_means) if tau2 > 0.0 else np.zeros(len(means))
        drawn = means.mean() + share * (means - means.mean())
        for robot, value, sigma in zip(found, drawn, np.sqrt(of_means * share), strict=True):
            robots[robot].append(Figure(name, float(value), float(sigma), UNITS[name]))
        if name in BIAS_OF:
            further = float(np.sqrt(stray**2 + np.mean(of_means * share)))
            error = further / np.sqrt(2.0 * dof[1])
            strays.append(Figure(f"bias_sigma.{BIAS_OF[name]}", further, error, UNITS[name]))
        if name == "range_scale":
            strays.append(_in_common(parts, [worlds[robot] for robot in found], stray))
    scale = np.array(spreads) / sigmas
    T2 = float(np.sum(np.array(off) * np.linalg.solve(of_fit * np.outer(scale, scale), off)))
    numbers = len(spreads) * dof[0]
    if T2 / numbers <= float(f_distribution.ppf(BEYOND_DOUBT, numbers, dof[1])):
        return NOTHING_OF_ITS_OWN
    return _Own({robot: tuple(each) for robot, each in robots.items()}, tuple(strays))


def _spread_in_robot(parts: Sequence[Float[np.ndarray, " n"]]) -> float:
    """Spread of a robot's values, from the median of |v − v̄| √(n/(n − 1))."""
    off = [np.abs(part - part.mean()) * np.sqrt(len(part) / (len(part) - 1)) for part in parts]
    return MAD_TO_SIGMA * float(np.median(np.concatenate(off)))


def _in_common(
    parts: Sequence[Float[np.ndarray, " n"]], worlds: Sequence[Sequence[str]], stray: float
) -> Figure:
    off: dict[str, list[float]] = {}
    for part, names in zip(parts, worlds, strict=True):
        each_world = sorted({*names})
        of = [part[[name == world for name in names]].mean() for world in each_world]
        for world, value in zip(each_world, of - np.mean(of), strict=True):
            off.setdefault(world, []).append(float(value))
    together = np.array([np.median(each) for _, each in sorted(off.items())])
    squares = float(np.sum((together - together.mean()) ** 2))
    dof = COMMON_DOF + len(together) - 1
    sigma = float(np.sqrt((COMMON_DOF * stray**2 + squares) / dof * (1.0 + 1.0 / len(together))))
    return Figure("common_bias_sigma.range_scale", sigma, sigma / np.sqrt(2.0 * dof), "")


def marker_spread(data: Sequence[Reference], *, depth: bool) -> Figure | None:
    """Relative standard deviation of single landmarks' range scales, as of larger markers.

    The share e_rl by which robot r sees landmark l too far is m_l + ε_rl: var(m) = var(ē_l) −
    var(ε) mean(1/n_l) of n_l robots. None if not significant (F test).
    """
    by_world: dict[str, dict[int, list[float]]] = {}
    for each in data:
        world = by_world.setdefault(each.name.rpartition(" ")[0], {})
        for landmark, share in shares_by_landmark(each, depth=depth).items():
            world.setdefault(landmark, []).append(share)
    between, within, of_means = [], [], []
    for world in by_world.values():
        seen = [np.array(shares) for shares in world.values() if len(shares) > 1]
        if len(seen) < LEAST_LANDMARKS:
            continue
        means = np.array([shares.mean() for shares in seen])
        between.append((float(np.var(means, ddof=1)), len(means) - 1))
        squares = sum(float(((shares - shares.mean()) ** 2).sum()) for shares in seen)
        within.append((squares, sum(len(shares) - 1 for shares in seen)))
        of_means.append(float(np.mean([1.0 / len(shares) for shares in seen])))
    if not between:
        return None
    dof = sum(n for _, n in between), sum(n for _, n in within)
    alone = sum(squares for squares, _ in within) / dof[1] * float(np.mean(of_means))
    found = sum(variance * n for variance, n in between) / dof[0]
    if found <= alone * float(f_distribution.ppf(BEYOND_DOUBT, *dof)):
        return None
    sigma = float(np.sqrt(found - alone))
    error = found / sigma * float(np.sqrt(0.5 / dof[0]))
    return Figure("common_bias_sigma.marker", sigma, error, "")
