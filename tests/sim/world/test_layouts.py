"""Layouts of landmarks that are hard to tell apart."""

import numpy as np

from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulated
from teamslam.team.config import RobotConfig

ROBOT = RobotConfig("r1")


def landmarks(**fields) -> np.ndarray:
    world = SimulatedWorld(steps=1, size_m=30.0, **fields)
    found = simulated(world, (ROBOT,), 3).landmarks
    assert found is not None
    return found


def test_of_twins_each_has_another_one_beside_it():
    at = landmarks(landmark_count=12, layout="twins", twin_m=0.7)
    away = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    assert len(at) == 12
    assert np.allclose(np.diag(away[:6, 6:]), 0.7)
    assert (away.min(axis=1) <= 0.7 + 1e-9).all()


def test_rooms_are_all_alike():
    at = landmarks(landmark_count=27, layout="rooms", rooms=3).reshape(9, 3, 2)
    corners = np.round((at - at[0]).mean(axis=1), 9)
    assert (at - corners[:, None] - at[0] < 1e-9).all()
    assert sorted(map(tuple, corners.tolist())) == [
        (10.0 * i, 10.0 * j) for i in range(3) for j in range(3)
    ]
