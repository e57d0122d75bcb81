"""Mappers of comparison robots."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from teamslam.sim.studies.estimators.feedback import absorb_fused_map
from teamslam.sim.studies.robots.filters import (
    NOTHING_KNOWN,
    Estimates,
    KnownMap,
    RobotEstimator,
    estimator_of,
)
from teamslam.team import core, translate
from teamslam.team.config import RobotConfig
from teamslam.team.core import Scan
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam.pose_grid import TeammateScan
from teamslam.team.estimation.hybrid_slam.window import Innovation, RunningWindow
from teamslam.team.estimation.models import stream_bounds
from teamslam.team.pairs import FEEDBACK, NEEDS_MAP, PAIRS
from teamslam.team.rejection import BY_CORE, UNMEASURED, Rejection
from teamslam.team.robot.mapper import Mapper
from teamslam.team.robot.maps import InitialPose
from teamslam.team.wire import messages as m

JOINT_LANDMARKS = 2000  # landmarks beyond which a map has only 2 × 2 covariances


class ExchangingMapper(Mapper):
    """Hybrid-SLAM that sends its own map in exchanges, or to viewers.

    lockstep: the robot waits for answers. answered, awaited: last answered and last sent round.
    last_map: its sequence; −1: none.
    """

    joint = True

    def __init__(self, config: RobotConfig, *options: Any) -> None:
        super().__init__(config, *options)
        self._exchanges = PAIRS[config.estimator, config.fusion] == "own/map"
        self.lockstep = config.fusion in FEEDBACK
        self._map_ns: int | None = None
        self._sent_ns: int | None = None
        self.answered = self.awaited = 0
        self.last_map = -1

    def begin(self, start: m.InitialPose) -> None:
        """Begin an incarnation, whose maps are numbered from 0."""
        super().begin(start)
        self.last_map = -1

    @property
    def waits_for_answer(self) -> bool:
        """Whether a sent map has no answer yet."""
        return self.lockstep and self.awaited > self.answered

    def take_answer(self, round_: int) -> bool:
        """Record an answer; return whether it is new."""
        if not self.lockstep or round_ <= self.answered:
            return False
        self.answered = round_
        return True

    def is_map_due(self, start_ns: int, end_ns: int) -> bool:
        """Whether a map is due at the end of this window."""
        return self._exchanges or super().is_map_due(start_ns, end_ns)

    def publish_map(self, stamp_ns: int) -> None:
        """Publish the running map, for viewers or a due exchange."""
        self._map_ns = stamp_ns
        since = None if self._sent_ns is None else stamp_ns - self._sent_ns
        if not self._exchanges or since is None or since >= self.config.exchange_s * 1e9:
            self._send_map(stamp_ns)

    def publish_last_map(self) -> None:
        """Publish the stream's last map, unless an exchange had it."""
        if self._exchanges and self._map_ns is not None and self._map_ns != self._sent_ns:
            self._send_map(self._map_ns)

    def _send_map(self, stamp_ns: int) -> None:
        landmarks = self.own_landmarks()
        if self._exchanges:
            self._sent_ns, self.last_map = stamp_ns, self.sequence
            self.awaited = self.answered + 1 if self.lockstep else self.awaited
        form: Literal["joint", "blocks"] = "joint" if self.joint and self._exchanges else "blocks"
        if form == "joint" and len(landmarks.ids) > JOINT_LANDMARKS:
            form = "blocks"
            self.warnings.append("the own map is too large for a joint covariance")
        message = self.writer.own_map(stamp_ns, self.sequence, self.awaited, landmarks, form)
        self.out.append(message)

    @property
    def waits_for_map(self) -> bool:
        """Whether its known map is missing: never."""
        return False

    def know(self, message: m.KnownMap) -> None:
        """Ignore a known map."""

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the own map's landmarks by the fused ones."""
        self.own_map.whole = absorb_fused_map(self.own_map.whole, *landmarks)


class StreamMapper(ExchangingMapper):
    """Estimator with one state over a stream; no submaps."""

    def __init__(self, config: RobotConfig, *options: Any) -> None:
        self._known: KnownMap | None = None if config.estimator in NEEDS_MAP else NOTHING_KNOWN
        self._known_ns: int | None = None
        super().__init__(config, *options)

    def restart_estimator(self, incarnation: int, initial: InitialPose) -> None:
        """Make the estimator of an incarnation."""
        known = self._known or NOTHING_KNOWN
        self.estimator: RobotEstimator = estimator_of(self.config, incarnation, initial, known)
        self.ledger.used, self.joint = self.estimator.used, self.estimator.joint
        self._judge = core.StreamJudge(stream_bounds(self.config.bounds))

    def resume(self, start: m.InitialPose, submaps: Sequence[m.Submap]) -> None:
        """Raise ValueError: there are no submaps."""
        raise ValueError(f"the estimator {self.config.estimator} has no submaps to resume from")

    @property
    def waits_for_map(self) -> bool:
        """Whether its known map is missing."""
        return self._known is None

    def know(self, message: m.KnownMap) -> None:
        """Store the newest known map without far landmarks."""
        if self._known_ns is not None and message.stamp_ns <= self._known_ns:
            return
        self._known_ns = message.stamp_ns
        ids, landmarks = translate.landmarks_of(message)
        bound = self.config.bounds.coordinate_m
        inside = np.abs(landmarks).max(axis=1, initial=0.0) <= bound
        if not inside.all():
            self.warnings.append(f"{np.count_nonzero(~inside)} known landmarks beyond the bounds")
        self._known = KnownMap(ids[inside], landmarks[inside])

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the landmarks by the fused ones."""
        self.estimator.absorb(landmarks)

    def drive(self, measurement: m.AnyOdometry) -> bool:
        """Process an odometry interval."""
        interval = translate.interval_of(measurement, self.config)
        end_ns, estimates = interval.end_ns, None
        rejected: Rejection | None = Rejection.TIME
        if self.note_time(end_ns, end_ns):
            rejected = BY_CORE[self._judge.judge(interval)]
        if rejected in UNMEASURED:
            estimates = self.estimator.drive(interval, measured=rejected is None)
        self.account(measurement, rejected)
        if rejected in UNMEASURED:
            self.ledger.cover(end_ns)
        if estimates is not None:
            self._publish(estimates)
        return False

    def finish(self) -> bool:
        """End the incarnation: publish the last pose and map."""
        self.passed_ns = self.now_ns
        estimates, uncovered = self.estimator.finish()
        self._publish(estimates)
        self.ledger.leave_out(set())
        self.ledger.uncover(uncovered)
        return False

    def _publish(self, estimates: Estimates) -> None:
        writer, sequence = self.writer, self.sequence
        if estimates.pose_ns is not None:
            self.out += self.poses.publish(estimates.pose_ns, self)
        if estimates.judged is not None:
            judged, stamp_ns = estimates.judged
            self.out.append(writer.innovation(stamp_ns, sequence, judged))
        if estimates.map_ns is not None:
            if estimates.cloud is not None:
                self.out.append(writer.cloud(estimates.map_ns, estimates.cloud()))
            self.publish_map(estimates.map_ns)
        if estimates.became is not None:
            self.out.append(writer.association(sequence, self.now_ns, estimates.became))

    def account(self, measurement: m.Measurement, rejected: Rejection | None) -> None:
        """Account for the measurement in progress."""
        super().account(measurement, rejected)
        self.forget_window()

    @property
    def judge(self) -> core.StreamJudge:
        """Checks the stream's times."""
        return self._judge

    def repeat_window(self) -> None:
        """Repeat nothing: there is no window."""

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Process a scan; return the reason of a rejection."""
        beyond = BY_CORE[self._judge.judge_scan(stamp_ns, scan)]
        return beyond or self.estimator.observe(stamp_ns, scan)

    def sight(self, measurement: m.Sightings, looks: TeammateScan) -> Rejection | None:
        """Reject inter-robot measurements."""
        return Rejection.NO_TEAMMATES

    def fix(self, measurement: m.Fix) -> Rejection | None:
        """Reject absolute positions."""
        return Rejection.NO_TEAMMATES

    @property
    def associates(self) -> bool:
        """Whether the estimator accepts detections without identities."""
        return self.estimator.associates

    @property
    def sequence(self) -> int:
        """Number of the running pose and map."""
        return self.estimator.sequence

    @property
    def innovation(self) -> Innovation:
        """Innovation of all predicted measurements."""
        return self.estimator.innovation

    def own_pose(self, window: RunningWindow | None) -> PoseGaussian:
        """Running pose."""
        return self.estimator.own_pose()

    def own_landmarks(self) -> LandmarkGaussian:
        """Running map."""
        return self.estimator.own_map()

    def open_window(self) -> RunningWindow | None:
        """None: there is no window."""
        return None
