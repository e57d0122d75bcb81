"""A team of two that drives circles among four landmarks, with its models' own noise."""

import numpy as np

from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import Sensor
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import compose, exponential
from tests.estimation.submap_world import wrap

SENSOR = Sensor(range_sigma=0.1, bearing_sigma=0.01)
OTHER = Sensor(range_sigma=0.3, bearing_sigma=0.005)
MOTION = Increment(np.array([0.5, 0.0, 0.15]), np.diag([0.03, 0.02, 0.01]) ** 2)
LANDMARKS = np.array([[6.0, 1.0], [-3.0, 5.0], [0.0, -7.0], [4.0, 8.0]])
STARTS = {"r1": np.array([0.5, -1.0, 0.0]), "r2": np.array([1.0, 3.0, -2.0])}


def team_run(seed, starts=STARTS, steps=8, seen=None):
    random = np.random.default_rng(seed)
    truth, rounds = dict(starts), []
    for _ in range(steps):
        turns = []
        for robot, sensor in zip(starts, (SENSOR, OTHER), strict=False):
            xi = np.array([0.03, 0.02, 0.01]) * random.standard_normal(3)
            truth[robot] = compose(compose(truth[robot], MOTION.mean), exponential(xi))
            d = LANDMARKS - truth[robot][:2]
            ranges = np.hypot(*d.T)
            near = np.flatnonzero(ranges > 1.5)
            if seen is not None:
                near = np.intersect1d(near, seen[robot])
            ranges = ranges[near] + sensor.range_sigma * random.standard_normal(len(near))
            bearings = np.arctan2(d[near, 1], d[near, 0]) - truth[robot][2]
            bearings = wrap(bearings + sensor.bearing_sigma * random.standard_normal(len(near)))
            turns.append(RobotStep(robot, MOTION, sensor, near.astype(np.uint32), ranges, bearings))
        rounds.append(turns)
    return rounds, truth
