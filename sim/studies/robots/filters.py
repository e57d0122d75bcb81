"""Estimators with one state over a whole stream, by name."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from teamslam.sim.studies.estimators import (
    dead_reckoning,
    ekf_slam,
    fastslam_ml,
    hybrid_thesis,
    hybrid_thesis_coded,
    localisation,
    nearest_neighbour,
    plain_fastslam,
)
from teamslam.sim.studies.estimators.fastslam_ml import FastSlamMl
from teamslam.sim.studies.estimators.hybrid_thesis_coded import CodedState
from teamslam.sim.studies.estimators.innovation import innovation
from teamslam.sim.studies.estimators.localisation import Localisation
from teamslam.sim.studies.estimators.plain_fastslam import PlainFastSlam
from teamslam.sim.studies.estimators.robot_step import uncertain_start
from teamslam.sim.studies.robots.estimator import (
    IN_POSE,
    Filter,
    FilterStep,
    InitialState,
    Judged,
    KnownMap,
    Step,
)
from teamslam.team import translate
from teamslam.team.config import UNNAMED, Estimator, RobotConfig, Sensor
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, Matrix, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation
from teamslam.team.robot.maps import InitialPose


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


def _random(filter_step: Callable[..., Any]) -> FilterStep:
    def step(state: Any, config: RobotConfig, step: Step, generator: np.random.Generator) -> Any:
        increment, *scan, _ = step
        return filter_step(state, increment, config.sensor, *scan, generator)

    return step


def _exact(
    initial_state: Callable[..., Any], filter_step: Callable[..., Any]
) -> tuple[InitialState, FilterStep]:
    def start(
        config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
    ) -> Any:
        return _with_start(initial_state, filter_step, initial)

    def step(state: Any, config: RobotConfig, step: Step, generator: np.random.Generator) -> Any:
        increment, *scan, _ = step
        return filter_step(state, increment, config.sensor, *scan)

    return start, step


def _thesis_initial_state(
    config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
) -> hybrid_thesis.ThesisState:
    return hybrid_thesis.initial_state(np.zeros(3) if initial.pose is None else initial.pose)


def _thesis_step(
    state: hybrid_thesis.ThesisState,
    config: RobotConfig,
    step: Step,
    generator: np.random.Generator,
) -> hybrid_thesis.ThesisState:
    increment, ids, ranges, bearings, _ = step
    count = config.front_end.particles
    return hybrid_thesis.filter_step(
        state, increment, config.sensor, ids, ranges, bearings, count, generator
    )


def _of_particles(particles: Callable[[Any], Particles]) -> Judged:
    return lambda state, *measurements: innovation(particles(state), *measurements)


def _without_claims(judged: Callable[..., Innovation]) -> Judged:
    return lambda state, *measurements: judged(state, *measurements[:-1])


def _thesis_landmarks(state: hybrid_thesis.ThesisState) -> LandmarkGaussian:
    joint = np.zeros((2 * len(state.ids), 2 * len(state.ids)))
    for i, block in enumerate(state.covariances):
        joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    return LandmarkGaussian(state.ids, state.landmarks, joint)


def _thesis_absorbed(
    state: hybrid_thesis.ThesisState, ids: np.ndarray, means: np.ndarray, covariance: Matrix
) -> hybrid_thesis.ThesisState:
    return hybrid_thesis.absorb_map(state, ids, means, translate.blocks_of(covariance))


def _coded_initial_state(
    config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
) -> CodedState:
    pose = np.zeros(3) if initial.pose is None else initial.pose
    return hybrid_thesis_coded.initial_state(pose, config.front_end.particles)


def _absorb_coded(
    state: CodedState, ids: np.ndarray, means: np.ndarray, covariance: Matrix
) -> CodedState:
    return hybrid_thesis_coded.absorb_map(state, ids, means, translate.blocks_of(covariance))


S = TypeVar("S")


def _with_start(
    initial_state: Callable[[np.ndarray], S],
    filter_step: Callable[..., S],
    initial: InitialPose,
    *generator: np.random.Generator,
) -> S:
    at = np.zeros(3) if initial.pose is None else initial.pose
    state = initial_state(at)
    if initial.covariance is None:
        return state
    still, nothing = uncertain_start(at, initial.covariance), np.empty(0)
    return filter_step(state, still, Sensor(), np.empty(0, np.uint32), nothing, nothing, *generator)


def _plain_step(
    state: PlainFastSlam, config: RobotConfig, step: Step, generator: np.random.Generator
) -> PlainFastSlam:
    increment, ids, ranges, bearings, own = step
    return plain_fastslam.filter_step(
        state, increment, config.sensor, ids, ranges, bearings, generator, own
    )


def _plain(proposal: Proposal) -> Filter:
    def initial_state(
        config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
    ) -> PlainFastSlam:
        front = config.front_end

        def at(pose: np.ndarray) -> PlainFastSlam:
            return plain_fastslam.initial_state(
                pose, front.particles, proposal, front.resample_below
            )

        return _with_start(at, plain_fastslam.filter_step, initial, generator)

    return Filter(
        initial_state,
        _plain_step,
        plain_fastslam.pose_gaussian,
        plain_fastslam.landmark_gaussian,
        _of_particles(lambda state: state.particles),
        particles=lambda state: state.particles,
        claims=True,
    )


def _localisation_initial_state(
    config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
) -> Localisation:
    """Draw an unknown initial pose in the known map's box, widened by the sensor's reach.

    The reach counts at most half the box's longer side.
    """
    front = config.front_end
    landmarks = known.landmarks
    if initial.pose is None and len(landmarks):
        lowest, highest = landmarks.min(axis=0), landmarks.max(axis=0)
        reach = min(config.sensor.max_range, 0.5 * float((highest - lowest).max()))
        state = localisation.initial_state_anywhere(
            lowest - reach, highest + reach, front.particles, *known, generator
        )
        return replace(state, resample_below=front.resample_below)

    def at(pose: np.ndarray) -> Localisation:
        state = localisation.initial_state(pose, front.particles, *known)
        return replace(state, resample_below=front.resample_below)

    return _with_start(at, localisation.filter_step, initial, generator)


FILTERS: Mapping[Estimator, Filter] = {
    "dead-reckoning": Filter(
        *_exact(dead_reckoning.initial_state, dead_reckoning.filter_step),
        dead_reckoning.pose_gaussian,
        dead_reckoning.landmark_gaussian,
        lambda *measurements: NOTHING,
        used=IN_POSE,
        looks=False,
        maps=False,
    ),
    "localisation": Filter(
        _localisation_initial_state,
        _random(localisation.filter_step),
        localisation.pose_gaussian,
        lambda state: NO_LANDMARKS,  # its map was given, not estimated
        _without_claims(localisation.innovation),
        used=IN_POSE,
        maps=False,
    ),
    "ekf-slam": Filter(
        *_exact(nearest_neighbour.initial_state, nearest_neighbour.filter_step),
        lambda state: ekf_slam.pose_gaussian(state.slam),
        lambda state: ekf_slam.landmark_gaussian(state.slam),
        _without_claims(nearest_neighbour.innovation),
        took=lambda state: np.concatenate((np.empty(0, np.int64), *state.took)),
    ),
    "fastslam1": with_association(_plain("fastslam1")),
    "fastslam2": _plain("fastslam2"),
    "hybrid-thesis": Filter(
        _thesis_initial_state,
        _thesis_step,
        lambda state: PoseGaussian(state.pose, state.pose_covariance),
        _thesis_landmarks,
        _of_particles(lambda state: hybrid_thesis.reset(state, state.ids, 1)),
        _thesis_absorbed,
        joint=False,
    ),
    "hybrid-thesis-coded": Filter(
        _coded_initial_state,
        _random(hybrid_thesis_coded.filter_step),
        hybrid_thesis_coded.pose_gaussian,
        hybrid_thesis_coded.landmark_gaussian,
        _of_particles(lambda state: state.particles),
        _absorb_coded,
        joint=False,
    ),
}
