"""The estimators that keep one state over a whole stream, by name: functions of one shape each."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt32

from team import translate
from team.config import Estimator, RobotConfig
from team.estimation import hybrid_thesis
from team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.models import Increment

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
    absorbed: the state with these landmarks in place of its own.
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


FILTERS: Mapping[Estimator, Filter] = {
    "hybrid-thesis": Filter(
        _thesis_begun,
        _thesis_stepped,
        lambda state: PoseGaussian(state.pose, state.pose_covariance),
        _thesis_landmarks,
        _thesis_absorbed,
        joint=False,
    ),
}
