"""EKF-SLAM with nearest-neighbour data association.

Individual compatibility (Neira and Tardós 2001, section II), the best pair of a scan first; beyond
the gate a landmark is new.
"""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.sim.studies.estimators import ekf_slam
from teamslam.sim.studies.estimators.ekf_slam import EkfSlam
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team import core
from teamslam.team.config import GATE, UNNAMED, Sensor
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    compute_mahalanobis,
    match_best_first,
)
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import Pose
from teamslam.team.shapes import Float, Int64, UInt32


@dataclass(frozen=True)
class _NearestNeighbour:
    slam: EkfSlam
    took: tuple[Int64[np.ndarray, " _"], ...] = ()


def initial_state(pose: Pose) -> _NearestNeighbour:
    """Start at an exact pose."""
    return _NearestNeighbour(ekf_slam.initial_state(pose))


def filter_step(state: _NearestNeighbour, step: RobotStep) -> _NearestNeighbour:
    """Move, associate detections (ids from UNNAMED on), and update at once."""
    unnamed = np.flatnonzero(step.ids >= UNNAMED)
    if not len(unnamed):
        return replace(state, slam=ekf_slam.filter_step(state.slam, step))
    slam, given = _move_and_name(state.slam, step)
    slam = ekf_slam.filter_step(slam, step._replace(increment=Increment.identity(), ids=given))
    return _NearestNeighbour(slam, (*state.took, given[unnamed].astype(np.int64)))


def innovation(state: _NearestNeighbour, step: RobotStep) -> Innovation:
    """Innovation of the used measurements."""
    if (step.ids >= UNNAMED).any():
        step = step._replace(ids=_move_and_name(state.slam, step)[1])
    return ekf_slam.innovation(state.slam, step)


def _move_and_name(slam: EkfSlam, step: RobotStep) -> tuple[EkfSlam, UInt32[np.ndarray, " n"]]:
    slam = ekf_slam.filter_step(slam, step.blind)
    unnamed = np.flatnonzero(step.ids >= UNNAMED)
    given = step.ids.copy()
    given[unnamed] = _associate(slam, step.sensor, step.ranges[unnamed], step.bearings[unnamed])
    return slam, given


def _associate(
    slam: EkfSlam,
    sensor: Sensor,
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
) -> UInt32[np.ndarray, " n"]:
    known = np.flatnonzero(slam.ids >= UNNAMED)
    predicted, spread = _predictions(slam, known)
    R = np.zeros((len(ranges), 2, 2))
    R[:, 0, 0] = core.squared(sensor.range_sigma) + core.squared(sensor.range_sigma_per_m * ranges)
    R[:, 1, 1] = core.squared(sensor.bearing_sigma)
    off = np.column_stack((ranges, bearings))[:, None] - predicted[None]
    off[..., 1] = np.remainder(off[..., 1] + np.pi, 2.0 * np.pi) - np.pi
    squared, determinants = compute_mahalanobis(off, spread[None] + R[:, None])
    found = match_best_first(squared < GATE, squared + core.log(determinants))
    numbers = np.zeros(len(ranges), np.uint32)
    numbers[found != UNASSIGNED] = slam.ids[known[found[found != UNASSIGNED]]]
    new = np.flatnonzero(found == UNASSIGNED)
    numbers[new] = (UNNAMED + len(known) + np.arange(len(new))).astype(np.uint32)
    return numbers


def _predictions(
    slam: EkfSlam, which: Int64[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 2"]]:
    """(range, bearing) of these landmarks and H P Hᵀ, without the sensor's noise."""
    at = 3 + 2 * which[:, None] + np.arange(2)
    dx, dy = (slam.mean[at] - slam.mean[:2]).T
    r = np.maximum(core.hypot(dx, dy), 1e-6)
    H = np.zeros((len(which), 2, 5))
    H[:, 0, 0], H[:, 0, 1] = -dx / r, -dy / r
    H[:, 1, 0], H[:, 1, 1], H[:, 1, 2] = (
        dy / core.squared(r),
        -dx / core.squared(r),
        -1.0,
    )
    H[:, :, 3:] = -H[:, :, :2]
    columns = np.concatenate((np.tile(np.arange(3), (len(which), 1)), at), axis=1)
    P = slam.covariance[columns[:, :, None], columns[:, None, :]]
    bearing = core.atan2(dy, dx) - slam.mean[2]
    return np.column_stack((r, bearing)), dense.product(dense.product(H, P), H.transpose(0, 2, 1))
