"""Results of a run in metres and radians; a figure without its inputs is None."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from teamslam.central.config import TeamConfig
from teamslam.central.desk.evaluation.association import AssociationResult
from teamslam.central.desk.evaluation.clocks import Late, clock_cause, is_refuted
from teamslam.central.desk.evaluation.errors import MapErrors, Path, PoseErrors
from teamslam.central.desk.evaluation.log import Traffic
from teamslam.central.desk.evaluation.matching import Gospa, Matching
from teamslam.central.desk.evaluation.states import (
    NO_LANDMARK,
    SAVED_MAP,
    RobotState,
    not_in_the_map,
)
from teamslam.central.desk.left_out import Span
from teamslam.central.desk.names import not_joined, short
from teamslam.central.diagnosis import contradicts, describe
from teamslam.central.saved_maps import COUNTED_TWICE
from teamslam.team.config import MAP
from teamslam.team.estimation.gaussian import Matrix
from teamslam.team.estimation.map_joining.saved_maps import REMEDY
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Bool, Float, UInt32
from teamslam.team.wire import messages as m

REJECTED = "rejected: "  # prefix of a rejected measurement's disposition
USUAL = ("hybrid", "join")  # default estimator and rule


def figure(of: object, path: str) -> Any:
    """Value at a path of attributes such as `smoothed.coverage`, or None."""
    for name in path.split("."):
        of = None if of is None else getattr(of, name)
    return of


@dataclass(frozen=True)
class Consumption:
    """Dispositions of the measurements on a robot's sensor channels.

    steps: odometry intervals. consumed, ledger: from the robot's `Done`. each_once: no measurement
    is in two submaps, and the ledger sums to consumed. gated: detections rejected as outliers.
    """

    steps: int
    published: int
    consumed: int | None
    submaps: int
    ledger: Mapping[str, int]
    each_once: bool | None
    gated: int = 0

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected measurements by reason, most frequent first."""
        found = [
            (count, disposition.removeprefix(REJECTED))
            for disposition, count in self.ledger.items()
            if disposition.startswith(REJECTED) and count
        ]
        return {reason: count for count, reason in sorted(found, key=lambda each: -each[0])}

    @property
    def used(self) -> int | None:
        """Measurements in the map, or used as initial pose."""
        if not self.ledger:
            return None
        return sum(self.ledger.values()) - sum(self.rejected.values())

    @property
    def open(self) -> int | None:
        """Published measurements neither used nor rejected."""
        return None if self.consumed is None else self.published - self.consumed

    @property
    def not_used(self) -> str:
        """Describe rejected and open measurements."""
        parts = [f"{count} rejected ({reason})" for reason, count in self.rejected.items()]
        return ", ".join([*parts, f"{self.open} open"] if self.open else parts)


@dataclass(frozen=True, kw_only=True)
class PeerResult:
    """Announced conclusion of one peer.

    complete_at_s: wall time from log start. have: submaps by robot. over: new members by relaying
    node. agrees_with: number of peers with the same set.
    """

    final_map_sha256: str | None
    submaps: int
    complete_at_s: float | None
    uplink_bytes: int | None
    downlink_bytes: int | None
    agrees_with: int
    have: Mapping[str, int] = field(default_factory=dict)
    over: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class MapResult:
    """Final map: L landmarks by id and their covariance (blocks unless `joint`).

    truth: true positions, zero unless `known`. covariance_scale: factor for submap covariances.
    changes: against saved maps. diagnosis: causes of misfit, best first.
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
    covariance_scale: float | None = None
    gospa: Gospa | None = None
    matching: Matching | None = None
    changes: tuple[m.LandmarkChange, ...] = ()
    diagnosis: tuple[m.Diagnosis, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RobotResult:
    """One robot: dispositions of its measurements, and its poses against the truth.

    smoothed: at submap ends, from the final map. aligned: after the rigid motion that aligns the
    map (`alignment`: "map"), or all smoothed paths ("paths"), or its own path ("trajectory").
    own_map: unaligned. outside: running poses are not in the team's frame.
    left_out: spans without smoothed poses (`desk.left_out`).
    """

    consumption: Consumption
    uplink_bytes: int | None
    truth: Path
    smoothed_path: Path
    smoothed: PoseErrors | None
    online_path: Path
    online: PoseErrors | None
    online_channel: str | None
    aligned_rmse_m: float | None = None
    alignment: str | None = None
    online_aligned_rmse_m: float | None = None
    own_map: MapErrors | None = None
    outside: bool = False
    left_out: tuple[Span, ...] = ()

    @property
    def final_pose_nees_per_dof(self) -> float | None:
        """NEES of the last smoothed pose, if it has truth."""
        if self.smoothed is None or self.smoothed.stamps_ns[-1] != self.smoothed_path.stamps_ns[-1]:
            return None
        return float(self.smoothed.nees[-1]) / 3.0

    @property
    def uplink_bytes_per_step(self) -> float | None:
        """Uplink bytes per odometry interval."""
        steps = self.consumption.steps
        return None if self.uplink_bytes is None or not steps else self.uplink_bytes / steps


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A run: scenario, map, robots and traffic.

    notes: remarks of the world, and messages set aside (number: faults). arbitrary_frame: only
    aligned errors are meaningful. mirrored, lateness: by the measurements alone. recorded_ns: wall
    time of the first message.
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
    truth_from_map: Pose | None = None
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
        """Significant clock offsets."""
        out = {each.robot for each in self.mirrored}
        found = (clock_cause(robot, of) for robot, of in self.lateness.items() if robot not in out)
        return tuple(filter(None, found))

    @property
    def diagnosis(self) -> tuple[m.Diagnosis, ...]:
        """Causes of misfit of the map that the measurements do not exclude, and of these alone.

        A mirrored robot has no other cause, nor has a team whose robots are all mirrored.
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
        """Warnings for every command that shows the result."""
        causes = map(describe, self.diagnosis)
        return (*self.missing, *causes, *self.other_warnings)

    @property
    def missing(self) -> tuple[str, ...]:
        """Robots missing from the final map, and all landmarks."""
        is_empty = self.map is not None and not len(self.map.ids)
        return (*not_in_the_map(self.states), *[NO_LANDMARK] * is_empty)

    @property
    def failures(self) -> tuple[str, ...]:
        """Missing robots, and wrong measurements in the map: twice, mirrored, or contradicting."""
        of_map = () if self.map is None else self.map.diagnosis
        if not any(contradicts(each) and not each.robot for each in of_map):
            return (*self.missing, *self._repetitions, *self._mirrored_in_the_map)
        causes = "; ".join(map(describe, self.diagnosis))
        return (
            *self.missing,
            *self._repetitions,
            "the measurements contradict each other far beyond the stated noise, so the map is not "
            f"to be used: {causes}",
        )

    @property
    def _mirrored_in_the_map(self) -> tuple[str, ...]:
        inside = {name for name, of in self.states.items() if of.state in {"joined", "alone"}}
        return tuple(
            f"the map is not to be used: {describe(each)}"
            for each in self.diagnosis
            if each.cause == "mirrored" and each.robot in inside
        )

    @property
    def _repetitions(self) -> tuple[str, ...]:
        """Robots whose measurements a saved map contains already, unless they are localised."""
        reasons = () if self.map is None else self.map.reasons
        localised = self.scenario is not None and self.scenario.central.localise
        return tuple(each for each in reasons if not localised and each.endswith(COUNTED_TWICE))

    @property
    def other_warnings(self) -> tuple[str, ...]:
        """Warnings beside missing robots and causes of misfit."""
        reasons = () if self.map is None else self.map.reasons
        of_map = (short(each) for each in reasons if not any(not_joined([each])))
        lost = (f"{name} lost: {of.why}" for name, of in self.states.items() if of.state == "lost")
        return (*lost, *self.refused_maps, *of_map, *self.separate_times)

    @property
    def refused_maps(self) -> tuple[str, ...]:
        """Warnings of saved maps that are not in the team's, with remedy."""
        return tuple(
            f"{SAVED_MAP}{name.removeprefix(MAP)} is not in the team's map: "
            + (of.why if REMEDY in of.why else f"{of.why}: {REMEDY}")
            for name, of in self.states.items()
            if name.startswith(MAP)
            and of.state in {"not joined", "withdrawn"}
            and not of.why.startswith("by operator")
        )

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
        """Method that matched unnamed landmarks."""
        return "" if self.map is None or self.map.matching is None else str(self.map.matching)
