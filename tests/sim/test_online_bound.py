import msgspec
import numpy as np

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.estimation.consistency import chi2_interval
from tests.scenarios import with_world
from tests.trials.online_bound import bounds

SEEDS = range(2000, 2020)


def bounds_of(seed, believed=lambda scenario: scenario):
    scenario = with_options(load("thesis-b"), seed=seed)
    scenario = with_world(scenario, steps=60)
    return bounds(believed(scenario), streams_of(scenario))


def halved(scenario):
    sensors = [
        msgspec.structs.replace(r.sensor, bearing_sigma=0.5 * r.sensor.bearing_sigma)
        for r in scenario.robots
    ]
    motions = [
        msgspec.structs.replace(
            r.motion, turn=msgspec.structs.replace(r.motion.turn, per_s=0.5 * r.motion.turn.per_s)
        )
        for r in scenario.robots
    ]
    robots = tuple(
        msgspec.structs.replace(r, sensor=sensor, motion=motion)
        for r, sensor, motion in zip(scenario.robots, sensors, motions, strict=True)
    )
    return msgspec.structs.replace(scenario, robots=robots)


def nees(robot, believed=lambda scenario: scenario):
    found = [bounds_of(seed, believed)[robot] for seed in SEEDS]
    errors = np.array([each.errors[-1] for each in found])
    covariances = np.array([each.covariances[-1] for each in found])
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return float(np.sum(errors * solved)) / errors.size


def test_the_last_poses_lie_in_their_covariances_and_not_in_smaller_ones():
    low, high = chi2_interval(3, 0.999, len(SEEDS))
    assert low < nees("r1") < high
    assert nees("r1", halved) > high
