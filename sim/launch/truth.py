"""How honest a team is while it runs: its poses and its map against the truth, as they come.

An evaluation like `central.desk.evaluation` of what has arrived so far; without a truth it stays
empty.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, UInt32

from central.desk.evaluation.errors import BAND, Path, interpolated
from team import translate
from team.estimation.consistency import chi2_quantile, state_error
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import floats
from team.wire.bus import Sample

EVERY_NS = 1_000_000_000
"""A robot's pose is judged at most once per this much team time; the others are not decoded."""
WAITING = 256
"""Poses of a robot that wait for their truth, at the most; the oldest are given up first."""
TRUTH_POSES = 20_000
"""True poses of a robot that are kept, the newest."""


@dataclass
class Tally:
    """Squared errors in units of their covariance: Σ NEES/dof, how many, how many within 95 %."""

    nees_per_dof: float = 0.0
    count: int = 0
    inside: int = 0

    def take(self, nees: Float[np.ndarray, " n"], dof: int) -> None:
        """So many more, each of `dof` degrees of freedom."""
        self.nees_per_dof += float(nees.sum()) / dof
        self.count += len(nees)
        self.inside += int(np.count_nonzero(nees <= chi2_quantile(BAND, dof)))

    @property
    def mean(self) -> float | None:
        """NEES per degree of freedom, 1 where the covariances are right; None without any."""
        return self.nees_per_dof / self.count if self.count else None

    @property
    def coverage(self) -> float | None:
        """The share within 95 %; None without any."""
        return self.inside / self.count if self.count else None


class _Pose(NamedTuple):
    stamp_ns: int
    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]


@dataclass
class _Robot:
    tally: Tally = field(default_factory=Tally)
    waiting: deque[_Pose] = field(default_factory=lambda: deque(maxlen=WAITING))
    truth: deque[tuple[int, Float[np.ndarray, "3"]]] = field(
        default_factory=lambda: deque(maxlen=TRUTH_POSES)
    )
    newest_ns: int | None = None
    given_map: bool = False

    def judge(self) -> None:
        """Every pose that the truth has reached; truth that no later pose needs is let go."""
        due: list[_Pose] = []
        while self.truth and self.waiting and self.waiting[0].stamp_ns <= self.truth[-1][0]:
            due.append(self.waiting.popleft())
        if not due:
            return
        stamps = np.array([stamp for stamp, _ in self.truth], dtype=np.int64)
        truth = Path(stamps, np.array([pose for _, pose in self.truth]))
        poses, known = interpolated(truth, np.array([p.stamp_ns for p in due], dtype=np.int64))
        errors = [state_error(p.pose, true) for p, true in zip(due, poses, strict=True)]
        squared = [
            error @ np.linalg.solve(estimate.covariance, error)
            for error, estimate in zip(errors, due, strict=True)
        ]
        self.tally.take(np.array(squared)[known], 3)
        while len(self.truth) > 1 and self.truth[1][0] <= due[-1].stamp_ns:
            self.truth.popleft()


@dataclass
class LiveErrors:
    """What the truth says of a team so far.

    landmarks: of the newest fused map, each in its own 2 × 2 covariance, in the frame as the map
    lies.
    """

    landmarks: Tally = field(default_factory=Tally)
    _robots: dict[str, _Robot] = field(default_factory=dict)
    _ids: UInt32[np.ndarray, " T"] = field(default_factory=lambda: np.empty(0, np.uint32))
    _positions: Float[np.ndarray, "T 2"] = field(default_factory=lambda: np.empty((0, 2)))

    listens: ClassVar[tuple[ch.Channel, ...]] = (
        ch.TRUTH,
        ch.TRUTH_LANDMARKS,
        ch.OWN_POSE,
        ch.TEAM_POSE,
    )

    def of(self, robot: str) -> Tally:
        """Of a robot's online poses: of those given the team's map where there are any."""
        return self._robots[robot].tally if robot in self._robots else Tally()

    def wants(self, channel: ch.Channel, robot: str, sample: Sample) -> bool:
        """Whether the sample is worth decoding."""
        if channel not in (ch.OWN_POSE, ch.TEAM_POSE):
            return True
        known = self._robot(robot)
        if known.given_map != (channel is ch.TEAM_POSE):
            return channel is ch.TEAM_POSE  # the first one given the map replaces the others
        return known.newest_ns is None or sample.stamp_ns - known.newest_ns >= EVERY_NS

    def take(self, channel: ch.Channel, message: m.Message) -> None:
        """Take one message of any channel; of the others there is nothing to learn."""
        match message:
            case m.PoseEstimate():
                self._take_pose(message, given_map=channel is ch.TEAM_POSE)
            case m.Truth():
                robot = self._robot(message.robot)
                stamps, poses = translate.trajectory_of(message)
                robot.truth.extend(zip(stamps.tolist(), poses, strict=True))
                robot.judge()
            case m.TruthLandmarks():
                self._ids, self._positions = translate.landmarks_of(message)
            case m.FusedMap():
                self._take_map(message)
            case _:
                pass

    def _robot(self, name: str) -> _Robot:
        return self._robots.setdefault(name, _Robot())

    def _take_pose(self, message: m.PoseEstimate, *, given_map: bool) -> None:
        robot = self._robot(message.robot)
        if given_map and not robot.given_map:
            robot.given_map, robot.tally = True, Tally()
            robot.waiting.clear()
        robot.newest_ns = message.stamp_ns
        pose = floats(message.pose, "pose").astype(np.float64)
        covariance = floats(message.covariance, "covariance").reshape(3, 3)
        robot.waiting.append(_Pose(message.stamp_ns, pose, covariance))
        robot.judge()

    def _take_map(self, fused: m.FusedMap) -> None:
        """The latest map replaces what the one before was worth."""
        ids, means = translate.landmarks_of(fused)
        blocks = translate.landmark_blocks_of(fused)
        known = np.isin(ids, self._ids)
        errors = means[known] - self._positions[np.searchsorted(self._ids, ids[known])]
        solved = np.linalg.solve(blocks[known], errors[:, :, np.newaxis])[:, :, 0]
        self.landmarks = Tally()
        self.landmarks.take(np.einsum("ki,ki->k", errors, solved), 2)
