"""Place the truth in the frame of a running team's map."""

from dataclasses import dataclass, field

import numpy as np

from teamslam.central.desk.evaluation.errors import Path, interpolate_truth, rigid_alignment
from teamslam.central.desk.evaluation.running import SPACING_NS, TrueLandmarks, TruthFrames
from teamslam.team import translate
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m


@dataclass
class TruthAlignment:
    """Truth of a team, and map_from_truth of its maps.

    In a frame that neither a known initial pose nor a survey fixes, map_from_truth aligns the true
    landmarks with those of the map, or without them the true with the smoothed paths, which the
    final map has. `evaluate` aligns the final map in the same way.
    """

    landmarks: TrueLandmarks = field(default_factory=TrueLandmarks)
    frames: TruthFrames = field(default_factory=TruthFrames)
    _truth: dict[str, list[Path]] = field(default_factory=dict)
    _smoothed: dict[tuple[str, int, int], Path] = field(default_factory=dict)

    def take(self, message: m.Message) -> None:
        """Store initial poses, truth and smoothed paths; other messages have no effect."""
        match message:
            case m.InitialPose():
                self.frames.take(message)
            case m.TruthLandmarks():
                self.landmarks = TrueLandmarks.of(message)
            case m.Truth():
                stamps, poses = translate.trajectory_of(message)
                kept = np.unique(stamps // SPACING_NS, return_index=True)[1]
                batches = self._truth.setdefault(message.robot, [])
                batches.append(Path(stamps[kept], poses[kept]))
            case m.Trajectory():
                path = Path(*translate.trajectory_of(message))
                first = int(path.stamps_ns[0]) if len(path.stamps_ns) else 0
                self._smoothed[message.robot, message.incarnation, first] = path
            case _:
                pass

    def map_from_truth(self, fused: m.FusedMap | None) -> Float[np.ndarray, "3"] | None:
        """Rigid motion (x [m], y [m], theta [rad]); None if undetermined.

        fused: the map; None or without landmarks: the frame is that of the initial poses.
        """
        if fused is None or not fused.ids:
            return None if self.frames.none_is_known else np.zeros(3)
        if self.frames.has(fused.frame):
            return np.zeros(3)
        ids, means = translate.landmarks_of(fused)
        true, known = self.landmarks.match(ids)
        motion = rigid_alignment(means[known], true[known])
        return self._align_paths() if motion is None else motion

    def _align_paths(self) -> Float[np.ndarray, "3"] | None:
        places, true_places = [np.empty((0, 2))], [np.empty((0, 2))]
        for (robot, _, _), path in self._smoothed.items():
            poses, known = interpolate_truth(self._path(robot), path.stamps_ns)
            places.append(path.poses[known, :2])
            true_places.append(poses[known, :2])
        return rigid_alignment(np.concatenate(places), np.concatenate(true_places))

    def _path(self, robot: str) -> Path:
        batches = self._truth.get(robot, [])
        if not batches:
            return Path(np.zeros(0, np.int64), np.zeros((0, 3)))
        stamps, first = np.unique(
            np.concatenate([each.stamps_ns for each in batches]), return_index=True
        )
        return Path(stamps, np.concatenate([each.poses for each in batches])[first])
