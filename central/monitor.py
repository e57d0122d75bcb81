"""The consistency monitor: what the joint cost says of the robots' covariances, without any truth.

χ² per degree of freedom is 1 when every covariance is true. Measured: 1.00-1.04 where the map's
NEES is 1, 1.10-1.18 where it is 1.4-2, 54 where it is 514. With few degrees of freedom it scatters,
so a level counts only beyond the 99.9 % quantile of χ² as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.stats import chi2 as chi_squared

from team.config import Bias
from team.estimation.marginals import Agreement, BiasEstimate

WARN = 1.1
FAIL = 1.3
QUANTILE = 0.999
MISCALIBRATED = 0.015
"""A mean of the robots' scales beyond this is an error of the models, not of single robots."""
SIGMAS = 3.0
NAMED = 3
"""Submaps that are named at the most, the worst first."""


@dataclass(frozen=True)
class Finding:
    """The monitor's figures by name, and its warnings in words."""

    figures: dict[str, float]
    warnings: tuple[str, ...]

    def with_biases(self, biases: Sequence[BiasEstimate]) -> "Finding":
        """The finding with each bias and its sigma among the figures, by robot and name."""
        figures = {}
        for (robot, _), bias, value, sigma in biases:
            figures[f"bias.{robot}.{bias}"] = value
            figures[f"bias_sigma.{robot}.{bias}"] = sigma
        return replace(self, figures=self.figures | figures)


NOTHING = Finding({}, ())


def miscalibrations(biases: Sequence[BiasEstimate]) -> tuple[str, ...]:
    """What the team's own data say against the models of all robots together, in words.

    The size of a map comes from the odometry and from the ranges. Where they contradict each other
    the robots' range scales, each of which is held near its model's, move in the same direction:
    the joint cost hardly shows it, their mean does. At speeds that the models were not learnt at
    the odometry's scale is free instead; then nothing is wrong, but it is told.
    """
    found = []
    ranges = _mean_of(biases, "range_scale")
    if ranges is not None:
        found.append(
            "odometry or range scale not calibrated, covariance not valid: by the odometry, the "
            f"robots' ranges read {100.0 * ranges:+.1f} % long (see `teamslam calibrate`)"
        )
    ways = _mean_of(biases, "forward_scale")
    if ways is not None:
        found.append(
            "odometry not calibrated at these speeds: by the ranges, the robots drive "
            f"{100.0 * ways:+.1f} % farther than it says; taken into account"
        )
    return tuple(found)


def _mean_of(biases: Sequence[BiasEstimate], name: Bias) -> float | None:
    """The mean of one bias over the robots, where it is too large to be that of single robots."""
    known = np.array([(value, sigma) for _, bias, value, sigma in biases if bias == name])
    if not len(known):
        return None
    mean = float(known[:, 0].mean())
    # They may share their errors (the map's scale), so the mean is no better known than each.
    sigma = float(known[:, 1].mean())
    return mean if abs(mean) > max(MISCALIBRATED, SIGMAS * sigma) else None


def finding(agreement: Agreement) -> Finding:
    """The team's and every robot's cost per degree of freedom, and who is out of bounds."""
    figures = {}
    warnings = []
    if agreement.dof >= 1.0:
        figures["joint_cost_per_dof"] = agreement.chi2 / agreement.dof
    for robot, (chi2, dof) in agreement.robots.items():
        if dof < 1.0:
            continue
        figures[f"joint_cost_per_dof.{robot}"] = chi2 / dof
        level = _level(chi2, dof)
        if level is not None:
            warnings.append(f"{robot}: joint cost {chi2 / dof:.2f} per degree of freedom, {level}")
    return Finding(figures, (*warnings, *_worst(agreement)))


def _level(chi2: float, dof: float) -> str | None:
    ratio = chi2 / dof
    if ratio <= max(WARN, _bound(round(dof, 1), QUANTILE)):
        return None
    if ratio > FAIL:
        return f"above {FAIL}: its covariances are not to be trusted"
    return f"above {WARN}: its covariances are too small"


def _worst(agreement: Agreement) -> list[str]:
    """The submaps that the rest of the map contradicts, beyond what so many would by chance."""
    quantile = 1.0 - (1.0 - QUANTILE) / max(len(agreement.submaps), 1)
    wrong = [
        (each.chi2 / each.dof, each)
        for each in agreement.submaps
        if each.dof > 1.0 and each.chi2 / each.dof > max(FAIL, _bound(round(each.dof, 1), quantile))
    ]
    wrong.sort(key=lambda pair: (-pair[0], pair[1].stream, pair[1].sequence))
    return [
        f"{each.stream[0]}: submap {each.sequence} disagrees with the rest, "
        f"cost {ratio:.1f} per degree of freedom, weight {each.weight:.2f}"
        for ratio, each in wrong[:NAMED]
    ]


@lru_cache(maxsize=4096)
def _bound(dof: float, quantile: float) -> float:
    return float(chi_squared.ppf(quantile, dof)) / dof
