"""Runs of single estimators in the thesis' world: the simulator's streams cut into epochs."""

import functools

import numpy as np

from sim import scenario
from sim.simulator import simulated
from sim.streams import OBSERVATIONS, ODOMETRY
from team.robot.segmenter import Segmenter


@functools.cache
def world(name, seed):
    """(robots, streams) of a built-in scenario."""
    loaded = scenario.load(name)
    return loaded.robots, simulated(loaded.world, loaded.robots, seed)


def epochs_of(config, stream):
    """The stream's epochs as the robot's own segmenter cuts them."""
    segmenter = Segmenter(config.motion, config.sensor, config.front_end.keyframe_s)
    segmenter.begin(0)
    epochs = []
    for counter in range(len(stream)):
        if stream.kinds[counter] == OBSERVATIONS:
            segmenter.observe(*stream.observations(counter))
        elif stream.kinds[counter] == ODOMETRY:
            epochs += segmenter.drive(*stream.odometry(counter))
    return epochs


def run(state, step, epochs, config, *generator):
    for epoch in epochs:
        state = step(
            state,
            epoch.increment,
            config.sensor,
            epoch.ids,
            epoch.ranges,
            epoch.bearings,
            *generator,
        )
    return state


def map_errors(landmarks, streams):
    """Flat errors of the estimated landmarks (id k is the k-th true one), m."""
    return (landmarks.means - streams.landmarks[landmarks.ids.astype(int) - 1]).ravel()


def truth_at_end(stream):
    return np.array(stream.truth[-1])
