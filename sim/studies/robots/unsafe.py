"""Demonstrate a violation of law 1: a robot that sends the team's map as its own information."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from teamslam.team import translate
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.core import WholeMap, check_packed_covariance
from teamslam.team.estimation.hybrid_slam.closed_window import ClosedWindow
from teamslam.team.estimation.map_joining.conditioning import RobotPrior, initial_map, join_submap
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import messages as m


def unsafe_robot(config: RobotConfig, exchange: Exchange) -> RobotNode:
    """A robot whose submaps begin with the team's map instead of with zero information.

    The map contains everyone's earlier measurements; each exchange counts them again. The mean
    hardly moves; the covariance loses its meaning. No scenario can choose it.
    """
    return RobotNode(config, exchange, replaced=_with_the_map)


def _with_the_map(
    closed: ClosedWindow, prior: m.Prior | None, submaps: Sequence[LocalMap]
) -> ClosedWindow:
    if prior is None:
        return closed
    pending = submaps[max(prior.sequence + 1, 0) :]
    fed = _feed(translate.prior_of(prior), pending, closed.local)
    return replace(closed, local=fed, sightings=())  # its pose nodes are gone


def _feed(prior: RobotPrior, pending: Sequence[LocalMap], local: LocalMap) -> LocalMap:
    """As `with_prior`; the window alone once the covariance has become singular."""
    try:
        fed = with_prior(prior, pending, local)
        check_packed_covariance(translate.joint_bytes(fed.covariance), len(fed.mean), "covariance")
    except ValueError:
        return local.without_nodes
    return fed


def with_prior(prior: RobotPrior, pending: Sequence[LocalMap], local: LocalMap) -> LocalMap:
    """The window's Gaussian times the team's marginal of its landmarks, both in its start frame.

    `pending` leads from the prior's pose to the start of the window.
    """
    whole = prior.whole
    for each in pending:
        whole = join_submap(whole, each)
    fed = join_submap(_express_in_its_pose(whole, local.ids), local)
    return LocalMap(fed.ids, fed.mean, fed.covariance)


def _express_in_its_pose(whole: WholeMap, ids: np.ndarray) -> WholeMap:
    """The landmarks `ids` of a map in the frame of its pose, which is then zero and certain.

    l' = R(θ)ᵀ (l − p), with its Jacobian.
    """
    chosen = np.flatnonzero(np.isin(whole.ids, ids))
    if not len(chosen):
        return initial_map(np.zeros(3), None)
    x, y, heading = whole.mean[:3]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s], [-s, c]])
    J = np.zeros((3 + 2 * len(chosen), len(whole.mean)))
    mean = np.zeros(len(J))
    for row, k in enumerate(chosen):
        rows, columns = slice(3 + 2 * row, 5 + 2 * row), slice(3 + 2 * k, 5 + 2 * k)
        offset = whole.mean[columns] - (x, y)
        mean[rows] = turn @ offset
        J[rows, :2] = -turn
        J[rows, 2] = np.array([[-s, c], [-c, -s]]) @ offset
        J[rows, columns] = turn
    covariance = J @ whole.covariance @ J.T
    return WholeMap(whole.ids[chosen], mean, 0.5 * (covariance + covariance.T))
