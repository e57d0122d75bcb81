"""A window's NIS: the innovations of its measurements, per degree of freedom.

The mutants have another sensor or motion model than the simulation.
"""

import numpy as np
import pytest

from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.estimation.consistency import chi2_interval
from tests.estimation.hybrid_slam.test_window import ACCURATE, COARSE, STEP_M, drive, driven


def per_dof(sensor, runs=200, told=None, **options):
    """The mean over seeded windows, and the 99.9 % interval that it lies in if all is right."""
    found = [
        driven(drive(s, sensor, steps=6), told or sensor, seed=s, **options) for s in range(runs)
    ]
    squared, dof = (sum(w.innovation[k] for w in found) for k in (0, 1))
    low, high = chi2_interval(dof, 0.999, 1)
    return low, squared / dof, high


@pytest.mark.parametrize(
    ("sensor", "proposal"),
    [(COARSE, "fastslam2"), (ACCURATE, "fastslam2"), (ACCURATE, "fastslam1")],
)
def test_right_models_have_an_innovation_of_one_per_degree_of_freedom(sensor, proposal):
    low, found, high = per_dof(sensor, proposal=proposal)
    assert low < found < high


def scaled(sensor, factor):
    return Sensor(
        range_sigma=factor * sensor.range_sigma, bearing_sigma=factor * sensor.bearing_sigma
    )


SLUGGISH = MotionModel(
    kind="turn-then-drive",
    forward=MotionNoise(per_s=0.5 * STEP_M),
    turn=MotionNoise(per_s=0.5 * np.deg2rad(3.0)),
)


@pytest.mark.parametrize(
    ("wrong", "above"),
    [
        ({"told": scaled(ACCURATE, 0.9)}, True),
        ({"told": scaled(ACCURATE, 1.1)}, False),
        ({"motion": SLUGGISH}, True),
        ({"twice": True}, False),
    ],
    ids=["sensor noise too small", "too large", "motion noise too small", "each measurement twice"],
)
def test_wrong_models_have_another(wrong, above):
    low, found, high = per_dof(ACCURATE, **wrong)
    assert found > high if above else found < low
