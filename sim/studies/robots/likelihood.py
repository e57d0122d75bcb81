"""FastSLAM 1.0 with data association from the first detection without identity on."""

from typing import Any

import numpy as np

from teamslam.sim.studies.estimators import fastslam_ml
from teamslam.sim.studies.estimators.fastslam_ml import FastSlamMl
from teamslam.sim.studies.robots.filter import Filter, Step
from teamslam.team.config import UNNAMED, RobotConfig
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation


def with_association(plain: Filter) -> Filter:
    """Use identities until the first scan without, none later.

    Particles keep their poses; landmarks mapped by identity are dropped.
    """
    assert plain.particles is not None
    particles_of = plain.particles

    def filter_step(
        state: Any, config: RobotConfig, step: Step, generator: np.random.Generator
    ) -> Any:
        increment, ids, ranges, bearings, _ = step
        if not isinstance(state, FastSlamMl):
            if not (ids >= UNNAMED).any():
                return plain.filter_step(state, config, step, generator)
            particles = particles_of(state)
            state = fastslam_ml.initial_state(particles.poses, particles.log_weights)
        return fastslam_ml.filter_step(
            state=state,
            increment=increment,
            sensor=config.sensor,
            ranges=ranges,
            bearings=bearings,
            resample_below=config.front_end.resample_below,
            generator=generator,
        )

    def pose(state: Any) -> PoseGaussian:
        known = isinstance(state, FastSlamMl)
        return fastslam_ml.pose_gaussian(state) if known else plain.pose(state)

    def landmarks(state: Any) -> LandmarkGaussian:
        known = isinstance(state, FastSlamMl)
        return fastslam_ml.landmark_gaussian(state) if known else plain.landmarks(state)

    def innovation(state: Any, *step: Any) -> Innovation:
        return NOTHING if isinstance(state, FastSlamMl) else plain.innovation(state, *step)

    def particles(state: Any) -> Particles:
        known = isinstance(state, FastSlamMl)
        return fastslam.at_poses(state.poses) if known else particles_of(state)

    def took(state: Any) -> np.ndarray:
        known = isinstance(state, FastSlamMl)
        return fastslam_ml.slots_of_detections(state) if known else np.empty(0, np.int64)

    return plain._replace(
        filter_step=filter_step,
        pose=pose,
        landmarks=landmarks,
        innovation=innovation,
        particles=particles,
        took=took,
    )
