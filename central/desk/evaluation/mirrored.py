"""Find robots whose bearings have the wrong sign, by the odometry, without truth and map.

A landmark measured twice within two seconds is at b_i, b_j in the base frame, with b_j = D⁻¹ b_i by
the odometry's motion D (see `clocks`). With bearings of the wrong sign that holds for the reflected
points, not for the measured ones, where the robot turns. This is all that shows a fault of a robot
alone: its submaps follow the mirrored landmarks, and agree with each other. Turn rates of the wrong
sign look the same.
"""

import math
from array import array
from dataclasses import replace

import numpy as np

from teamslam.central.desk.evaluation.clocks import (
    LEAST_STRETCHES,
    Timed,
    pairs_of,
)
from teamslam.central.diagnosis import MIRRORED_REMEDY
from teamslam.team.config import GATE, RobotConfig
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m

MIRRORED = 0.9
"""Least share of the stretches that fit reflected, of those that decide: 11 of 12, which chance
reaches three times in a thousand where neither fits.
"""


def mirrored_cause(robot: str, timed: Timed, config: RobotConfig) -> m.Diagnosis | None:
    """Make the cause of a robot whose measurements fit its odometry reflected, or None.

    A stretch of time decides by the χ² of its measured points less that of the reflected ones,
    where that is beyond GATE; evidence is the mean of these. The unit is the smaller median, and a
    pair counts GATE at most.
    """
    gains = _gains(timed, config)
    deciding = gains[np.abs(gains) > GATE]
    right = int((deciding > 0.0).sum())
    if len(deciding) < LEAST_STRETCHES or right < MIRRORED * len(deciding):
        return None
    return m.Diagnosis(
        cause="mirrored",
        robot=robot,
        value=(-1.0,),
        sigma=(0.0,),
        evidence=float(deciding.mean()),
        remedy=MIRRORED_REMEDY,
    )


def _gains(timed: Timed, config: RobotConfig) -> Float[np.ndarray, " n"]:
    """Evaluate the χ² that a reflection removes from each stretch of time."""
    none = np.zeros(0)
    if not timed.ends_ns or not timed.ids:
        return none
    seen = np.array(timed.seen).reshape(-1, 2) * (1.0, -1.0)
    with np.errstate(all="ignore"):
        own = pairs_of(timed, config)
        other = pairs_of(replace(timed, seen=array("d", seen.ravel().tolist())), config)
        if own is None or other is None:
            return none
        unit = min(float(np.median(each.gaps)) for each in (own, other))
        chi2, reflected = (
            np.minimum(2.0 * math.log(2.0) * (each.gaps / unit) ** 2, GATE) for each in (own, other)
        )
        sums = np.bincount(own.stretch, chi2 - reflected)
    return sums if np.isfinite(sums).all() else none
