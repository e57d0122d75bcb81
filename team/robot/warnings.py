"""A robot's warnings, in words."""

import numpy as np

from teamslam.team import core
from teamslam.team.config import Estimator
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.submap import Slipped

UNEXPECTED = 3.0
"""NIS per degree of freedom above which measurements contradict the models: 1 is right, and
5 % of outliers give 3 with a coarse sensor, a hundred with an accurate one."""
UNEXPECTED_DOF = 60
"""… computed from this many degrees of freedom at least."""


def unexpected(nis: Innovation, estimator: Estimator) -> tuple[str, ...]:
    """Warn of measurements far from their predictions, and name the settings."""
    ratio = nis.per_dof
    if ratio is None or ratio < UNEXPECTED or nis.dof < UNEXPECTED_DOF:
        return ()
    remedy = "is the sensor's or the odometry's noise larger than its sigmas?"
    if estimator != "hybrid":
        remedy = f"outliers, or {remedy.removeprefix('is ')} {estimator} uses every measurement"
    return (
        f"measurements lie far from their predictions, NIS {ratio:.0f} per degree of freedom "
        f"(1 is right): {remedy}",
    )


def slipped(slip: Slipped) -> str:
    """Describes a slip of the odometry."""
    metres, turn = core.hypot(*slip.by[:2]), float(np.degrees(slip.by[2]))
    return (
        f"the odometry slipped by {metres:.2f} m, {turn:.0f}° before {slip.stamp_ns * 1e-9:.2f} s"
    )


def driver_away(last: int) -> str:
    """Warn that a live robot waits for measurements after number `last`."""
    return (
        f"its driver is away after measurement {last}: start it again, or end the team by "
        "`teamslam end`"
    )
