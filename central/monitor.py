"""The consistency monitor: tests the robots' covariances by their submaps, without the truth.

Two figures, both 1 where every covariance is right. The joint cost per degree of freedom is sharp
(1.00-1.04 where the map's NEES is 1, 1.10-1.18 where it is 1.4-2), but a robust loss bounds it. The
covariance scale, the median of the submaps' unweighted χ² relative to its expectation
(docs/decisions/22), is unbounded, insensitive to a minority of outliers, and also shows covariances
that are too large. With few degrees of freedom both scatter, so a warning needs a level that chance
alone reaches less than once in a thousand.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import Bias
from teamslam.team.estimation.consistency import Scale, chi2_quantile, covariance_scale
from teamslam.team.estimation.map_joining.condensed_factor import SubmapCost
from teamslam.team.estimation.map_joining.marginals import Agreement, BiasEstimate

WARN = 1.1
FAIL = 1.3
SCALE_WARN = math.sqrt(2.0)
"""Bound of the team's covariance scale; its inverse is the lower one."""
ROBOT_WARN = 1.5
"""Bound of a robot's covariance scale: one of five sound robots of the real data sets reaches
1.4."""
QUANTILE = 0.999
MISCALIBRATED = 0.015
"""Bound of the mean of the robots' scale biases, beyond which the models are wrong."""
SIGMAS = 3.0
SCALE_SIGMAS = 3.3
DEVIATES = 4.0
"""Standard deviations by which a robot's bias differs from its configuration beyond doubt."""
BEYOND_PRIOR = 3.0
"""Least size of such a bias, in scales of its prior: how well a robot is calibrated anyway."""
NAMED = 3
"""Most submaps that are named, the worst first."""
TOO_SMALL = "the reported covariances are too small by a factor of"
TOO_LARGE = "the reported covariances are too large by a factor of"


@dataclass(frozen=True)
class Finding:
    """The monitor's figures by name, and its warnings in words."""

    figures: dict[str, float]
    warnings: tuple[str, ...]

    def with_biases(self, biases: Sequence[BiasEstimate]) -> "Finding":
        """Add each bias and its sigma to the figures, by robot and name."""
        figures = {}
        for (robot, _), bias, value, sigma in biases:
            figures[f"bias.{robot}.{bias}"] = value
            figures[f"bias_sigma.{robot}.{bias}"] = sigma
        return replace(self, figures=self.figures | figures)


NOTHING = Finding({}, ())


class Deviation(NamedTuple):
    """An error of a robot that its configuration lacks: value, sigma and value/sigma."""

    robot: str
    bias: Bias
    value: float
    sigma: float
    significance: float

    def __str__(self) -> str:
        """Describe the error with its figures and the field that removes it."""
        return SENTENCES[self.bias].format(
            robot=self.robot,
            value=self.value,
            sigma=self.sigma,
            size=abs(self.value),
            percent=100.0 * self.value,
            percent_sigma=100.0 * self.sigma,
            late="late against" if self.value > 0.0 else "ahead of",
        )


SENTENCES: Mapping[Bias, str] = {
    "bearing": "{robot}'s bearings read {value:+.4f} ± {sigma:.4f} rad too much: add that to its "
    "sensor.bearing_offset",
    "clock_offset": "{robot}'s detections are stamped {size:.3f} ± {sigma:.3f} s {late} its "
    "odometry: add {value:.3f} to its clock_offset_s",
    "forward_scale": "{robot} drives {percent:+.1f} ± {percent_sigma:.1f} % farther than its "
    "odometry measures: correct its motion.forward_scale",
    "range_offset": "{robot}'s ranges read {value:+.3f} ± {sigma:.3f} m too much: add that to its "
    "sensor.range_offset",
    "range_scale": "{robot}'s ranges read {percent:+.1f} ± {percent_sigma:.1f} % too much: correct "
    "its sensor.range_scale",
}


def deviations(
    biases: Sequence[BiasEstimate], prior_sigma: Mapping[Bias, float], scale: float = 1.0
) -> list[Deviation]:
    """List the biases that differ from their robot's configuration beyond doubt, the surest first.

    scale: the team's covariance scale, or cost per degree of freedom; above 1 the standard
    deviations grow by its root. Biases within BEYOND_PRIOR scales of their prior are as the
    configuration states.
    """
    grown = math.sqrt(max(scale, 1.0))
    found = [
        Deviation(each.stream[0], each.bias, each.value, sigma, abs(each.value) / sigma)
        for each in biases
        if (sigma := grown * each.sigma) > 0.0
        and abs(each.value) > max(DEVIATES * sigma, BEYOND_PRIOR * prior_sigma[each.bias])
    ]
    return sorted(found, key=lambda each: (-each.significance, each.robot, each.bias))


def miscalibrations(biases: Sequence[BiasEstimate]) -> tuple[str, ...]:
    """Describe where the team's data contradict the models of all robots together.

    Odometry and ranges both determine the size of a map. Where they contradict each other, the
    robots' range scales, each held near its model's, move in the same direction: the joint cost
    hardly shows it, their mean does.
    """
    ranges = _mean_of(biases, "range_scale")
    if ranges is None:
        return ()
    return (
        "odometry or range scale not calibrated, covariance not valid: by the odometry, the "
        f"robots' ranges read {100.0 * ranges:+.1f} % long; without ground truth `teamslam "
        "calibrate` learns the odometry's scale, with it both",
    )


def _mean_of(biases: Sequence[BiasEstimate], name: Bias) -> float | None:
    """Mean of one bias over the robots, if too large for errors of single robots."""
    known = np.array([(value, sigma) for _, bias, value, sigma in biases if bias == name])
    if not len(known):
        return None
    mean = float(known[:, 0].mean())
    # They may share their errors (the map's scale), so the mean is no better known than each.
    sigma = float(known[:, 1].mean())
    return mean if abs(mean) > max(MISCALIBRATED, SIGMAS * sigma) else None


def finding(agreement: Agreement, normal: float = 1.0, *, final: bool = True) -> Finding:
    """Compute the team's and every robot's figures, with warnings about those out of bounds.

    normal: the covariance scale where the covariances are right; the reported scale is relative to
    it. final: of the final map. Before it, covariances that are too large are no warning: the
    submaps of a robot that has not closed a loop yet hardly contradict each other.
    """
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
    scales = _scales(agreement.submaps, normal)
    for who, scale in scales.items():
        figures[f"covariance_scale.{who}" if who else "covariance_scale"] = scale.value
    misscaled = _misscaled(scales, small=final)
    return Finding(figures, (*warnings, *misscaled, *_worst(agreement)))


def _scales(submaps: Sequence[SubmapCost], normal: float) -> dict[str, Scale]:
    """Compute the covariance scale of the team (the empty name) and of each robot."""
    streams = [each[0] for each in submaps]
    chi2, dof = (np.array([each[k] for each in submaps], np.float64) for k in (2, 3))
    places: dict[str, list[int]] = {"": list(range(len(submaps)))}
    for place, (robot, _) in enumerate(streams):
        places.setdefault(robot, []).append(place)
    half = np.asarray(chi2_quantile(0.5, dof))
    found = {
        who: covariance_scale(chi2[own], dof[own], half[own])
        for who, own in ((who, np.array(places[who], np.int64)) for who in sorted(places))
    }
    return {
        who: Scale(each.value / normal, each.log_sigma)
        for who, each in found.items()
        if each is not None
    }


def _misscaled(scales: Mapping[str, Scale], *, small: bool) -> list[str]:
    judged = {who: each for who, each in scales.items() if small or each.value > 1.0}
    words_of = {
        who: words for who, each in judged.items() if who and (words := _misscale(each, ROBOT_WARN))
    }
    team = _misscale(judged[""], SCALE_WARN) if "" in judged else ""
    robots = scales.keys() - {""}
    if team and (not words_of or 2 * len(words_of) > len(robots)):
        return [f"team: {team}"]
    return [f"{robot}: {words}" for robot, words in words_of.items()]


def _misscale(scale: Scale, limit: float) -> str:
    value = scale.value
    if value <= 0.0:
        return ""
    if abs(core.log(value)) <= max(core.log(limit), SCALE_SIGMAS * scale.log_sigma):
        return ""
    wrong = f"{TOO_SMALL} {value:.1f}" if value > 1.0 else f"{TOO_LARGE} {1.0 / value:.1f}"
    return (
        f"{wrong}, by the differences between submaps; multiply the sigmas of sensor and odometry "
        f"by {math.sqrt(value):.2g}, or with ground truth learn them by `teamslam calibrate`"
    )


def _level(chi2: float, dof: float) -> str | None:
    ratio = chi2 / dof
    if ratio <= WARN or ratio <= _bound(round(dof, 1), QUANTILE):
        return None
    if ratio > FAIL:
        return f"above {FAIL}: its covariances are not to be trusted"
    return f"above {WARN}: its covariances are too small"


def _worst(agreement: Agreement) -> list[str]:
    quantile = 1.0 - (1.0 - QUANTILE) / max(len(agreement.submaps), 1)
    wrong = [
        (each.chi2 / each.dof, each)
        for each in agreement.submaps
        if each.chi2 > FAIL * each.dof > FAIL
        and each.chi2 / each.dof > max(FAIL, _bound(round(each.dof, 1), quantile))
    ]
    wrong.sort(key=lambda pair: (-pair[0], pair[1].stream, pair[1].sequence))
    return [
        f"{each.stream[0]}: submap {each.sequence} disagrees with the rest, "
        f"cost {ratio:.1f} per degree of freedom; "
        f"the map takes {100.0 * each.weight:.1f} % of its information"
        for ratio, each in wrong[:NAMED]
    ]


@lru_cache(maxsize=4096)
def _bound(dof: float, quantile: float) -> float:
    return float(chi2_quantile(quantile, dof)) / dof
