"""Check values against physical bounds; return the reason of a refusal.

The wire checks a message's form, this module its plausibility for a robot on the ground.
"""

from dataclasses import replace

import numpy as np

from teamslam.team import core
from teamslam.team.config import Bounds
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import InitialPoseFactor
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Bool, Float

Values = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]


def submap_beyond(local: LocalMap, bounds: Bounds) -> str | None:
    """Return the reason to refuse a submap, or None."""
    if len(local.ids) > bounds.submap_landmarks:
        return f"{len(local.ids)} landmarks, {bounds.submap_landmarks} at most"
    angles = _angles_of(local)
    if core.largest(local.mean[angles]) > 2.0 * np.pi:
        return "a heading beyond a full turn"
    why = _far(local.mean[~angles], bounds.extent_m, "of its start")
    rows = (local.sensitivity, local.curvature)
    if why is None and max(map(core.largest, rows)) > bounds.sensitivity:
        why = f"a sensitivity beyond {bounds.sensitivity:g}"
    return why or _spread(local.covariance, angles, bounds)


def with_least_spread(local: LocalMap, least: tuple[float, float]) -> LocalMap:
    """Raise the submap's covariance P to P + F unless P − F is positive definite.

    F = diag(least²) for coordinates [m] and headings [rad].
    """
    angles = _angles_of(local)
    sigmas = np.where(angles, least[1], least[0])
    if not (sigmas > 0.0).all():
        return local
    try:
        dense.cholesky(local.covariance / sigmas / sigmas[:, None] - np.eye(len(sigmas)))
    except np.linalg.LinAlgError:
        return replace(local, covariance=local.covariance + np.diag(core.squared(sigmas)))
    return local


def _angles_of(local: LocalMap) -> Bool[np.ndarray, " n"]:
    angles = np.zeros(len(local.mean), dtype=np.bool_)
    angles[2 : 3 * (1 + len(local.node_stamps)) : 3] = True
    return angles


def sighting_beyond(sighting: InterRobotFactor, bounds: Bounds) -> str | None:
    """Return the reason to refuse an inter-robot measurement, or None."""
    if sighting.is_fix:
        distance_m = sighting.measurement[:1]
        why = _far(distance_m, bounds.coordinate_m, "of the station")
        why = why or _far(sighting.point, bounds.extent_m, "of its pose node")
        metres = np.array([1.0, distance_m[0]])  # per unit of range, and of bearing
        P = sighting.covariance * metres * metres[:, None]
        return why or _spread(P, np.zeros(2, np.bool_), bounds)
    why = _far(sighting.measurement[:1], bounds.extent_m, "of its observer")
    return why or _spread(sighting.covariance, np.array([False, True]), bounds)


def start_beyond(start: InitialPoseFactor, bounds: Bounds) -> str | None:
    """Return the reason to refuse an initial pose, or None."""
    if abs(start.pose[2]) > 2.0 * np.pi:
        return "a heading beyond a full turn"
    why = _far(start.pose[:2], bounds.coordinate_m, "of the origin")
    if why is None and start.covariance is not None:
        why = _spread(start.covariance, np.array([False, False, True]), bounds)
    return why


def prior_beyond(mean: Values, covariance: Matrix, bounds: Bounds) -> str | None:
    """Return the reason to refuse a prior (x, y, θ, x₁, y₁, …), or None.

    A variance of zero is a known constant; many submaps allow any small one.
    """
    points = np.arange(len(mean)) != 2
    why = _far(mean[points], bounds.coordinate_m, "of the origin")
    largest = float(np.sqrt(np.max(np.diag(covariance)[points], initial=0.0)))
    if why is None and largest > bounds.sigma_m[1]:
        why = f"a sigma of {largest:.3g} m, not up to {bounds.sigma_m[1]:g} m"
    return why


def _far(coordinates: Values, limit_m: float, of: str) -> str | None:
    farthest = core.largest(coordinates)
    if farthest <= limit_m:
        return None
    return f"a coordinate of {farthest:.3g} m, not within {limit_m:g} m {of}"


def _spread(covariance: Matrix, angles: np.ndarray, bounds: Bounds) -> str | None:
    found = core.spread_of(covariance, angles)
    if found is None:
        return "a variance that is not positive"
    metres, radians, left = found
    for (smallest, largest), unit, (least, most) in (
        (metres, "m", bounds.sigma_m),
        (radians, "rad", bounds.sigma_rad),
    ):
        if smallest < least or largest > most:
            worst = smallest if smallest < least else largest
            return f"a sigma of {worst:.3g} {unit}, not from {least:g} to {most:g} {unit}"
    if not left:
        return "a covariance that is not positive definite"
    if left < bounds.independent:
        return (
            f"a number of which the others leave a share of {left:.1g} of its variance, "
            f"{bounds.independent:g} needed"
        )
    return None
