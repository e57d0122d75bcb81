"""The drawable part of a team's messages: landmarks and thinned paths."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt32

from team import translate
from team.wire import messages as m

PATH_POINTS = 1_000
"""Most points of one path; a longer one keeps every second."""


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of one map: L ids, positions [m], covariances as (xx, xy, yy) [m²]."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    blocks: Float[np.ndarray, "L 3"]


def landmarks_of(message: m.MapEstimate | m.FusedMap) -> Landmarks:
    """Positions and 2 × 2 covariances of a map."""
    names, means = translate.landmarks_of(message)
    blocks = translate.landmark_blocks_of(message)[:, (0, 0, 1), (0, 1, 1)]
    return Landmarks(names, means, blocks)


@dataclass
class Track:
    """A growing path, thinned for drawing: (x [m], y [m]) at a least spacing [ns]."""

    stamps: list[int] = field(default_factory=list)
    points: list[tuple[float, float]] = field(default_factory=list)
    spacing_ns: int = 100_000_000

    def take(self, stamp_ns: int, x: float, y: float) -> None:
        """Append a point, unless it is nearer than the spacing to the last, or out of order."""
        if self.stamps and stamp_ns < self.stamps[-1] + self.spacing_ns:
            return
        self.stamps.append(stamp_ns)
        self.points.append((x, y))
        if len(self.points) > PATH_POINTS:
            self.stamps, self.points = self.stamps[::2], self.points[::2]
            self.spacing_ns *= 2

    def since(self, stamp_ns: int) -> list[tuple[float, float]]:
        """The points from this time on, at least the last."""
        first = int(np.searchsorted(self.stamps, stamp_ns))
        return self.points[min(first, len(self.points) - 1) :] if self.points else []
