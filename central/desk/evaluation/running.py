"""Compute errors of running estimates as truth arrives."""

from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import numpy as np

from teamslam.central.desk.evaluation.errors import (
    BAND,
    Path,
    PoseErrors,
    align_paths,
    distance_rmse,
    interpolate_truth,
    join_batches,
    pose_errors,
    rigid_alignment,
)
from teamslam.central.fused_map import START_POSES
from teamslam.team import translate
from teamslam.team.config import SURVEY_FRAME
from teamslam.team.estimation.consistency import chi2_quantile, nees
from teamslam.team.estimation.se2 import Pose, inverse
from teamslam.team.shapes import Bool, Float, UInt32
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats

KNOWN_FRAMES = {"", START_POSES, SURVEY_FRAME}  # frames with truth that no stream's start fixes
SPACING_NS = 100_000_000  # least spacing of compared estimates
WAITING = 4_096  # most poses per robot that await truth
BATCHES = 20_000  # most truth batches kept per robot


@dataclass
class TruthFrames:
    """Frames that have truth: of known initial poses or a survey; without any, all."""

    _starts: dict[str, bool] = field(default_factory=dict)

    def take(self, start: m.InitialPose) -> None:
        """Register a stream's initial pose, known or not."""
        self._starts[translate.frame_name(start.robot, start.incarnation)] = bool(start.pose)

    def has(self, frame: str) -> bool:
        """Whether truth is given in this frame."""
        return self._starts.get(frame, frame in KNOWN_FRAMES or not self._starts)

    @property
    def none_is_known(self) -> bool:
        """Whether all initial poses are unknown."""
        return bool(self._starts) and not any(self._starts.values())


class MapFit(NamedTuple):
    """Unaligned map errors of the landmarks that have truth.

    nees_per_dof: eᵀ P⁻¹ e / 2K with the map's covariance P; None for a running map without cross-
    covariances. nees: of each landmark in its own covariance.
    """

    rmse_m: float
    nees_per_dof: float | None
    nees: Float[np.ndarray, " K"]


@dataclass(frozen=True)
class TrueLandmarks:
    """True landmark positions [m], by ascending id."""

    ids: UInt32[np.ndarray, " T"] = field(default_factory=lambda: np.empty(0, np.uint32))
    positions: Float[np.ndarray, "T 2"] = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def of(cls, message: m.TruthLandmarks) -> "TrueLandmarks":
        """Convert the world's message."""
        return cls(*translate.landmarks_of(message))

    def match(
        self, ids: UInt32[np.ndarray, " L"]
    ) -> tuple[Float[np.ndarray, "L 2"], Bool[np.ndarray, " L"]]:
        """True positions by number (else zero), and a mask of known ones."""
        truth, known = np.zeros((len(ids), 2)), np.isin(ids, self.ids)
        truth[known] = self.positions[np.searchsorted(self.ids, ids[known])]
        return truth, known

    def fit(self, fused: m.FusedMap) -> MapFit | None:
        """Errors of a map's landmarks; None without truth."""
        ids, means = translate.landmarks_of(fused)
        true, known = self.match(ids)
        if not known.any():
            return None
        errors = (means - true)[known]
        blocks = translate.landmark_blocks_of(fused)[known]
        solved = np.linalg.solve(blocks, errors[:, :, np.newaxis])[:, :, 0]
        each = np.einsum("ki,ki->k", errors, solved)
        per_dof = None
        if fused.joint or fused.final:
            of_known = np.flatnonzero(np.repeat(known, 2))
            P = translate.landmark_covariance_of(fused)[np.ix_(of_known, of_known)]
            per_dof = nees(errors.ravel(), P) / (2.0 * len(each))
        return MapFit(distance_rmse(means[known], true[known]), per_dof, each)


@dataclass
class NeesTally:
    """Σ NEES/dof, count, and count within 95 %."""

    nees_per_dof: float = 0.0
    count: int = 0
    inside: int = 0

    def take(self, nees: Float[np.ndarray, " n"], dof: int) -> None:
        """Add NEES of `dof` degrees of freedom each."""
        self.nees_per_dof += float(nees.sum()) / dof
        self.count += len(nees)
        self.inside += int(np.count_nonzero(nees <= chi2_quantile(BAND, dof)))

    @property
    def mean(self) -> float | None:
        """Mean NEES per degree of freedom."""
        return self.nees_per_dof / self.count if self.count else None

    @property
    def coverage(self) -> float | None:
        """Share within 95 %, or None."""
        return self.inside / self.count if self.count else None


class Estimate(NamedTuple):
    """Pose (x [m], y [m], theta [rad]) with its covariance, in a frame."""

    stamp_ns: int
    frame: str
    pose: Pose
    covariance: Float[np.ndarray, "3 3"]

    @classmethod
    def of(cls, message: m.PoseEstimate) -> "Estimate":
        """Convert a robot's message."""
        pose = floats(message.pose, "pose").astype(np.float64)
        P = floats(message.covariance, "covariance").astype(np.float64).reshape(3, 3)
        return cls(message.stamp_ns, message.frame, pose, P)


@dataclass
class RunningErrors:
    """Errors of one robot's running poses; truth and poses in either order.

    spacing_ns: least team time between compared poses.
    """

    spacing_ns: int = SPACING_NS
    last_ns: int | None = None
    _poses: deque[Estimate] = field(default_factory=lambda: deque(maxlen=WAITING))
    _truth: deque[Path] = field(default_factory=lambda: deque(maxlen=BATCHES))

    def take_truth(self, message: m.Truth) -> None:
        """Add a batch of truth."""
        batch = Path(*translate.trajectory_of(message))
        if len(batch.stamps_ns):
            self._truth.append(batch)

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a pose is far enough from the last."""
        return self.last_ns is None or stamp_ns >= self.last_ns + self.spacing_ns

    def take_pose(self, estimate: Estimate) -> None:
        """Add an estimate, unless too near to the last."""
        if self.is_due(estimate.stamp_ns):
            self.last_ns = estimate.stamp_ns
            self._poses.append(estimate)

    def known(self) -> PoseErrors | None:
        """Errors of poses whose truth has arrived since the last call."""
        until = int(self._truth[-1].stamps_ns[-1]) if self._truth else -(2**63)
        due = []
        while self._poses and self._poses[0].stamp_ns <= until:
            due.append(self._poses.popleft())
        if not due:
            return None
        times, _, poses, covariances = zip(*due, strict=True)
        path = Path(np.array(times, dtype=np.int64), np.array(poses))
        return pose_errors(path, np.array(covariances), self._path(times[-1]))

    def truth_at(self, stamp_ns: int) -> Pose | None:
        """True pose at a time, or None."""
        poses, known = interpolate_truth(self._path(stamp_ns), np.array([stamp_ns]))
        return poses[0] if known[0] else None

    def forget(self, before_ns: int) -> None:
        """Discard older poses, and truth but the last batch before."""
        while len(self._truth) > 1 and int(self._truth[1].stamps_ns[0]) < before_ns:
            self._truth.popleft()
        while self._poses and self._poses[0].stamp_ns < before_ns:
            self._poses.popleft()

    def forget_poses(self) -> None:
        """Discard poses that await truth."""
        self._poses.clear()
        self.last_ns = None

    def _path(self, until_ns: int) -> Path:
        ends = (batch.stamps_ns[-1] > until_ns for batch in self._truth)
        count = next((k + 1 for k, is_behind in enumerate(ends) if is_behind), None)
        return join_batches([*islice(self._truth, count)])


@dataclass
class DisplayedPoses:
    """Choice of one robot's poses: those given the team's map if there are any, else its own."""

    errors: RunningErrors = field(default_factory=RunningErrors)
    by_team: bool = False

    def has(self, message: m.PoseEstimate, *, by_team: bool) -> bool:
        """Whether a pose is displayed; one outside the team's frame ends those given its map."""
        if by_team:
            if self.by_team and not message.in_team_frame:
                self.errors.forget_poses()  # their frame is no longer the team's
            self.by_team = message.in_team_frame
        return by_team is self.by_team


@dataclass
class TeamTruth:
    """True landmarks of a team, and the frames that have truth."""

    landmarks: TrueLandmarks = field(default_factory=TrueLandmarks)
    frames: TruthFrames = field(default_factory=TruthFrames)

    def take(self, message: m.Message) -> None:
        """Store initial poses and true landmarks."""
        match message:
            case m.InitialPose():
                self.frames.take(message)
            case m.TruthLandmarks():
                self.landmarks = TrueLandmarks.of(message)

    def fit(self, fused: m.FusedMap) -> MapFit | None:
        """Errors of a map's landmarks; None without truth in its frame."""
        return self.landmarks.fit(fused) if self.frames.has(fused.frame) else None


@dataclass
class TruthAlignment(TeamTruth):
    """Truth of a team, and map_from_truth of its maps, as `evaluate` aligns the final map.

    In a frame that no known initial pose or survey fixes, the true landmarks are aligned with those
    of the map, or else the true with the smoothed paths.
    """

    _truth: dict[str, list[Path]] = field(default_factory=dict)
    _smoothed: dict[tuple[str, int, int], Path] = field(default_factory=dict)

    def take(self, message: m.Message) -> None:
        """Store initial poses, truth and smoothed paths."""
        super().take(message)
        match message:
            case m.Truth():
                stamps, poses = translate.trajectory_of(message)
                kept = np.unique(stamps // SPACING_NS, return_index=True)[1]
                batches = self._truth.setdefault(message.robot, [])
                batches.append(Path(stamps[kept], poses[kept]))
            case m.Trajectory():
                path = Path(*translate.trajectory_of(message))
                first = int(path.stamps_ns[0]) if len(path.stamps_ns) else 0
                self._smoothed[message.robot, message.incarnation, first] = path

    def map_from_truth(self, fused: m.FusedMap | None) -> Pose | None:
        """Rigid motion (x [m], y [m], theta [rad]); None if undetermined.

        Without landmarks the frame is that of the initial poses.
        """
        if fused is None or not fused.ids:
            return None if self.frames.none_is_known else np.zeros(3)
        if self.frames.has(fused.frame):
            return np.zeros(3)
        ids, means = translate.landmarks_of(fused)
        true, known = self.landmarks.match(ids)
        motion = rigid_alignment(means[known], true[known])
        if motion is not None:
            return motion
        motion = align_paths(
            (path, join_batches(self._truth.get(robot, [])))
            for (robot, _, _), path in self._smoothed.items()
        )
        return None if motion is None else inverse(motion)
