"""The estimators that keep one state over a whole stream, by name: functions of one shape each."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, UInt32

from team import translate
from team.config import Estimator, RobotConfig, Sensor
from team.estimation import (
    dead_reckoning,
    ekf_slam,
    hybrid_thesis,
    hybrid_thesis_coded,
    localisation,
    plain_fastslam,
)
from team.estimation.dead_reckoning import DeadReckoning
from team.estimation.ekf_slam import EkfSlam
from team.estimation.fastslam import Particles, Proposal
from team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.hybrid_thesis_coded import CodedState
from team.estimation.localisation import Localisation
from team.estimation.models import Increment
from team.estimation.plain_fastslam import PlainFastSlam

IN_MAP = "in the running map"
IN_POSE = "in the running pose"
"""The dispositions of a reading that such an estimator takes."""


class KnownMap(NamedTuple):
    """Landmarks that a robot is told: ids ascending, positions [m] in the team's frame."""

    ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"]


NOTHING_KNOWN = KnownMap(np.empty(0, np.uint32), np.empty((0, 2)))

Step = tuple[Increment, np.ndarray, np.ndarray, np.ndarray]
"""The motion since the last epoch; landmark ids, ranges [m] and bearings [rad] at its end."""
Begun = Callable[
    [RobotConfig, np.ndarray | None, Matrix | None, KnownMap, np.random.Generator], Any
]


class Filter(NamedTuple):
    """A recursive estimator over a state of its own.

    begun: the state at a start pose (None: unknown) with its covariance (None: exact). looks: it
    takes landmarks; maps: it has a map of its own. joint: with the covariance between landmarks.
    absorbed: the state with these landmarks in place of its own. particles: those of a state, for
    viewers.
    """

    begun: Begun
    stepped: Callable[[Any, RobotConfig, Step, np.random.Generator], Any]
    pose: Callable[[Any], PoseGaussian]
    landmarks: Callable[[Any], LandmarkGaussian]
    absorbed: Callable[[Any, np.ndarray, np.ndarray, Matrix], Any] | None = None
    used: str = IN_MAP
    looks: bool = True
    maps: bool = True
    joint: bool = True
    particles: Callable[[Any], Particles] | None = None


def _thesis_begun(
    config: RobotConfig,
    pose: np.ndarray | None,
    covariance: Matrix | None,
    known: KnownMap,
    generator: np.random.Generator,
) -> hybrid_thesis.ThesisState:
    """The thesis knows the start exactly."""
    return hybrid_thesis.started(np.zeros(3) if pose is None else pose)


def _thesis_stepped(
    state: hybrid_thesis.ThesisState,
    config: RobotConfig,
    step: Step,
    generator: np.random.Generator,
) -> hybrid_thesis.ThesisState:
    increment, ids, ranges, bearings = step
    return hybrid_thesis.stepped(
        state,
        increment,
        config.sensor,
        ids,
        ranges,
        bearings,
        config.front_end.particles,
        generator,
    )


def _thesis_landmarks(state: hybrid_thesis.ThesisState) -> LandmarkGaussian:
    joint = np.zeros((2 * len(state.ids), 2 * len(state.ids)))
    for i, block in enumerate(state.covariances):
        joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    return LandmarkGaussian(state.ids, state.landmarks, joint)


def _thesis_absorbed(
    state: hybrid_thesis.ThesisState, ids: np.ndarray, means: np.ndarray, covariance: Matrix
) -> hybrid_thesis.ThesisState:
    return hybrid_thesis.absorbed(state, ids, means, translate.blocks_of(covariance))


def _coded_begun(
    config: RobotConfig,
    pose: np.ndarray | None,
    covariance: Matrix | None,
    known: KnownMap,
    generator: np.random.Generator,
) -> CodedState:
    """The start is known exactly, as in the thesis."""
    start = np.zeros(3) if pose is None else pose
    return hybrid_thesis_coded.started(start, config.front_end.particles)


def _coded_stepped(
    state: CodedState, config: RobotConfig, step: Step, generator: np.random.Generator
) -> CodedState:
    increment, ids, ranges, bearings = step
    return hybrid_thesis_coded.stepped(
        state, increment, config.sensor, ids, ranges, bearings, generator
    )


def _coded_absorbed(
    state: CodedState, ids: np.ndarray, means: np.ndarray, covariance: Matrix
) -> CodedState:
    return hybrid_thesis_coded.absorbed(state, ids, means, translate.blocks_of(covariance))


S = TypeVar("S")


def _with_start(
    begun: Callable[[np.ndarray], S],
    stepped: Callable[..., S],
    pose: np.ndarray | None,
    covariance: Matrix | None,
    *generator: np.random.Generator,
) -> S:
    """The state at a start N(pose, covariance): a first motion by nothing, with that noise.

    The noise is turned into the pose's own axes: C = GᵀPG, G = blkdiag(R(θ), 1).
    """
    at = np.zeros(3) if pose is None else pose
    state = begun(at)
    if covariance is None:
        return state
    c, s = np.cos(at[2]), np.sin(at[2])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    own = G.T @ covariance @ G
    nothing = np.empty(0)
    start = Increment(np.zeros(3), 0.5 * (own + own.T))
    return stepped(state, start, Sensor(), np.empty(0, np.uint32), nothing, nothing, *generator)


def _dead_begun(
    config: RobotConfig,
    pose: np.ndarray | None,
    covariance: Matrix | None,
    known: KnownMap,
    generator: np.random.Generator,
) -> DeadReckoning:
    return _with_start(dead_reckoning.begun, dead_reckoning.stepped, pose, covariance)


def _dead_stepped(
    state: DeadReckoning, config: RobotConfig, step: Step, generator: np.random.Generator
) -> DeadReckoning:
    increment, ids, ranges, bearings = step
    return dead_reckoning.stepped(state, increment, config.sensor, ids, ranges, bearings)


def _ekf_begun(
    config: RobotConfig,
    pose: np.ndarray | None,
    covariance: Matrix | None,
    known: KnownMap,
    generator: np.random.Generator,
) -> EkfSlam:
    return _with_start(ekf_slam.begun, ekf_slam.stepped, pose, covariance)


def _ekf_stepped(
    state: EkfSlam, config: RobotConfig, step: Step, generator: np.random.Generator
) -> EkfSlam:
    increment, ids, ranges, bearings = step
    return ekf_slam.stepped(state, increment, config.sensor, ids, ranges, bearings)


def _plain(proposal: Proposal) -> Filter:
    """FastSLAM over the whole stream, whatever the front end's own proposal is."""

    def begun(
        config: RobotConfig,
        pose: np.ndarray | None,
        covariance: Matrix | None,
        known: KnownMap,
        generator: np.random.Generator,
    ) -> PlainFastSlam:
        front = config.front_end

        def at(start: np.ndarray) -> PlainFastSlam:
            return plain_fastslam.begun(start, front.particles, proposal, front.resample_below)

        return _with_start(at, plain_fastslam.stepped, pose, covariance, generator)

    def stepped(
        state: PlainFastSlam, config: RobotConfig, step: Step, generator: np.random.Generator
    ) -> PlainFastSlam:
        increment, ids, ranges, bearings = step
        return plain_fastslam.stepped(
            state, increment, config.sensor, ids, ranges, bearings, generator
        )

    return Filter(
        begun,
        stepped,
        plain_fastslam.pose_gaussian,
        plain_fastslam.landmark_gaussian,
        particles=lambda state: state.particles,
    )


def _localisation_begun(
    config: RobotConfig,
    pose: np.ndarray | None,
    covariance: Matrix | None,
    known: KnownMap,
    generator: np.random.Generator,
) -> Localisation:
    """At an unknown start anywhere from where the sensor may see a landmark of the known map.

    That is the map's box widened by the sensor's reach, at most by half the box's longer side.
    """
    front, landmarks = config.front_end, known.landmarks
    if pose is None and len(landmarks):
        lowest, highest = landmarks.min(axis=0), landmarks.max(axis=0)
        reach = min(config.sensor.max_range, 0.5 * float((highest - lowest).max()))
        state = localisation.begun_anywhere(
            lowest - reach, highest + reach, front.particles, *known, generator
        )
        return replace(state, resample_below=front.resample_below)

    def at(start: np.ndarray) -> Localisation:
        state = localisation.begun(start, front.particles, *known)
        return replace(state, resample_below=front.resample_below)

    return _with_start(at, localisation.stepped, pose, covariance, generator)


def _localisation_stepped(
    state: Localisation, config: RobotConfig, step: Step, generator: np.random.Generator
) -> Localisation:
    increment, ids, ranges, bearings = step
    return localisation.stepped(state, increment, config.sensor, ids, ranges, bearings, generator)


FILTERS: Mapping[Estimator, Filter] = {
    "dead-reckoning": Filter(
        _dead_begun,
        _dead_stepped,
        dead_reckoning.pose_gaussian,
        dead_reckoning.landmark_gaussian,
        used=IN_POSE,
        looks=False,
        maps=False,
    ),
    "localisation": Filter(
        _localisation_begun,
        _localisation_stepped,
        localisation.pose_gaussian,
        lambda state: NO_LANDMARKS,  # it was told its map, so there is nothing to say of one
        used=IN_POSE,
        maps=False,
    ),
    "ekf-slam": Filter(
        _ekf_begun, _ekf_stepped, ekf_slam.pose_gaussian, ekf_slam.landmark_gaussian
    ),
    "fastslam1": _plain("fastslam1"),
    "fastslam2": _plain("fastslam2"),
    "hybrid-thesis": Filter(
        _thesis_begun,
        _thesis_stepped,
        lambda state: PoseGaussian(state.pose, state.pose_covariance),
        _thesis_landmarks,
        _thesis_absorbed,
        joint=False,
    ),
    "hybrid-thesis-coded": Filter(
        _coded_begun,
        _coded_stepped,
        hybrid_thesis_coded.pose_gaussian,
        hybrid_thesis_coded.landmark_gaussian,
        _coded_absorbed,
        joint=False,
    ),
}
