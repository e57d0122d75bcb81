"""The robot's mapper, from ordered measurements to messages.

    bounds → Hybrid-SLAM → ledger → submap → own map → poses
    check    estimate      account   publish

Law 1: messages for fusion depend on the robot's own measurements alone. The team's map
serves `team/pose` only.
"""

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from teamslam.team import core, translate
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.core import Scan
from teamslam.team.door import EARLY_NS, LATE_NS
from teamslam.team.estimation.gaussian import LandmarkGaussian, PoseGaussian
from teamslam.team.estimation.hybrid_slam.pipeline import DUE, HybridSlam
from teamslam.team.estimation.hybrid_slam.pose_grid import TeammateScan
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow, Innovation, RunningWindow
from teamslam.team.estimation.plausibility import start_beyond
from teamslam.team.estimation.submap import LocalMap, Slipped
from teamslam.team.rejection import BY_CORE, Rejection
from teamslam.team.robot.landmark_classes import classify_landmarks
from teamslam.team.robot.ledger import Ledger, OnDisposition
from teamslam.team.robot.maps import AT_ORIGIN, InitialPose, OwnMap, thin_out
from teamslam.team.robot.poses import RunningPoses
from teamslam.team.robot.statements import MessageWriter
from teamslam.team.robot.submaps import Submaps
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing

MOST_SET_ASIDE = 8
"""Measurements of one window set aside after which the window is not computed again."""

MOST_WARNINGS = 64  # number of stored warnings, the newest

Replaced = Callable[[ClosedWindow, m.Prior | None, Sequence[LocalMap]], ClosedWindow]
"""Replacement of a closed window, given the team's map and the earlier submaps."""


class Mapper:
    """Hybrid-SLAM on one incarnation of a robot's stream after the other.

    Call `begin` with an initial pose, `take` for each measurement in order, and `finish`; messages
    are appended to `out`. gated: measurements that no others of their window confirmed. steps:
    odometry intervals of the incarnation in this process; all_steps: of all incarnations. now_ns:
    the latest stamp. passed_ns: no further window ends until then.
    """

    used = "in a submap"

    def __init__(
        self,
        config: RobotConfig,
        exchange: Exchange,
        digest: bytes,
        poses: RunningPoses | None = None,
        replaced: Replaced | None = None,
        on_window: Callable[[ClosedWindow], None] = lambda _: None,
        on_disposition: OnDisposition | None = None,
    ) -> None:
        self.config = config
        self.warnings: deque[str] = deque(maxlen=MOST_WARNINGS)
        self.out: list[Outgoing] = []
        self.poses = RunningPoses(config, self.warnings) if poses is None else poses
        self.submaps = Submaps(config.id, exchange)
        self._digest = digest
        self._replaced, self._on_window = replaced, on_window
        self._on_disposition = on_disposition
        self._period_ns = round(config.pose_s * 1e9)
        self._offset_ns = round(config.clock_offset_s * 1e9)
        self.gated = self.all_steps = 0
        self.now_ns = self.passed_ns = 0
        self._began_ns = 0
        self.writer = MessageWriter(config.id, 0, digest, started=True)
        self._restart(0, AT_ORIGIN)

    # An incarnation begins, and ends.

    def begin(self, start: m.InitialPose) -> None:
        """Begin an incarnation from its initial pose."""
        initial = self._plausible_start(start)
        is_known = initial.pose is not None
        self.writer = MessageWriter(self.config.id, start.incarnation, self._digest, is_known)
        self.submaps.begin(start)
        self.poses.begin_incarnation(start.incarnation)
        self._began_ns = start.stamp_ns
        self.now_ns, self.passed_ns = max(self.now_ns, start.stamp_ns), start.stamp_ns - 1
        self._restart(start.incarnation, initial)

    def _restart(self, incarnation: int, initial: InitialPose) -> None:
        self.ledger = Ledger(self.used, on_disposition=self._on_disposition)
        self.steps = 0
        self._taking: m.Measurement | None = None
        self.forget_window()
        self.restart_estimator(incarnation, initial)

    def restart_estimator(self, incarnation: int, initial: InitialPose) -> None:
        """Make the estimator of an incarnation."""
        self._slam = HybridSlam(self.config, incarnation)
        self.own_map = OwnMap(initial)

    def _plausible_start(self, start: m.InitialPose) -> InitialPose:
        """Return the initial pose and covariance; unknown if beyond the bounds."""
        value = translate.start_of(start)
        why = None if value is None else start_beyond(value, self.config.bounds)
        if why is not None:
            self.warnings.append(f"the initial pose is refused, taken as unknown: {why}")
            return InitialPose(None, None)
        return InitialPose(*translate.pose_of(start))

    def resume(self, start: m.InitialPose, submaps: Sequence[m.Submap]) -> None:
        """Continue after the last submap of an incarnation's earlier process."""
        self.begin(start)
        for submap in submaps:
            self.submaps.restore(submap)
            self.own_map.join(translate.local_map_of(submap))
        last = submaps[-1]
        used = last.last_measurement + 1
        self.ledger = Ledger(self.used, used, self._on_disposition)
        self._reopen_window()
        self.now_ns = self.passed_ns = last.stamp_ns

    def finish(self) -> bool:
        """End the incarnation; return whether that closed a window."""
        self.passed_ns = self.now_ns
        if self._window:
            self._slam.last_measurement = self._window[-1].number
        closed, uncovered = self._slam.finish()
        if closed is not None:
            self._close(closed)
        else:
            self.ledger.leave_out(set())
        self.ledger.uncover(uncovered)
        return closed is not None

    # A measurement.

    def take(self, measurement: m.Measurement) -> bool:
        """Process the next measurement; return whether it closed a window."""
        self._taking = measurement
        if m.is_odometry(measurement):
            self.steps += 1
            self.all_steps += 1
            return self.drive(measurement)
        self.account(measurement, self._observe(measurement))
        return False

    def note_time(self, stamp_ns: int, passed_ns: int) -> bool:
        """Record a measurement's team time and the time that has passed with it.

        Returns False after a clock leap beyond the stamps that receivers accept.
        """
        if not -EARLY_NS <= stamp_ns - self._began_ns <= LATE_NS:
            return False
        if stamp_ns > self.now_ns:
            self.now_ns = stamp_ns
        if passed_ns > self.passed_ns:
            self.passed_ns = passed_ns
        return True

    def account(self, measurement: m.Measurement, rejected: Rejection | None) -> None:
        """Account for the current measurement and add it to the open window."""
        self.ledger.count(measurement, rejected)
        self._window.append(measurement)
        self._taking = None

    def drive(self, measurement: m.AnyOdometry) -> bool:
        """Process an odometry interval; return whether it closed the window."""
        outcome = self._drive(measurement)
        if outcome < DUE:  # most intervals
            self.account(measurement, BY_CORE[outcome])
            return False
        rejected = BY_CORE[outcome % DUE]
        slam, before_ns = self._slam, self._slam.last_keyframe_ns
        slam.last_measurement = measurement.number
        closed = slam.advance()
        if closed is not None:
            self._close(closed, measurement, rejected)
            return True
        self.account(measurement, rejected)
        keyframe_ns = slam.last_keyframe_ns
        if keyframe_ns != before_ns and keyframe_ns is not None:
            self.out += self.poses.publish(keyframe_ns, self)
        return False

    def _drive(self, measurement: m.AnyOdometry) -> int:
        end_ns = measurement.stamp_ns + self._offset_ns
        if not self.note_time(end_ns, end_ns):
            return BY_CORE.index(Rejection.TIME)
        drive = self._slam.segmenter.drive
        if type(measurement) is m.Odometry:
            duration_ns = measurement.duration_ns
            return drive(end_ns, duration_ns, measurement.forward, measurement.yaw_rate)
        return drive(translate.interval_of(measurement, self.config))

    def _observe(self, measurement: m.Measurement) -> Rejection | None:
        """Add a scan or an initial pose; a scan precedes the odometry of its stamp, which may end a
        window.
        """
        stamp_ns = measurement.stamp_ns
        is_near = self.note_time(stamp_ns, stamp_ns - 1)
        is_beyond = not is_near or self.judge.is_ahead(stamp_ns)
        beyond = Rejection.TIME if is_beyond else None
        match measurement:
            case m.Observations() | m.Points() | m.Detections():
                return self._observe_landmarks(measurement, beyond)
            case m.Sightings():
                return self._observe_teammates(measurement, beyond)
            case m.Fix():
                return beyond or self.fix(measurement)
            case _:
                return None

    def _observe_landmarks(
        self, measurement: m.AnyScan | m.Detections, beyond: Rejection | None
    ) -> Rejection | None:
        if type(measurement) is m.Detections and not self.associates:
            return Rejection.NO_ASSOCIATION
        if beyond is not None:
            return beyond
        return self.observe(measurement.stamp_ns, translate.scan_of(measurement))

    def _observe_teammates(
        self, measurement: m.Sightings, rejected: Rejection | None
    ) -> Rejection | None:
        teammates, ranges, bearings = translate.detections_of(measurement)
        others = np.array([name != self.config.id for name in teammates], dtype=np.bool_)
        near = (ranges <= self.config.bounds.extent_m) & others
        if rejected is None and len(near) and not near.any():
            rejected = Rejection.RANGE if others.any() else Rejection.ITSELF
        if rejected is not None:
            return rejected
        seen = tuple(name for name, is_in in zip(teammates, near, strict=True) if is_in)
        return self.sight(measurement, (seen, ranges[near], bearings[near]))

    # A window closes.

    def _close(
        self,
        closed: ClosedWindow,
        measurement: m.Measurement | None = None,
        rejected: Rejection | None = None,
    ) -> None:
        """Publish a submap before anything can raise, then join it.

        measurement: closed the window; None: the stream's end.
        """
        writer = self.writer
        if closed.became is not None:
            closed = classify_landmarks(closed, closed.became, self._window)
        if self._replaced is not None:
            prior = self.poses.prior_of(writer.incarnation)
            closed = self._replaced(closed, prior, self.submaps)
        factors = [writer.sighting(closed.sequence, each) for each in closed.sightings]
        submap = writer.submap(closed)
        if measurement is not None:
            self.account(measurement, rejected)
        self.ledger.close(closed)
        self.warnings += [_describe_slip(slip) for slip in closed.slips]
        self.out += self.submaps.close(factors, submap)
        self.forget_window()
        self.gated += closed.gated
        self._on_window(closed)
        self.own_map.join(closed.local)
        end_ns = closed.end_ns
        shown = self.is_map_due(closed.start_ns, end_ns)
        if shown and closed.window is not None:
            self.out.append(
                writer.cloud(end_ns, thin_out(closed.window.particles, self.own_map.origin))
            )
        self.out.append(writer.innovation(end_ns, closed.sequence, closed.innovation))
        if closed.became is not None:
            self.out.append(writer.association(closed.sequence, end_ns, closed.became))
        self.out += self.poses.publish(end_ns, self)
        if shown:
            self.publish_map(end_ns)

    def is_map_due(self, start_ns: int, end_ns: int) -> bool:
        """Return whether own map and particles are published at this window's end: at multiples of
        `pose_s` by stamps alone, so that a restarted robot publishes the same.
        """
        period_ns = self._period_ns
        return period_ns == 0 or end_ns // period_ns > start_ns // period_ns

    def publish_map(self, stamp_ns: int) -> None:
        """Publish the own map for viewers."""
        landmarks = self.own_landmarks()
        self.out.append(self.writer.own_map(stamp_ns, self.sequence, 0, landmarks, "blocks"))

    # A fault.

    def forget_window(self) -> None:
        """Drop the measurements of the open window."""
        self._window: list[m.Measurement] = []
        self._aside = 0

    def set_aside(self) -> bool:
        """Reset to the state before the measurement that raised; return whether there was one."""
        if self._taking is None:
            return False
        self.ledger.count(self._taking, Rejection.SET_ASIDE)
        self._taking = None
        self._aside += 1
        if self._aside <= MOST_SET_ASIDE:
            self.repeat_window()
        return True

    def repeat_window(self) -> None:
        """Compute the open window again."""
        self._reopen_window()
        for measurement in self._window:
            if isinstance(measurement, m.AnyOdometry):
                if self._drive(measurement) >= DUE:
                    self._slam.advance()
            else:
                self._observe(measurement)

    def _reopen_window(self) -> None:
        last = self.submaps.last
        self._slam = HybridSlam(self.config, self.writer.incarnation)
        if last is not None:
            self._slam.resume(last.sequence, last.last_measurement, last.stamp_ns)

    # The estimator.

    @property
    def judge(self) -> core.StreamJudge:
        """Checks of the stream's times."""
        return self._slam.segmenter.judge

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Add a scan, or return the reason to reject it."""
        return self._slam.observe(stamp_ns, scan)

    def sight(self, measurement: m.Sightings, looks: TeammateScan) -> Rejection | None:
        """Add inter-robot measurements, or return the reason to reject them."""
        return self._slam.sight(measurement.stamp_ns, measurement.number, looks)

    def fix(self, measurement: m.Fix) -> Rejection | None:
        """Add a fix of the antenna, or return the reason to reject it."""
        position = translate.fix_of(measurement, self.config)
        return self._slam.fix(measurement.stamp_ns, measurement.number, position)

    @property
    def associates(self) -> bool:
        """Whether the estimator accepts detections without identities."""
        return self.config.fusion == "join"

    @property
    def sequence(self) -> int:
        """Number of the open window."""
        return self._slam.sequence

    @property
    def innovation(self) -> Innovation:
        """Innovations of the incarnation's windows in this process."""
        return self._slam.innovation

    def own_pose(self, window: RunningWindow | None) -> PoseGaussian:
        """Return the running pose by own measurements."""
        return self.own_map.pose(window)

    def own_landmarks(self) -> LandmarkGaussian:
        """Return the running map by own measurements."""
        return self.own_map.landmarks

    def open_window(self) -> RunningWindow | None:
        """Return the Gaussian of the open window at its last keyframe."""
        return self._slam.running()


def _describe_slip(slip: Slipped) -> str:
    metres, turn = core.hypot(*slip.by[:2]), float(np.degrees(slip.by[2]))
    return (
        f"the odometry slipped by {metres:.2f} m, {turn:.0f}° before {slip.stamp_ns * 1e-9:.2f} s"
    )
