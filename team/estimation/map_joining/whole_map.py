"""The Gaussian back end of one robot: submaps joined one by one into one Gaussian.

Hybrid-SLAM's map joining (Brooks & Bailey 2008, "HybridSLAM"), with the constraints of Williams'
constrained local submap filter (2001): the whole map and the local map are independent Gaussians,
and the identity of two landmarks is an observation without noise. Earlier submaps are not
linearised again, so the map is overconfident after many joins.
"""

import math

import numpy as np

from teamslam.team.core import WholeMap
from teamslam.team.estimation.gaussian import NotACovarianceError, PoseGaussian
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float, Int64

INDEFINITE, SINGULAR = 1, 2
"""Faults of the core: the covariance of the innovation of all known landmarks is not positive
definite, or that of one landmark is singular.
"""


def initial_map(
    pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"] | None
) -> WholeMap:
    """Make a map with a pose only; covariance None: the pose is exactly known."""
    spread = np.zeros((3, 3)) if covariance is None else covariance
    return WholeMap(np.zeros(0, dtype=np.uint32), pose, spread)


def join_submap(whole: WholeMap, local: LocalMap) -> WholeMap:
    """Compose the local map onto the current pose: known landmarks fused, new ones added.

    Raises NotACovarianceError where the known landmarks contradict the map numerically.
    """
    local = local.without_nodes
    after, fault = whole.joined(local.ids, local.mean, local.covariance)
    _raise_fault(fault)
    return after


def join_end_pose(
    whole: WholeMap, local: LocalMap, gate: float = math.inf
) -> tuple[PoseGaussian, int, int]:
    """Compute the pose of `join_submap` alone, with the numbers of common and of refused landmarks.

    gate: known landmarks whose constraints the others contradict by more are left out of the local
    map, worst first. By Baarda's test of a single constraint, T = zₗᵀ ((S⁻¹)ₗₗ)⁻¹ zₗ with the
    multiplier z = S⁻¹ y is the fall of the cost without that constraint; it is χ²-distributed with
    two degrees of freedom.
    """
    pose, covariance, known, refused, fault = whole.end_pose(
        local.ids, local.mean, local.covariance, gate
    )
    _raise_fault(fault)
    return PoseGaussian(pose, covariance), known, refused


def _raise_fault(fault: int) -> None:
    if fault == INDEFINITE:
        raise NotACovarianceError("the known landmarks' innovation", "not positive definite")
    if fault == SINGULAR:
        raise NotACovarianceError("a known landmark's innovation", "singular")


def remove_landmark(local: LocalMap, place: int) -> LocalMap:
    """Remove the landmark at this index from the local map."""
    rows = np.delete(np.arange(len(local.mean)), _coordinates(local, np.array([place])))
    ids = np.delete(local.ids, place)
    covariance = local.covariance[np.ix_(rows, rows)]
    return LocalMap(ids, local.mean[rows], covariance, local.node_stamps)


def _coordinates(local: LocalMap, index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    """Indices of the coordinates of landmarks in a submap's mean, after its poses."""
    return len(local.mean) - 2 * len(local.ids) + _points(index)


def _points(index: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " j"]:
    return (2 * index[:, None] + np.arange(2)).ravel()
