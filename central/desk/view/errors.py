"""Errors of running estimates against the truth, as soon as the truth is there."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from central.desk.evaluation.errors import (
    Path,
    PoseErrors,
    distance_rmse,
    interpolated,
    pose_errors,
)
from central.desk.view.drawn import Landmarks
from team.wire import messages as m
from team.wire.arrays import floats, stamps

SPACING_NS = 100_000_000
"""Of the estimates that are compared."""


class MapFit(NamedTuple):
    """A map against the truth: RMSE [m] as it lies, NEES per degree of freedom of each landmark."""

    landmarks: int
    rmse_m: float
    nees_per_dof: float


def map_fit(landmarks: Landmarks, truth: dict[int, tuple[float, float]]) -> MapFit | None:
    """The errors of the landmarks whose truth is known; None without one."""
    known = [i for i, name in enumerate(landmarks.ids.tolist()) if name in truth]
    if not known:
        return None
    true = np.array([truth[int(landmarks.ids[i])] for i in known])
    error = landmarks.means[known] - true
    xx, xy, yy = landmarks.blocks[known].T
    ex, ey = error.T
    squared = (yy * ex * ex - 2.0 * xy * ex * ey + xx * ey * ey) / (xx * yy - xy * xy)
    rmse_m = distance_rmse(landmarks.means[known], true)
    return MapFit(len(known), rmse_m, float(squared.mean()) / 2.0)


@dataclass
class RunningErrors:
    """The errors of one robot's running poses; truth and poses may come in either order."""

    _poses: deque[tuple[int, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]] = field(
        default_factory=deque
    )
    _truth: deque[Path] = field(default_factory=deque)
    _last_ns: int | None = None

    def take_truth(self, message: m.Truth) -> None:
        """Take a batch of truth."""
        poses = floats(message.poses, "poses").astype(np.float64).reshape(-1, 3)
        times = stamps(message.stamps, "stamps").astype(np.int64)
        if len(times):
            self._truth.append(Path(times, poses))

    def take_pose(self, message: m.PoseEstimate) -> None:
        """Take an estimate, if it is not too near to the last."""
        if self._last_ns is not None and message.stamp_ns < self._last_ns + SPACING_NS:
            return
        self._last_ns = message.stamp_ns
        pose = floats(message.pose, "pose").astype(np.float64)
        P = floats(message.covariance, "covariance").astype(np.float64).reshape(3, 3)
        self._poses.append((message.stamp_ns, pose, P))

    def known(self) -> PoseErrors | None:
        """The errors of the poses that the truth has reached since the last time."""
        until = int(self._truth[-1].stamps_ns[-1]) if self._truth else None
        due = []
        while until is not None and self._poses and self._poses[0][0] <= until:
            due.append(self._poses.popleft())
        if not due:
            return None
        times, poses, covariances = zip(*due, strict=True)
        path = Path(np.array(times, dtype=np.int64), np.array(poses))
        return pose_errors(path, np.array(covariances), self._path(times[-1]))

    def truth_at(self, stamp_ns: int) -> Float[np.ndarray, "3"] | None:
        """The true pose at a time; None where it is not known."""
        poses, known = interpolated(self._path(stamp_ns), np.array([stamp_ns]))
        return poses[0] if known[0] else None

    def forget(self, before_ns: int) -> None:
        """Forget what is older, but for the last batch of truth before it."""
        while len(self._truth) > 1 and int(self._truth[1].stamps_ns[0]) < before_ns:
            self._truth.popleft()
        while self._poses and self._poses[0][0] < before_ns:
            self._poses.popleft()

    def _path(self, until_ns: int) -> Path:
        """The truth up to the first batch that reaches beyond a time, in order."""
        batches: list[Path] = []
        for batch in self._truth:
            batches.append(batch)
            if batch.stamps_ns[-1] > until_ns:
                break
        if not batches:
            return Path(np.zeros(0, np.int64), np.zeros((0, 3)))
        times = np.concatenate([batch.stamps_ns for batch in batches])
        times, first = np.unique(times, return_index=True)
        return Path(times, np.concatenate([batch.poses for batch in batches])[first])
