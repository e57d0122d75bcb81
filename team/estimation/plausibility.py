"""Check values against physical bounds; a refusal is a value with its reason.

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
    """Return the reason to refuse a submap, if any."""
    if len(local.ids) > bounds.submap_landmarks:
        return f"{len(local.ids)} landmarks, {bounds.submap_landmarks} at most"
    angles = _angles_of(local)
    if np.abs(local.mean[angles]).max() > 2.0 * np.pi:
        return "a heading beyond a full turn"
    why = _far(local.mean[~angles], bounds.extent_m, "of its start")
    rows = (local.sensitivity, local.curvature)
    if why is None and max(np.abs(each).max(initial=0.0) for each in rows) > bounds.sensitivity:
        why = f"a sensitivity beyond {bounds.sensitivity:g}"
    return why or _spread(local.covariance, angles, bounds)


def with_least_spread(local: LocalMap, least: tuple[float, float]) -> LocalMap:
    """Raise the submap's covariance P to P + F where P − F is not positive definite, F =
    diag(least²) for coordinates [m] and headings [rad].
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
    """Return the reason to refuse an inter-robot measurement, if any."""
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
    """Return the reason to refuse an initial pose, if any."""
    if abs(start.pose[2]) > 2.0 * np.pi:
        return "a heading beyond a full turn"
    why = _far(start.pose[:2], bounds.coordinate_m, "of the origin")
    if why is None and start.covariance is not None:
        why = _spread(start.covariance, np.array([False, False, True]), bounds)
    return why


def prior_beyond(mean: Values, covariance: Matrix, bounds: Bounds) -> str | None:
    """Return the reason to refuse a prior (x, y, θ, x₁, y₁, …).

    A variance of zero is a known constant; many submaps allow any small one.
    """
    points = np.arange(len(mean)) != 2
    why = _far(mean[points], bounds.coordinate_m, "of the origin")
    largest = float(np.sqrt(np.max(np.diag(covariance)[points], initial=0.0)))
    if why is None and largest > bounds.sigma_m[1]:
        why = f"a sigma of {largest:.3g} m, not up to {bounds.sigma_m[1]:g} m"
    return why


def is_motion_spread(covariance: Matrix, bounds: Bounds) -> bool:
    """Whether the covariance of a motion on SE(2) is within the bounds."""
    most = np.array([bounds.sigma_m[1], bounds.sigma_m[1], bounds.sigma_rad[1]])
    return bool((np.sqrt(np.diag(covariance)) <= most).all())


def are_landmarks(covariance: Matrix) -> bool:
    """Whether a joint covariance is finite and each point's block a covariance."""
    if not np.isfinite(covariance).all():
        return False
    variances = covariance.diagonal()
    xx, xy, yy = variances[::2], covariance.diagonal(1)[::2], variances[1::2]
    if not ((xx > 0.0) & (yy > 0.0)).all():
        return False
    return bool((np.abs(xy) < np.sqrt(xx) * np.sqrt(yy)).all())


def _far(coordinates: Values, limit_m: float, of: str) -> str | None:
    farthest = float(np.abs(coordinates).max(initial=0.0))
    if farthest <= limit_m:
        return None
    return f"a coordinate of {farthest:.3g} m, not within {limit_m:g} m {of}"


def _spread(covariance: Matrix, angles: np.ndarray, bounds: Bounds) -> str | None:
    variances = np.diag(covariance)
    if not (variances > 0.0).all():
        return "a variance that is not positive"
    sigmas = np.sqrt(variances)
    for of, unit, (least, most) in (
        (sigmas[~angles].tolist(), "m", bounds.sigma_m),
        (sigmas[angles].tolist(), "rad", bounds.sigma_rad),
    ):
        worst = [s for s in (min([most, *of]), max([least, *of])) if not least <= s <= most]
        if worst:
            return f"a sigma of {worst[0]:.3g} {unit}, not from {least:g} to {most:g} {unit}"
    try:
        factor = dense.cholesky(covariance / sigmas / sigmas[:, None])
    except np.linalg.LinAlgError:
        return "a covariance that is not positive definite"
    left = core.squared(float(np.min(np.diag(factor), initial=1.0)))
    if left < bounds.independent:
        return (
            f"a number of which the others leave a share of {left:.1g} of its variance, "
            f"{bounds.independent:g} needed"
        )
    return None
