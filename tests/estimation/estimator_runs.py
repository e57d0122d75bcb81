"""Runs of single estimators in the thesis' world: one keyframe a step."""

import functools
from typing import NamedTuple

import numpy as np

from teamslam.sim.scenarios import scenario
from teamslam.sim.world.simulator import simulate
from teamslam.team.estimation.models import Increment, corrected, increment_of


class Keyframe(NamedTuple):
    increment: Increment
    ids: np.ndarray
    ranges: np.ndarray
    bearings: np.ndarray


@functools.cache
def world(name, seed):
    """(robots, streams) of a built-in scenario."""
    loaded = scenario.load(name)
    return loaded.robots, simulate(loaded.world, loaded.robots, seed)


def keyframes_of(config, stream):
    told, seen = stream.intervals, stream.landmark_detections
    np.testing.assert_array_equal(told.end_ns, seen.stamps_ns)
    keyframes = []
    for k in range(len(told.end_ns)):
        step = told.duration_ns[k] * 1e-9, told.forward[k], told.yaw_rate[k]
        increment = increment_of(config.motion, *map(float, step))
        rows = seen.rows(k)
        measurements = corrected(config.sensor, seen.ranges[rows], seen.bearings[rows])
        keyframes.append(Keyframe(increment, seen.ids[rows], *measurements))
    return keyframes


def run(state, step, keyframes, config, *generator):
    for increment, *measurements in keyframes:
        state = step(state, increment, config.sensor, *measurements, *generator)
    return state


def map_errors(landmarks, streams):
    """Flat errors [m] of the estimated landmarks (id k is the k-th true one)."""
    return (landmarks.means - streams.landmarks[landmarks.ids.astype(int) - 1]).ravel()
