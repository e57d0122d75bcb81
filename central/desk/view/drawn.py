"""What is drawn of a team's messages: ellipses, thinned paths, colours."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt32

from team.wire import messages as m
from team.wire.arrays import floats, ids

ELLIPSE_SCALE = float(np.sqrt(5.991))
"""95 % of a Gaussian in the plane lie within this Mahalanobis distance."""
PATH_POINTS = 1_000
"""Points of one path at the most; a longer one keeps every second."""
PALETTE = (
    "#3b9dff", "#ff7a33", "#19c37d", "#e667b3", "#f2c230", "#9a7bff", "#33c7d9", "#ff5d6c",
    "#a3c644", "#c79a6b",
)  # fmt: skip
"""Robots' colours in the order of their names; told apart on dark and on light ground."""


def in_order(names: Iterable[str]) -> list[str]:
    """Robots' names as people count them: r2 before r10."""
    return sorted(
        names, key=lambda name: [int(p) if p.isdigit() else p for p in _DIGITS.split(name)]
    )


def colour_of(number: int) -> str:
    """The colour of the robot with this number, as #rrggbb; the eleventh takes the first again."""
    return PALETTE[number % len(PALETTE)]


_DIGITS = re.compile("([0-9]+)")


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of one map: L ids, positions [m], covariances as (xx, xy, yy) [m²]."""

    ids: UInt32[np.ndarray, " L"]
    means: Float[np.ndarray, "L 2"]
    blocks: Float[np.ndarray, "L 3"]


def landmarks_of(message: m.MapEstimate | m.FusedMap) -> Landmarks:
    """Positions and 2 × 2 covariances of a map; of a joint covariance without unpacking it.

    Row i of a packed upper triangle of n rows begins at i·n − i(i − 1)/2.
    """
    names = ids(message.ids, "ids").astype(np.uint32)
    means = floats(message.means, "means").astype(np.float64).reshape(-1, 2)
    values = floats(message.covariance, "covariance").astype(np.float64)
    if not message.joint:
        return Landmarks(names, means, values.reshape(-1, 3))
    n = 2 * len(names)
    rows = np.arange(0, n, 2)
    first, second = (i * n - i * (i - 1) // 2 for i in (rows, rows + 1))
    blocks = np.column_stack([values[first], values[first + 1], values[second]])
    return Landmarks(names, means, blocks)


def ellipses(
    blocks: Float[np.ndarray, "L 3"],
) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, " L"], Float[np.ndarray, " L"]]:
    """(half major axis [m], half minor axis [m], direction of the major one [rad]), 95 %."""
    xx, xy, yy = blocks.T
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.hypot(half, xy)
    return (
        ELLIPSE_SCALE * np.sqrt(middle + root),
        ELLIPSE_SCALE * np.sqrt(np.maximum(middle - root, 0.0)),
        0.5 * np.arctan2(xy, half),
    )


@dataclass
class Track:
    """A path as it grows, thinned to what can be drawn: (x [m], y [m]) at a least spacing [ns]."""

    stamps: list[int] = field(default_factory=list)
    points: list[tuple[float, float]] = field(default_factory=list)
    spacing_ns: int = 100_000_000

    def take(self, stamp_ns: int, x: float, y: float) -> None:
        """Append a point, unless the last is nearer than the spacing; one out of order is none."""
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
