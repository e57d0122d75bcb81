"""Warnings about fixes that contradict the map, with a delay or antenna that explains them.

At a pose node (p, θ) with velocity v, a fix z of the antenna a with covariance σ² I leaves e =
R(θ)ᵀ (z − p) − a. Fixes late by δ, of an antenna off by b, have e = b − δ v: weighted least squares
give (b, δ), with covariance scaled by the remaining residuals. The map follows its fixes in part,
so the estimates are rather small.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.core import located
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Stream, named
from teamslam.team.estimation.gaussian import information
from teamslam.team.estimation.inter_robot import STATION_POSE
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.submap_graph import Encounter
from teamslam.team.estimation.se2 import inverse, transformed
from teamslam.team.shapes import Float

LEAST_FIXES = 12
DISCOUNTED = 0.5  # a fix of less weight contradicts the map
MOST_AGAINST = 0.25
"""Share of contradicting fixes above which their errors are not those that the robot states."""
SIGMAS = 5.0  # least size of a delay or an antenna's displacement in its standard deviations
LEAST = (0.3, 0.3, 0.1)
"""Least displacement of the antenna, ahead and left [m], and least delay [s]."""
PRIOR_SIGMA = 10.0  # weak prior of each [m, m, s], for paths that do not determine it


class _Residual(NamedTuple):
    """Residual e [m], velocity v [m/s], and information w/σ² of one fix."""

    e: Float[np.ndarray, "2"]
    v: Float[np.ndarray, "2"]
    weight: float


def fix_warnings(fold: Fold) -> Iterator[str]:
    """Warn of robots with many contradictory fixes, and of late or displaced ones."""
    if fold.main_key is None:
        return
    island = fold.main
    by_stream: dict[Stream, list[tuple[Encounter, float]]] = {}
    of_each = zip(island.graph.sightings, island.estimate.sighting_weights.tolist(), strict=True)
    for each, weight in of_each:
        if each.sighting.is_fix:
            by_stream.setdefault(each.sighting.stream, []).append((each, weight))
    for stream, fixes in sorted(by_stream.items(), key=lambda item: item[0]):
        if len(fixes) < LEAST_FIXES:
            continue
        against = sum(weight < DISCOUNTED for _, weight in fixes)
        if against > MOST_AGAINST * len(fixes):
            yield (
                f"{named(stream)}: {against} of {len(fixes)} fixes contradict the map beyond "
                "chance: check gnss.sigma_m, gnss.antenna, gnss.delay_s and the frame of known "
                "starts"
            )
            continue
        stamps = sorted(stamp_ns for of, stamp_ns in island.graph.poses if of == stream)
        place = {stamp_ns: k for k, stamp_ns in enumerate(stamps)}
        residuals = []
        for each, weight in fixes:
            at = place[each.sighting.stamp_ns]
            if 0 < at < len(stamps) - 1:
                around = stamps[at - 1], stamps[at + 1]
                residuals.append(_residual(island, each, weight, around))
        if len(residuals) >= LEAST_FIXES:
            yield from _explained(stream, residuals)


def _residual(island: Island, fix: Encounter, weight: float, around: tuple[int, int]) -> _Residual:
    seen = fix.sighting
    before, after = (island.value(island.graph.poses[seen.stream, each]) for each in around)
    body = inverse(island.value(fix.teammate))
    lasting_s = 1e-9 * (around[1] - around[0])
    v = (transformed(body, after[:2]) - transformed(body, before[:2])) / lasting_s
    distance, bearing = seen.measurement.tolist()
    e = transformed(body, located(STATION_POSE, distance, bearing)) - seen.point
    P = seen.covariance
    variance = 0.5 * (float(P[0, 0]) + core.squared(distance) * float(P[1, 1]))
    return _Residual(e, v, weight / variance)


def _explained(stream: Stream, residuals: Sequence[_Residual]) -> Iterator[str]:
    J = np.zeros((2 * len(residuals), 3))
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[:, 2] = [-value for each in residuals for value in each.v.tolist()]
    e = np.array([value for each in residuals for value in each.e.tolist()])
    w = np.array([each.weight for each in residuals for _ in range(2)])
    N = dense.product(J.T, J * w[:, None]) + np.eye(3) / PRIOR_SIGMA**2
    P = information(0.5 * (N + N.T), f"the fixes of {named(stream)}")
    found = dense.product(P, dense.product(J.T, w * e))
    left = e - dense.product(J, found)
    scale = max(1.0, float(dense.product((left * w)[None], left[:, None])[0, 0]) / (len(e) - 3))
    sigmas = [math.sqrt(scale * float(P[k, k])) for k in range(3)]
    x, y, late = found.tolist()
    is_sure = [
        abs(value) > max(SIGMAS * sigma, least)
        for value, sigma, least in zip(found.tolist(), sigmas, LEAST, strict=True)
    ]
    if is_sure[2]:
        yield (
            f"{named(stream)}: its fixes are {abs(late):.2g} ± {sigmas[2]:.1g} s "
            f"{'late' if late > 0.0 else 'early'}: add {late:.2g} to its gnss.delay_s"
        )
    if is_sure[0] or is_sure[1]:
        yield (
            f"{named(stream)}: its fixes are of a point ({x:+.2g}, {y:+.2g}) m from gnss.antenna, "
            f"± {max(sigmas[:2]):.1g} m: correct its antenna by that"
        )
