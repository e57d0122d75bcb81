"""Place the truth in the frame of a running team's map."""

from dataclasses import dataclass, field

import numpy as np

from teamslam.central.desk.evaluation.errors import (
    Path,
    interpolate_truth,
    join_batches,
    rigid_alignment,
)
from teamslam.central.desk.evaluation.running import SPACING_NS, TrueLandmarks, TruthFrames
from teamslam.team import translate
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m


@dataclass
class TruthAlignment:
    """Truth of a team, and map_from_truth of its maps, as `evaluate` aligns the final map.

    In a frame that no known initial pose or survey fixes, it aligns the true landmarks with those
    of the map, or else the true with the smoothed paths.
    """

    landmarks: TrueLandmarks = field(default_factory=TrueLandmarks)
    frames: TruthFrames = field(default_factory=TruthFrames)
    _truth: dict[str, list[Path]] = field(default_factory=dict)
    _smoothed: dict[tuple[str, int, int], Path] = field(default_factory=dict)

    def take(self, message: m.Message) -> None:
        """Store initial poses, truth and smoothed paths."""
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

        Without landmarks the frame is that of the initial poses.
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
            poses, known = interpolate_truth(
                join_batches(self._truth.get(robot, [])), path.stamps_ns
            )
            places.append(path.poses[known, :2])
            true_places.append(poses[known, :2])
        return rigid_alignment(np.concatenate(places), np.concatenate(true_places))
