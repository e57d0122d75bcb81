"""Drawable contents of a team's messages."""

from dataclasses import dataclass, field

import numpy as np

from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.team import translate
from teamslam.team.shapes import Float, UInt32
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats

PATH_POINTS = 1_000  # most points of a path; a longer one is halved


@dataclass(frozen=True)
class Landmarks:
    """L ids, positions [m], covariances (xx, xy, yy) [m²]."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    blocks: Float[np.ndarray, "L 3"]


def landmarks_of(message: m.MapEstimate | m.FusedMap) -> Landmarks:
    """Positions and 2 × 2 covariances of a map."""
    names, means = translate.landmarks_of(message)
    blocks = translate.landmark_blocks_of(message)[:, (0, 0, 1), (0, 1, 1)]
    return Landmarks(names, means, blocks)


def centre_particles(cloud: m.ParticleCloud) -> Float[np.ndarray, "P 2"]:
    """Particle positions (ahead [m], left [m]) relative to their mean pose."""
    poses = floats(cloud.poses, "poses").astype(np.float64).reshape(-1, 3)
    weights = floats(cloud.weights, "weights").astype(np.float64)
    if not weights.sum() > 0.0:
        return np.zeros((len(poses), 2))
    x, y = np.average(poses[:, :2], axis=0, weights=weights)
    c, s = (np.average(f(poses[:, 2]), weights=weights) for f in (np.cos, np.sin))
    heading = np.arctan2(s, c)
    return transform_points(np.array((0.0, 0.0, -float(heading))), poses[:, :2] - (x, y))


@dataclass
class Track:
    """Growing path (x [m], y [m]), thinned to a least spacing [ns]."""

    stamps: list[int] = field(default_factory=list)
    points: list[tuple[float, float]] = field(default_factory=list)
    spacing_ns: int = 100_000_000

    def take(self, stamp_ns: int, x: float, y: float) -> None:
        """Append a point, unless too near to the last."""
        if self.stamps and stamp_ns < self.stamps[-1] + self.spacing_ns:
            return
        self.stamps.append(stamp_ns)
        self.points.append((x, y))
        if len(self.points) > PATH_POINTS:
            self.stamps, self.points = self.stamps[::2], self.points[::2]
            self.spacing_ns *= 2

    def since(self, stamp_ns: int) -> list[tuple[float, float]]:
        """Points from this time on, at least the last."""
        first = int(np.searchsorted(self.stamps, stamp_ns))
        return self.points[min(first, len(self.points) - 1) :] if self.points else []
