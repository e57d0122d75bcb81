"""Find robots whose bearings have the wrong sign, by the odometry, without truth and map.

Then b_j = D⁻¹ b_i of `clocks` holds for the reflected points where the robot turns. Turn rates of
the wrong sign look the same.
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
"""Least share of the deciding stretches that fit reflected: 11 of 12."""


def mirrored_cause(robot: str, timed: Timed, config: RobotConfig) -> m.Diagnosis | None:
    """Diagnose a robot whose measurements fit its odometry reflected, or None.

    A stretch decides if the χ² of its measured points less that of the reflected ones is beyond
    GATE; evidence is the mean of these. A pair counts GATE at most.
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
    """χ² that a reflection removes from each stretch of time."""
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
