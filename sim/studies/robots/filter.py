"""The functions of a recursive estimator over its own state."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from teamslam.sim.studies.robots.estimator import KnownMap
from teamslam.team.config import RobotConfig, Sensor
from teamslam.team.estimation.gaussian import LandmarkGaussian, Matrix, PoseGaussian
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.models import Increment
from teamslam.team.robot.maps import InitialPose

IN_MAP = "in the running map"
IN_POSE = "in the running pose"
"""Dispositions of a measurement that such an estimator uses."""
Step = tuple[Increment, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Motion since the last keyframe; landmark ids, ranges [m], bearings [rad] and own covariances
(`teamslam.team.estimation.scans`) at its end.
"""
InitialState = Callable[[RobotConfig, InitialPose, KnownMap, np.random.Generator], Any]
FilterStep = Callable[[Any, RobotConfig, Step, np.random.Generator], Any]
Judged = Callable[
    [Any, Increment, Sensor, np.ndarray, np.ndarray, np.ndarray, np.ndarray], Innovation
]


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
    innovation: Judged
    absorbed: Callable[[Any, np.ndarray, np.ndarray, Matrix], Any] | None = None
    used: str = IN_MAP
    looks: bool = True
    claims: bool = False
    maps: bool = True
    joint: bool = True
    particles: Callable[[Any], Particles] | None = None
    took: Callable[[Any], np.ndarray] | None = None
