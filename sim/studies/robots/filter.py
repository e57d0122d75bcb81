"""The functions of which a recursive estimator over a state of its own consists."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sim.studies.robots.estimator import KnownMap
from team.config import RobotConfig, Sensor
from team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from team.estimation.hybrid_slam.fastslam import Particles
from team.estimation.hybrid_slam.innovation import Innovation
from team.estimation.models import Increment
from team.robot.own_map import InitialPose

IN_MAP = "in the running map"
IN_POSE = "in the running pose"
"""The dispositions of a measurement that such an estimator takes."""
Step = tuple[Increment, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""The motion since the last keyframe; landmark ids, ranges [m], bearings [rad] and the
measurements' own covariances (`team.estimation.scans`) at its end.
"""
InitialState = Callable[[RobotConfig, InitialPose, KnownMap, np.random.Generator], Any]
FilterStep = Callable[[Any, RobotConfig, Step, np.random.Generator], Any]
Judged = Callable[
    [Any, Increment, Sensor, np.ndarray, np.ndarray, np.ndarray, np.ndarray], Innovation
]


class Filter(NamedTuple):
    """A recursive estimator over a state of its own.

    looks: whether it takes landmarks; claims: whether it takes those with covariances of their own;
        maps: whether it has a map.
    joint: whether its map has covariances between landmarks.
    absorbed: the state with the given landmarks in the place of its own.
    particles: the particles of a state, for viewers.
    innovation: of a step's measurements, as the state before it predicts them.
    """

    initial_state: InitialState
    filter_step: FilterStep
    pose: Callable[[Any], PoseGaussian]
    landmarks: Callable[[Any], LandmarkGaussian]
    innovation: Judged
    absorbed: Callable[[Any, np.ndarray, np.ndarray, Matrix], Any] | None = None
    used: str = IN_MAP
    looks: bool = True
    claims: bool = False
    maps: bool = True
    joint: bool = True
    particles: Callable[[Any], Particles] | None = None
    took: Callable[[Any], np.ndarray] | None = None
