"""Rule `joint-fastslam`: multi-robot FastSLAM at the centre (Ma & Ma, section IV-D)."""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.sim.studies.estimators import joint_fastslam
from teamslam.sim.studies.estimators.joint_fastslam import JointFastSlam
from teamslam.sim.studies.estimators.robot_step import POSE_FLOOR, RobotStep, uncertain_start
from teamslam.sim.studies.rules.measurement_rules import MapContent, MeasurementCentre
from teamslam.sim.studies.rules.team_keyframes import RobotKeyframe
from teamslam.team.estimation.gaussian import Matrix, NotACovarianceError, PoseGaussian
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.estimation.se2 import Pose
from teamslam.team.wire.bus import Outgoing

RESAMPLE_BELOW = 1.0  # resamples at every step, as algorithm 1 does


class JointFastSlamCentre(MeasurementCentre):
    """One particle filter over all paths and one map, by FastSLAM 1.0."""

    _state: JointFastSlam

    def __init__(
        self, config: CentralConfig, robots: Sequence[str], *, admit: bool = False
    ) -> None:
        super().__init__(config, robots, admit=admit)
        self._generator = generator(0, "team", 0, 0)

    @property
    def figures(self) -> Mapping[str, float]:
        """The number of particles."""
        return {"particles": float(self.config.particles)}

    def _start(self, starts: Mapping[str, tuple[Pose, Matrix | None]]) -> None:
        first = self.models[min(self.models)]
        self._generator = generator(first.seed, "team", 0, 0)
        poses = {name: pose for name, (pose, _) in starts.items()}
        particles = self.config.particles
        self._state = joint_fastslam.initial_state(poses, particles, "fastslam1", RESAMPLE_BELOW)
        turns = [
            RobotStep(name, uncertain_start(pose, covariance), self.models[name].sensor)
            for name, (pose, covariance) in starts.items()
            if covariance is not None
        ]
        if turns:
            self._state = joint_fastslam.filter_step(self._state, turns, self._generator)

    def _take(self, step: Sequence[RobotKeyframe], turns: Sequence[RobotStep]) -> list[Outgoing]:
        blind = [turn.blind for turn in turns]
        for some in (turns, blind):  # if both fail the particles stay unchanged
            with suppress(NotACovarianceError, np.linalg.LinAlgError), np.errstate(all="ignore"):
                after = joint_fastslam.filter_step(self._state, some, self._generator)
                if np.isfinite(after.poses).all() and np.isfinite(after.log_weights).all():
                    self._state = after
                    break
            self.warnings.append("a step is refused: with it the particles have no weights")
        return [
            self.pose(each, self._pose_gaussian(each.robot))
            for each in step
            if self.pose_is_due(each)
        ]

    def _pose_gaussian(self, robot: str) -> PoseGaussian:
        mean, covariance = joint_fastslam.pose_gaussian(self._state, robot)
        return PoseGaussian(mean, covariance + POSE_FLOOR)

    def _content(self, *, final: bool) -> MapContent:
        return MapContent(joint_fastslam.landmark_gaussian(self._state))
