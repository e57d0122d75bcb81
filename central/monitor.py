"""The consistency monitor: tests the robots' covariances by their submaps, without the truth.

Two figures are 1 where every covariance is right. The joint cost per degree of freedom is sharp
(1.00-1.04 where the map's NEES is 1, 1.10-1.18 where it is 1.4-2), but bounded by a robust loss.
The covariance scale (docs/decisions/22) is unbounded and insensitive to a minority of outliers.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.consistency import Scale
from teamslam.team.estimation.map_joining.condensed import SubmapCosts
from teamslam.team.estimation.map_joining.marginals import Agreement, BiasEstimate, scale_of

SCALE_WARN = math.sqrt(2.0)  # bound of the team's covariance scale; its inverse is the lower one
ROBOT_WARN = 1.5  # bound of a robot's: one of five sound robots of real data sets reaches 1.4
MISCALIBRATED = 0.015  # bound of the mean of the robots' scale biases
SIGMAS = 3.0  # of the mean scale bias beyond which the models are wrong
SCALE_SIGMAS = 3.3  # of a scale's logarithm out of bounds: by chance less than once in a thousand


class Misscale(NamedTuple):
    """A covariance scale out of bounds, of a robot or the team (empty)."""

    robot: str
    value: float
    log_sigma: float


def miscalibrations(biases: Sequence[BiasEstimate]) -> tuple[str, ...]:
    """Describe where odometry and ranges contradict each other about the size of a map: the range
    scales of all robots move in one direction.
    """
    known = [(value, sigma) for _, bias, value, sigma in biases if bias == "range_scale"]
    if not known:
        return ()
    # They may share their errors (the map's scale), so the mean is no better known than each.
    ranges, sigma = (float(each.mean()) for each in np.array(known).T)
    if abs(ranges) <= max(MISCALIBRATED, SIGMAS * sigma):
        return ()
    return (
        "odometry or range scale not calibrated, covariance not valid: by the odometry, the "
        f"robots' ranges read {100.0 * ranges:+.1f} % long; without ground truth `teamslam "
        "calibrate` learns the odometry's scale, with it both",
    )


def monitor_figures(
    agreement: Agreement | None, biases: Sequence[BiasEstimate], normal: float = 1.0
) -> dict[str, float]:
    """Compute the team's and every robot's figures; normal: the right covariance scale."""
    figures = {}
    if agreement is not None:
        if agreement.dof >= 1.0:
            figures["joint_cost_per_dof"] = agreement.chi2 / agreement.dof
        for robot, (chi2, dof) in agreement.robots.items():
            if dof >= 1.0:
                figures[f"joint_cost_per_dof.{robot}"] = chi2 / dof
        for who, scale in _scales(agreement.submaps, normal).items():
            figures[f"covariance_scale.{who}" if who else "covariance_scale"] = scale.value
    for (robot, _), bias, value, sigma in biases:
        figures[f"bias.{robot}.{bias}"] = value
        figures[f"bias_sigma.{robot}.{bias}"] = sigma
    return figures


def _scales(submaps: SubmapCosts, normal: float) -> dict[str, Scale]:
    found = {"": scale_of(submaps)}
    found |= {robot: scale_of(submaps, of) for robot, of in submaps.of_robots.items()}
    return {
        who: Scale(each.value / normal, each.log_sigma)
        for who, each in found.items()
        if each is not None
    }


def find_misscaled(
    submaps: SubmapCosts, normal: float = 1.0, *, final: bool = True
) -> tuple[Misscale, ...]:
    """Find the scales out of bounds, the team's unless a minority explains it.

    final: report too large covariances, too; before a loop closure submaps hardly contradict each
    other.
    """
    scales = _scales(submaps, normal)
    judged = {who: each for who, each in scales.items() if final or each.value > 1.0}
    robots = [who for who, each in judged.items() if who and _is_beyond(each, ROBOT_WARN)]
    team = "" in judged and _is_beyond(judged[""], SCALE_WARN)
    if team and (not robots or 2 * len(robots) > len(scales) - 1):
        return (Misscale("", *judged[""]),)
    return tuple(Misscale(robot, *judged[robot]) for robot in robots)


def _is_beyond(scale: Scale, limit: float) -> bool:
    return scale.value > 0.0 and abs(core.log(scale.value)) > max(
        core.log(limit), SCALE_SIGMAS * scale.log_sigma
    )
