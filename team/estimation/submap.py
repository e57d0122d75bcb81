"""The submap of a robot: one Gaussian over poses and landmarks in its own frame."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED, Bias
from teamslam.team.shapes import Bool, Float, Int64, UInt32

NO_NODES = np.empty(0, np.int64)
NO_COLUMNS = np.empty((0, 0))


@dataclass(frozen=True)
class Unnamed:
    """Observations of a window's U unnamed landmarks, by ascending number.

    counts: measurements of each, at least 1. seen: keyframes that observed it; two landmarks in one
    keyframe are distinct. classes: ln P(its reported classes | class), up to a constant; no columns
    without reports.
    """

    counts: UInt32[np.ndarray, " U"]
    seen: Bool[np.ndarray, "U keyframes"]
    classes: Float[np.ndarray, "_ _"] = field(default_factory=NO_COLUMNS.copy)

    @cached_property
    def views(self) -> tuple[Int64[np.ndarray, " _"], ...]:
        """Largest sets of at least three landmarks that one keyframe observed, ascending."""
        seen = np.unique(self.seen.astype(np.float64), axis=1)
        count = seen.sum(axis=0)
        inside = seen.T @ seen == count[:, None]
        np.fill_diagonal(inside, False)
        usable = (count >= 3) & ~inside.any(axis=1)
        return tuple(np.flatnonzero(column) for column in seen[:, usable].T)


class Slipped(NamedTuple):
    """A slip of (forward, left, turn) before the keyframe at stamp_ns."""

    stamp_ns: int
    by: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Became:
    """Outcomes of a window's detections without identities.

    stamps, counts: of M scans [ns], and detections of each. By detection: rows, index in the
    message; landmarks, number in the submap or 0; clutter, whether it is false.
    """

    stamps: Int64[np.ndarray, " M"]
    counts: Int64[np.ndarray, " M"]
    rows: Int64[np.ndarray, " n"]
    landmarks: Int64[np.ndarray, " n"]
    clutter: Bool[np.ndarray, " n"]

    @property
    def silent(self) -> list[tuple[int, bool]]:
        """Stamps of the scans without a landmark in the submap, and whether they are clutter."""
        k = len(self.counts)
        scan = np.repeat(np.arange(k), self.counts)
        used = np.bincount(scan[self.landmarks > 0], minlength=k)
        false = np.bincount(scan[self.clutter], minlength=k)
        return [
            (int(self.stamps[i]), bool(false[i] == self.counts[i]))
            for i in np.nonzero(used == 0)[0]
        ]


NONE_UNNAMED = Unnamed(np.empty(0, np.uint32), np.empty((0, 0), np.bool_))


@dataclass(frozen=True)
class LocalMap:
    """N(mean, covariance) of (end pose, pose nodes, landmarks) in the frame of its start pose.

    The start pose is exactly zero: the submap contains no information from outside the window. ids:
    of the L landmarks, strictly ascending. mean: (x [m], y [m], theta [rad]) of the end pose and K
    pose nodes, then (x₁, y₁, …, x_L, y_L); theta in (−π, π]. covariance: positive definite, [m²,
    m·rad, rad²]. node_stamps: team time [ns], strictly ascending. biases, sensitivity: shared
    errors b of the robot's submaps, ascending, and a row S = ∂mean/∂b of each. curvature: rows D =
    ∂²mean/∂b², zero but for the clock's: given b the mean is mean + Σ (S b + ½ D b²). unnamed: of
    the landmarks from number 2³¹ on.
    """

    ids: UInt32[np.ndarray, " L"]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]
    node_stamps: Int64[np.ndarray, " K"] = field(default_factory=NO_NODES.copy)
    biases: tuple[Bias, ...] = ()
    sensitivity: Float[np.ndarray, "B _"] = field(default_factory=NO_COLUMNS.copy)
    unnamed: Unnamed = NONE_UNNAMED
    curvature: Float[np.ndarray, "_ _"] = field(default_factory=NO_COLUMNS.copy)

    def __post_init__(self) -> None:
        """Make the curvature's zeros."""
        if self.curvature.shape != self.sensitivity.shape:
            object.__setattr__(self, "curvature", np.zeros_like(self.sensitivity))

    @property
    def end_pose(self) -> Float[np.ndarray, "3"]:
        """start_from_end (x, y, theta)."""
        return self.mean[:3]

    @property
    def landmarks(self) -> Float[np.ndarray, "L 2"]:
        """Landmark positions [m] in the start frame."""
        return self.mean[3 + 3 * len(self.node_stamps) :].reshape(-1, 2)

    @property
    def spacings(self) -> Float[np.ndarray, "U U"]:
        """Distances [m] between unnamed landmarks that one keyframe observed; ∞ between others."""
        x, y = self.landmarks[self.ids >= UNNAMED].T
        masks = self.unnamed.seen.astype(np.float32)
        away = core.hypot(x[:, None] - x, y[:, None] - y)
        away[masks @ masks.T == 0.0] = np.inf
        np.fill_diagonal(away, np.inf)
        return np.asarray(away)

    @property
    def distinct(self) -> Bool[np.ndarray, "L L"]:
        """Pairs of landmarks, by index in `ids`, that cannot be one: two of one keyframe, and all
        pairs with a named landmark; none where all are named.
        """
        unnamed = self.ids >= UNNAMED
        together = np.full((len(self.ids), len(self.ids)), bool(unnamed.any()))
        masks = self.unnamed.seen.astype(np.float32)
        together[np.ix_(unnamed, unnamed)] = masks @ masks.T > 0.0
        return together

    @property
    def nodes(self) -> Float[np.ndarray, "K 3"]:
        """start_from_node of each pose node."""
        return self.mean[3 : 3 + 3 * len(self.node_stamps)].reshape(-1, 3)

    @property
    def named(self) -> "LocalMap":
        """Marginal without the unnamed landmarks."""
        if not len(self.ids) or self.ids[-1] < UNNAMED:
            return self
        named = int(np.searchsorted(self.ids, UNNAMED))
        numbers = np.arange(len(self.mean) - 2 * (len(self.ids) - named))
        part = self._part(numbers, self.node_stamps)
        return replace(part, ids=self.ids[:named], unnamed=NONE_UNNAMED)

    @property
    def motion(self) -> "LocalMap":
        """Marginal over the end pose."""
        return LocalMap(self.ids[:0], self.mean[:3], self.covariance[:3, :3])

    @property
    def without_biases(self) -> "LocalMap":
        """The submap with the shared errors at zero."""
        return LocalMap(
            self.ids, self.mean, self.covariance, self.node_stamps, unnamed=self.unnamed
        )

    @property
    def without_nodes(self) -> "LocalMap":
        """Marginal over end pose and landmarks."""
        if not len(self.node_stamps):
            return self
        behind = 3 + 3 * len(self.node_stamps)
        numbers = np.concatenate([np.arange(3), np.arange(behind, len(self.mean))])
        return self._part(numbers, NO_NODES)

    def _part(
        self, numbers: Int64[np.ndarray, " m"], stamps: Int64[np.ndarray, " _"]
    ) -> "LocalMap":
        return LocalMap(
            self.ids,
            self.mean[numbers],
            self.covariance[np.ix_(numbers, numbers)],
            stamps,
            self.biases,
            self.sensitivity[:, numbers] if self.biases else NO_COLUMNS,
            self.unnamed,
            self.curvature[:, numbers] if self.biases else NO_COLUMNS,
        )
