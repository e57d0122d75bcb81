"""Rule `batch`: the batch MAP over all robots' raw measurements."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from teamslam.sim.studies.batch_reference import growing as batch
from teamslam.sim.studies.batch_reference.graph import load_gtsam
from teamslam.sim.studies.batch_reference.growing import GrowingBatch, UnsolvableError
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.sim.studies.rules.measurement_rules import MapContent, MeasurementCentre
from teamslam.sim.studies.rules.team_keyframes import RobotKeyframe
from teamslam.team import translate
from teamslam.team.config import FrontEnd, RobotConfig
from teamslam.team.estimation.gaussian import Matrix, PoseGaussian
from teamslam.team.estimation.se2 import Pose, inverse
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing

RUNNING_ITERATIONS, RUNNING_DECREMENT = 5, 1e-2
"""Most iterations of a broadcast's map, and the Newton step in σ that ends them."""
FINAL_ITERATIONS, FINAL_DECREMENT = 200, 1e-5  # the same for the final map


class BatchCentre(MeasurementCentre):
    """All keyframes and landmarks, solved anew at each broadcast.

    Persistent errors and biases are treated as white noise, with a warning.
    """

    _batch: GrowingBatch

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        load_gtsam()
        self._waiting: list[RobotStep] = []
        self._newest: dict[str, RobotKeyframe] = {}
        self._stamps: dict[str, list[int]] = defaultdict(list)
        self._findings: list[str] = []

    @property
    def figures(self) -> Mapping[str, float]:
        """Number of poses, and cost of the last map."""
        if not self.models:
            return {}
        figures = {"poses": float(len(self._batch.poses))}
        if self._batch.dof > 0:
            figures["joint_cost_per_dof"] = self._batch.cost / self._batch.dof
        return figures

    @property
    def findings(self) -> tuple[str, ...]:
        """Errors treated as white, and missing convergence."""
        return tuple(self._findings)

    def _start(self, starts: Mapping[str, tuple[Pose, Matrix | None]]) -> None:
        self._batch = batch.initial_state(starts, self.config.batch_robust_c)
        self._findings += taken_as_white(self.models)

    def _take(self, step: Sequence[RobotKeyframe], turns: Sequence[RobotStep]) -> list[Outgoing]:
        self._waiting += turns
        for each in step:
            self._newest[each.robot] = each
            self._stamps[each.robot].append(each.stamp_ns)
        return []

    def _content(self, *, final: bool) -> MapContent:
        self._grow()
        if final:
            self._batch = self._solved(self._batch, FINAL_ITERATIONS, FINAL_DECREMENT)
            if not self._batch.converged(FINAL_DECREMENT):
                self._findings.append(
                    f"the batch has not converged in {FINAL_ITERATIONS} iterations: the next step "
                    f"goes {self._batch.newton_decrement:.2g} sigma, {FINAL_DECREMENT:g} allowed"
                )
        else:
            self._batch = self._solved(self._batch, RUNNING_ITERATIONS, RUNNING_DECREMENT)
        landmarks = batch.landmark_gaussian(self._batch)
        outgoing = (*self._poses(), *(self._paths() if final else ()))
        return MapContent(landmarks, self._batch.cost, self._batch.dof, outgoing)

    def _grow(self) -> None:
        turns, self._waiting = self._waiting, []
        blind = [turn.blind for turn in turns]
        for some in (turns, blind):
            with suppress(UnsolvableError, ArithmeticError), np.errstate(all="ignore"):
                grown = batch.add_steps(self._batch, some)
                _ = batch.solve(grown, 1, RUNNING_DECREMENT).marginals
                self._batch = grown
                return
            self._findings.append(
                f"measurements of {len(turns)} steps up to {self.now_ns * 1e-9:.1f} s refused: "
                "with them the map has no solution"
            )

    def _solved(self, grown: GrowingBatch, iterations: int, decrement: float) -> GrowingBatch:
        with suppress(UnsolvableError, ArithmeticError), np.errstate(all="ignore"):
            solution = batch.solve(grown, iterations, decrement)
            _ = solution.marginals
            return solution
        self._findings.append("the batch has no full solution")
        return grown

    def _poses(self) -> list[Outgoing]:
        outgoing = [
            self.pose(each, batch.pose_gaussian(self._batch, robot))
            for robot, each in sorted(self._newest.items())
            if self.pose_is_due(each)
        ]
        self._newest = {}
        return outgoing

    def _paths(self) -> list[Outgoing]:
        outgoing = []
        for robot, stamps in sorted(self._stamps.items()):
            poses, covariances = batch.trajectory(self._batch, robot)
            stamps = stamps[: len(poses) - 1]
            if not stamps:
                continue
            incarnation = self.members[robot].incarnation
            sensor = self.models[robot].sensor
            if sensor.is_mounted:
                away = inverse(np.array(sensor.mount))
                moved = [
                    PoseGaussian(*each).moved_by(away)
                    for each in zip(poses, covariances, strict=True)
                ]
                poses = np.array([each.mean for each in moved])
                covariances = np.array([each.covariance for each in moved])
            message = translate.trajectory_message(
                (robot, incarnation), self.set_digest, stamps, poses[1:], covariances[1:]
            )
            outgoing.append(Outgoing(ch.TRAJECTORY, robot, message))
        return outgoing


def taken_as_white(robots: Mapping[str, RobotConfig]) -> list[str]:
    """Persistent errors in the configuration, by robot."""
    declared = defaultdict(list)
    for name, config in sorted(robots.items()):
        sensor, biases = config.sensor, config.front_end.biases
        biases = () if biases == FrontEnd().biases else biases  # small by default
        shares = {"range_white": sensor.range_white, "bearing_white": sensor.bearing_white}
        lasting = [f"{each} = {share:g}" for each, share in shares.items() if share < 1.0]
        if lasting or biases:
            words = [*lasting, *([f"biases {', '.join(biases)}"] if biases else [])]
            declared["; ".join(words)].append(name)
    return [
        f"{', '.join(names)}: errors that persist ({words}) are taken as white, "
        "so the covariance is too small"
        for words, names in declared.items()
    ]
