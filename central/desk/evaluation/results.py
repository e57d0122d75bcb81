"""Results of a run: its map, its robots and its traffic, and figures of them by name.

A figure without its inputs is None. Metres and radians; NEES per degree of freedom, 1 if the
covariance is right.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from teamslam.central.desk.evaluation.association import AssociationResult
from teamslam.central.desk.evaluation.clocks import Late, clock_cause, is_refuted
from teamslam.central.desk.evaluation.errors import MapErrors, Path, PoseErrors
from teamslam.central.desk.evaluation.log import Traffic
from teamslam.central.desk.evaluation.matching import Gospa, Matching
from teamslam.central.desk.evaluation.peers import PeerResult
from teamslam.central.desk.evaluation.robot import Consumption
from teamslam.central.desk.evaluation.states import RobotState, not_in_the_map
from teamslam.central.desk.names import not_joined, short
from teamslam.central.diagnosis import describe
from teamslam.central.team_config import TeamConfig
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.shapes import Bool, Float, UInt32
from teamslam.team.wire import messages as m

USUAL = ("hybrid", "join")
"""Default estimator and rule."""


def figure(of: object, path: str) -> Any:
    """Value at a path of attributes such as `smoothed.coverage`; None behind a missing part."""
    for name in path.split("."):
        of = None if of is None else getattr(of, name)
    return of


@dataclass(frozen=True, kw_only=True)
class MapResult:
    """Final map: L landmarks by id and their joint covariance (blocks unless `joint`).

    truth: true positions, zero without truth; known: rows with truth; errors: of those.
    cost_per_dof: χ² of the join. covariance_scale: factor by which the submap covariances should be
    multiplied; None: unknown. withdrawn: robots left out. lost: incomplete robots. gospa: of all
    landmarks after truth_from_map. matching: how unnamed landmarks got true positions; None: by
    identity or label. changes: states of the landmarks against saved maps. diagnosis: causes of
    misfit, the best one first.
    """

    rule: str
    digest: str
    payload_sha256: str
    frame: str
    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    covariance: Matrix
    joint: bool
    truth: Float[np.ndarray, "L 2"]
    known: Bool[np.ndarray, " L"]
    errors: MapErrors | None
    cost_per_dof: float | None
    reasons: tuple[str, ...]
    joined: tuple[str, ...] = ()
    withdrawn: tuple[str, ...] = ()
    covariance_scale: float | None = None
    lost: tuple[str, ...] = ()
    gospa: Gospa | None = None
    matching: Matching | None = None
    changes: tuple[m.LandmarkChange, ...] = ()
    diagnosis: tuple[m.Diagnosis, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RobotResult:
    """One robot: its measurements, their dispositions, and its poses against the truth.

    smoothed: final map's poses at submap ends. online: poses published during the run, given the
    team map (`online_channel`: "team/pose"), or from own measurements if never in the team's frame.
    aligned_rmse_m, online_aligned_rmse_m: after the rigid motion that aligns the map (`alignment`:
    "map"), or without true landmarks all smoothed paths ("paths"), or without a map the robot's own
    path ("trajectory"). own_map: last own map, unaligned. outside: running poses are not in the
    team's frame, so there is no online path.
    """

    consumption: Consumption
    uplink_bytes: int | None
    truth: Path
    smoothed_path: Path
    smoothed: PoseErrors | None
    online_path: Path
    online: PoseErrors | None
    online_channel: str | None
    final_pose_nees_per_dof: float | None
    aligned_rmse_m: float | None
    alignment: str | None
    online_aligned_rmse_m: float | None
    own_map: MapErrors | None = None
    outside: bool = False

    @property
    def uplink_bytes_per_step(self) -> float | None:
        """Uplink bytes of the rule's channel per odometry interval."""
        steps = self.consumption.steps
        return None if self.uplink_bytes is None or not steps else self.uplink_bytes / steps


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A run: scenario (None: not in the log), map, robots and traffic.

    true_landmarks: all, measured or not. notes: remarks of the world, and messages set aside.
    faults: number of messages set aside. unsound: number of invalid samples. arbitrary_frame: no
    mapped robot has a known initial pose, so only aligned errors are meaningful. decisions:
    closures and merges by unnamed landmarks. verdicts: an operator's, as text. states: of every
    robot in the final map. data_set: folder or file name; empty for a simulated world.
    separate_times: of measurements that do not overlap, as text. mirrored, lateness: bearings of
    the wrong sign, and each robot's clock offset where it is determined, by the measurements alone.
    recorded_ns: wall time of the first message. truth_from_map: rigid motion that aligns the map's
    landmarks with the true ones, or where none is known the paths.
    """

    scenario: TeamConfig | None
    map: MapResult | None
    robots: Mapping[str, RobotResult]
    true_landmarks: Float[np.ndarray, "T 2"]
    channels: Mapping[str, Traffic]
    notes: tuple[str, ...]
    unsound: int
    cost_by_robot: Mapping[str, float]
    faults: int = 0
    scale_by_robot: Mapping[str, float] = field(default_factory=dict)
    arbitrary_frame: bool = False
    truth_from_map: Float[np.ndarray, "3"] | None = None
    peers: Mapping[str, PeerResult] = field(default_factory=dict)
    disagreement: tuple[str, ...] = ()
    association: AssociationResult | None = None
    decisions: tuple[m.AssociationDecision, ...] = ()
    verdicts: tuple[str, ...] = ()
    gps_median_m: float | None = None
    data_set: str = ""
    states: Mapping[str, RobotState] = field(default_factory=dict)
    separate_times: tuple[str, ...] = ()
    mirrored: tuple[m.Diagnosis, ...] = ()
    lateness: Mapping[str, Late] = field(default_factory=dict)
    recorded_ns: int | None = None

    @property
    def late(self) -> tuple[m.Diagnosis, ...]:
        """Clock offsets by the measurements alone, beyond doubt, of robots not mirrored."""
        out = {each.robot for each in self.mirrored}
        found = (clock_cause(robot, of) for robot, of in self.lateness.items() if robot not in out)
        return tuple(filter(None, found))

    @property
    def diagnosis(self) -> tuple[m.Diagnosis, ...]:
        """Causes of misfit: those of the map that the measurements alone do not exclude; mirrored
        robots, and late clocks that the map does not determine, by the measurements alone.

        Of a mirrored robot nothing else is a cause; nor of the team where all robots are mirrored.
        """
        of_map = () if self.map is None else self.map.diagnosis
        found = {each.robot for each in self.mirrored}
        of_all = found | {""} if found >= {*self.robots} else found
        own = [
            each
            for each in of_map
            if each.cause == "mirrored"
            or not (each.robot in of_all or is_refuted(each, self.lateness.get(each.robot)))
        ]
        named = {(each.cause, each.robot) for each in own}
        more = [each for each in self.mirrored if (each.cause, each.robot) not in named]
        late = [each for each in self.late if (each.cause, each.robot) not in named]
        return (*more, *own, *late)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for every command that shows the result: robots missing from the map, causes of
        misfit, the map's own warnings, times that do not overlap.
        """
        causes = map(describe, self.diagnosis)
        return (*not_in_the_map(self.states), *causes, *self.other_warnings)

    @property
    def other_warnings(self) -> tuple[str, ...]:
        """Warnings beside missing robots and causes of misfit."""
        reasons = () if self.map is None else self.map.reasons
        of_map = (short(each) for each in reasons if not any(not_joined([each])))
        lost = (f"{name} lost: {of.why}" for name, of in self.states.items() if of.state == "lost")
        return (*lost, *of_map, *self.separate_times)

    @property
    def title(self) -> str:
        """Data set name, or scenario and seed."""
        if self.scenario is None:
            return "a run whose scenario is not known"
        return self.data_set or f"{self.scenario.name}, seed {self.scenario.seed}"

    @property
    def method(self) -> str:
        """Estimator and rule; empty for the defaults."""
        if self.scenario is None:
            return ""
        chosen = self.scenario.estimator, self.scenario.fusion
        return "" if chosen == USUAL else " + ".join(chosen)

    @property
    def matched_by(self) -> str:
        """Method that matched unnamed landmarks to true ones; may be empty."""
        return "" if self.map is None or self.map.matching is None else str(self.map.matching)
