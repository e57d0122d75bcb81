"""Errors of a running team against the truth."""

from dataclasses import dataclass, field

from teamslam.central.desk.evaluation.running import (
    DisplayedPoses,
    Estimate,
    NeesTally,
    RunningErrors,
    TeamTruth,
)
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample

EVERY_NS = 1_000_000_000  # least team time between a robot's compared poses


@dataclass
class _Robot(DisplayedPoses):
    errors: RunningErrors = field(default_factory=lambda: RunningErrors(EVERY_NS))
    tally: NeesTally = field(default_factory=NeesTally)
    team_ns: int = -1

    def judge(self) -> None:
        if (found := self.errors.known()) is not None:
            self.tally.take(found.nees, 3)
            self.errors.forget(int(found.stamps_ns[-1]))


@dataclass
class LiveErrors:
    """Errors of a team so far.

    landmarks: of the newest map, unaligned, each in its own covariance.
    """

    landmarks: NeesTally = field(default_factory=NeesTally)
    _robots: dict[str, _Robot] = field(default_factory=dict)
    _truth: TeamTruth = field(default_factory=TeamTruth)

    def of(self, robot: str) -> NeesTally:
        """Errors of online poses, given the team's map if there are any."""
        return self._robots[robot].tally if robot in self._robots else NeesTally()

    def wants(self, channel: ch.Channel, robot: str, sample: Sample) -> bool:
        """Whether the sample needs decoding."""
        if channel not in (ch.OWN_POSE, ch.TEAM_POSE):
            return True
        known = self._robot(robot)
        if channel is ch.TEAM_POSE:
            is_again = sample.stamp_ns <= known.team_ns  # may withdraw the pose of this time
            known.team_ns = sample.stamp_ns
            if is_again:
                return True
        if known.by_team != (channel is ch.TEAM_POSE):
            return channel is ch.TEAM_POSE  # the first one given the map replaces the others
        return known.errors.is_due(sample.stamp_ns)

    def take(self, channel: ch.Channel, message: m.Message) -> None:
        """Process a message of any channel."""
        self._truth.take(message)
        match message:
            case m.PoseEstimate():
                self._take_pose(message, by_team=channel is ch.TEAM_POSE)
            case m.Truth():
                robot = self._robot(message.robot)
                robot.errors.take_truth(message)
                robot.judge()
            case m.FusedMap():
                self.landmarks = NeesTally()
                if (fit := self._truth.fit(message)) is not None:
                    self.landmarks.take(fit.nees, 2)

    def _robot(self, name: str) -> _Robot:
        return self._robots.setdefault(name, _Robot())

    def _take_pose(self, message: m.PoseEstimate, *, by_team: bool) -> None:
        robot = self._robot(message.robot)
        before = robot.by_team
        is_displayed = robot.has(message, by_team=by_team)
        if robot.by_team is not before:
            robot.tally = NeesTally()
            robot.errors.forget_poses()
        if is_displayed and self._truth.frames.has(message.frame):
            robot.errors.take_pose(Estimate.of(message))
        robot.judge()
