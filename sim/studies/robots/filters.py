"""Estimators with one state over a whole stream, by name, and their interface."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import msgspec
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
from teamslam.sim.studies.estimators.localisation import Localisation
from teamslam.sim.studies.estimators.plain_fastslam import PlainFastSlam
from teamslam.sim.studies.estimators.robot_step import RobotStep, innovation, uncertain_start
from teamslam.team.config import UNNAMED, Estimator, RobotConfig, Sensor
from teamslam.team.core import OdometryInterval, Scan
from teamslam.team.estimation.dense import diagonal_blocks
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian, Matrix, PoseGaussian
from teamslam.team.estimation.hybrid_slam import fastslam
from teamslam.team.estimation.hybrid_slam.fastslam import Particles, Proposal
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation
from teamslam.team.estimation.submap import Became
from teamslam.team.pairs import ESTIMATORS
from teamslam.team.registry import load
from teamslam.team.rejection import Rejection
from teamslam.team.robot.maps import AT_ORIGIN, Cloud, InitialPose
from teamslam.team.shapes import Float, UInt32


class KnownMap(NamedTuple):
    """Prior map: ids ascending, positions [m] in the team's frame."""

    ids: UInt32[np.ndarray, " L"]
    landmarks: Float[np.ndarray, "L 2"]


NOTHING_KNOWN = KnownMap(np.empty(0, np.uint32), np.empty((0, 2)))


class Estimates(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """Results of an odometry interval: stamps of a new pose and map.

    judged: the innovation since its last report, and its time. became: outcomes of detections
    without identities, at the end.
    """

    pose_ns: int | None = None
    map_ns: int | None = None
    cloud: Callable[[], Cloud] | None = None
    judged: tuple[Innovation, int] | None = None
    became: Became | None = None


NOTHING_NEW = Estimates()


@runtime_checkable
class RobotEstimator(Protocol):
    """Estimator on one incarnation.

    sequence: number of poses and maps. used: disposition of its measurements. joint: the map has a
    joint covariance. associates: accepts scans without identities, numbers from 2³¹ on.
    """

    @property
    def sequence(self) -> int: ...  # noqa: D102
    @property
    def used(self) -> str: ...  # noqa: D102
    @property
    def joint(self) -> bool: ...  # noqa: D102
    @property
    def associates(self) -> bool: ...  # noqa: D102
    @property
    def innovation(self) -> Innovation: ...  # noqa: D102

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Process a scan; return the reason of a rejection."""

    def drive(self, interval: OdometryInterval, *, measured: bool = True) -> Estimates:
        """Process one odometry interval, or only its duration (not measured)."""

    def finish(self) -> tuple[Estimates, int]:
        """End the stream; return the last results, and the number of unused scans."""

    def own_pose(self) -> PoseGaussian:
        """Running pose from own measurements alone."""

    def own_map(self) -> LandmarkGaussian:
        """Running map from own measurements and absorbed maps."""

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the own landmarks by the fused ones, for rules with feedback."""


Factory = Callable[[RobotConfig, int, InitialPose, KnownMap], RobotEstimator]


def estimator_of(
    config: RobotConfig,
    incarnation: int,
    initial: InitialPose = AT_ORIGIN,
    known: KnownMap = NOTHING_KNOWN,
) -> RobotEstimator:
    """Make the configured estimator of an incarnation."""
    made: Factory = load(ESTIMATORS[config.estimator].made_by, f"the estimator {config.estimator}")
    return made(config, incarnation, initial, known)


IN_MAP = "in the running map"
IN_POSE = "in the running pose"  # dispositions of a measurement that such an estimator uses
InitialState = Callable[[RobotConfig, InitialPose, KnownMap, np.random.Generator], Any]
FilterStep = Callable[[Any, RobotStep, np.random.Generator], Any]


class Filter(NamedTuple):
    """Recursive estimator over its own state.

    Steps take calibrated ranges and bearings. looks: accepts landmarks; claims: with covariances;
    maps: has a map; joint: with covariances between landmarks. absorbed: with these landmarks.
    particles: for viewers. innovation: of a step's measurements, predicted by the state before.
    """

    initial_state: InitialState
    filter_step: FilterStep
    pose: Callable[[Any], PoseGaussian]
    landmarks: Callable[[Any], LandmarkGaussian]
    innovation: Callable[[Any, RobotStep], Innovation]
    absorbed: Callable[[Any, np.ndarray, np.ndarray, Matrix], Any] | None = None
    used: str = IN_MAP
    looks: bool = True
    claims: bool = False
    maps: bool = True
    joint: bool = True
    particles: Callable[[Any], Particles] | None = None
    took: Callable[[Any], np.ndarray] | None = None


S = TypeVar("S")


def _with_association(plain: Filter) -> Filter:
    """Use identities until the first scan without; then drop landmarks mapped by identity."""

    def filter_step(
        state: PlainFastSlam | FastSlamMl, step: RobotStep, generator: np.random.Generator
    ) -> PlainFastSlam | FastSlamMl:
        if isinstance(state, PlainFastSlam):
            if not (step.ids >= UNNAMED).any():
                return plain_fastslam.filter_step(state, step, generator)
            poses, logs = state.particles.poses, state.particles.log_weights
            state = fastslam_ml.initial_state(poses, logs, state.resample_below)
        return fastslam_ml.filter_step(state, step, generator)

    def of_either(
        named: Callable[[Any], S], unnamed: Callable[[FastSlamMl], S]
    ) -> Callable[[Any], S]:
        return lambda state: (unnamed if isinstance(state, FastSlamMl) else named)(state)

    def innovation(state: PlainFastSlam | FastSlamMl, step: RobotStep) -> Innovation:
        return NOTHING if isinstance(state, FastSlamMl) else plain.innovation(state, step)

    assert plain.particles is not None
    return plain._replace(
        filter_step=filter_step,
        pose=of_either(plain.pose, fastslam_ml.pose_gaussian),
        landmarks=of_either(plain.landmarks, fastslam_ml.landmark_gaussian),
        innovation=innovation,
        particles=of_either(plain.particles, lambda state: fastslam.at_poses(state.poses)),
        took=of_either(lambda state: np.empty(0, np.int64), fastslam_ml.slots_of_detections),
    )


def _of_particles(particles: Callable[[Any], Particles]) -> Callable[[Any, RobotStep], Innovation]:
    return lambda state, step: innovation(particles(state), step)


def _started(
    make: Callable[[np.ndarray], S],
    advance: Callable[..., S],
    initial: InitialPose,
    *generator: np.random.Generator,
) -> S:
    at = np.zeros(3) if initial.pose is None else initial.pose
    if initial.covariance is None:
        return make(at)
    start = RobotStep("", uncertain_start(at, initial.covariance), Sensor())
    return advance(make(at), start, *generator)


def _exact(
    make: Callable[[np.ndarray], S], advance: Callable[[S, RobotStep], S]
) -> tuple[InitialState, FilterStep]:
    return (
        lambda config, initial, known, generator: _started(make, advance, initial),
        lambda state, step, generator: advance(state, step),
    )


def _at_pose(make: Callable[[np.ndarray, int], Any]) -> InitialState:
    return lambda config, initial, known, generator: make(
        np.zeros(3) if initial.pose is None else initial.pose, config.front_end.particles
    )


def _absorb(absorb_map: Callable[..., Any]) -> Callable[[Any, np.ndarray, np.ndarray, Matrix], Any]:
    return lambda state, ids, means, covariance: absorb_map(
        state, ids, means, diagonal_blocks(covariance)
    )


def _thesis_landmarks(state: hybrid_thesis.ThesisState) -> LandmarkGaussian:
    joint = np.zeros((2 * len(state.ids), 2 * len(state.ids)))
    for i, block in enumerate(state.covariances):
        joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    return LandmarkGaussian(state.ids, state.landmarks, joint)


def _plain(proposal: Proposal) -> Filter:
    def initial_state(
        config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
    ) -> PlainFastSlam:
        front = config.front_end

        def at(pose: np.ndarray) -> PlainFastSlam:
            return plain_fastslam.initial_state(
                pose, front.particles, proposal, front.resample_below
            )

        return _started(at, plain_fastslam.filter_step, initial, generator)

    return Filter(
        initial_state,
        plain_fastslam.filter_step,
        plain_fastslam.pose_gaussian,
        plain_fastslam.landmark_gaussian,
        _of_particles(lambda state: state.particles),
        particles=lambda state: state.particles,
        claims=True,
    )


def _localisation_initial_state(
    config: RobotConfig, initial: InitialPose, known: KnownMap, generator: np.random.Generator
) -> Localisation:
    """Draw a pose in the known map's box, widened by the sensor's reach, at most half its longer
    side.
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

    return _started(at, localisation.filter_step, initial, generator)


FILTERS: Mapping[Estimator, Filter] = {
    "dead-reckoning": Filter(
        *_exact(dead_reckoning.initial_state, dead_reckoning.filter_step),
        dead_reckoning.pose_gaussian,
        dead_reckoning.landmark_gaussian,
        lambda state, step: NOTHING,
        used=IN_POSE,
        looks=False,
        maps=False,
    ),
    "localisation": Filter(
        _localisation_initial_state,
        localisation.filter_step,
        localisation.pose_gaussian,
        lambda state: NO_LANDMARKS,  # its map was given, not estimated
        localisation.innovation,
        used=IN_POSE,
        maps=False,
    ),
    "ekf-slam": Filter(
        *_exact(nearest_neighbour.initial_state, nearest_neighbour.filter_step),
        lambda state: ekf_slam.pose_gaussian(state.slam),
        lambda state: ekf_slam.landmark_gaussian(state.slam),
        nearest_neighbour.innovation,
        took=lambda state: np.concatenate((np.empty(0, np.int64), *state.took)),
    ),
    "fastslam1": _with_association(_plain("fastslam1")),
    "fastslam2": _plain("fastslam2"),
    "hybrid-thesis": Filter(
        _at_pose(hybrid_thesis.initial_state),
        hybrid_thesis.filter_step,
        lambda state: PoseGaussian(state.pose, state.pose_covariance),
        _thesis_landmarks,
        _of_particles(lambda state: hybrid_thesis.reset(state, state.ids, 1)),
        _absorb(hybrid_thesis.absorb_map),
        joint=False,
    ),
    "hybrid-thesis-coded": Filter(
        _at_pose(hybrid_thesis_coded.initial_state),
        hybrid_thesis_coded.filter_step,
        hybrid_thesis_coded.pose_gaussian,
        hybrid_thesis_coded.landmark_gaussian,
        _of_particles(lambda state: state.particles),
        _absorb(hybrid_thesis_coded.absorb_map),
        joint=False,
    ),
}
