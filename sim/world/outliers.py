"""Outliers of the simulated world: measurements independent of their landmark.

All kinds use the same draws, so runs of different kinds, including dropped outliers, are
comparable.
"""

from dataclasses import replace

import numpy as np

from teamslam.sim.world.config import OutlierKind
from teamslam.sim.world.streams import Detections
from teamslam.team.shapes import Float, UInt32


def spoilt(
    seen: Detections,
    share: float,
    kind: OutlierKind,
    span: tuple[float, float],
    field_of_view: float,
    landmarks: int,
    uniforms: Float[np.ndarray, "R 3"],
) -> Detections:
    """Replace a share of the measurements by outliers, from uniform numbers in [0, 1).

    The first number of a row selects outliers. "measurement": the others are the range, uniform in
    `span` [m], and the bearing, uniform in the field of view. "identity": the second selects
    another of the landmarks 1 … `landmarks`. "drop": the measurement is omitted.
    """
    chosen = uniforms[:, 0] < share
    if kind == "drop":
        return seen.where(~chosen)
    if kind == "identity":
        others = _others(seen.ids, landmarks, uniforms[:, 1])
        return replace(seen, ids=np.where(chosen, others, seen.ids))
    nearest, farthest = span
    ranges = nearest + (farthest - nearest) * uniforms[:, 1]
    bearings = field_of_view * (0.5 - uniforms[:, 2])
    return replace(
        seen,
        ranges=np.where(chosen, ranges, seen.ranges),
        bearings=np.where(chosen, bearings, seen.bearings),
    )


def _others(
    ids: UInt32[np.ndarray, " R"], landmarks: int, uniform: Float[np.ndarray, " R"]
) -> UInt32[np.ndarray, " R"]:
    """Any other id of 1 … landmarks with equal probability; the only one stays."""
    ahead = 1 + np.floor(uniform * max(landmarks - 1, 1)).astype(np.int64)
    others: UInt32[np.ndarray, " R"] = (ids - 1 + ahead) % landmarks + 1
    return others.astype(np.uint32)
