"""Describe the seams at which the fold cut a stream: its robot was carried off or slipped.

With landmark names the fold makes no cut: the robust loss discounts the submap in which the robot
was carried off, and the diagnosis (`hypotheses`) names the jump.
"""

import math
from typing import NamedTuple

import numpy as np

from teamslam.central.withdrawal import SUSPICION, cost_share
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Stream, part_of
from teamslam.team.estimation.gaussian import NotACovarianceError, information
from teamslam.team.estimation.map_joining.gauss_newton import joint_marginal
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float

SEAM_DOF = 3.0
"""Degrees of freedom of a seam."""

Pose = Float[np.ndarray, "3"]


class CarriedOff(NamedTuple):
    """A motion of a robot that its odometry did not measure.

    before, after: the submaps around it. begin_ns, end_ns: end of the former, beginning of the
    latter. by: the motion in the map's frame (x [m], y [m], turn [rad]), once the later part has a
    place there. in_all: `by` includes the robot's own motion in a spoilt submap. evidence:
    log-likelihood ratio. place: (x, y) [m].
    """

    robot: str
    before: int
    after: int
    begin_ns: int
    end_ns: int
    by: tuple[float, ...]
    in_all: bool
    evidence: float
    place: tuple[float, ...] = ()


def cuts_of(fold: Fold) -> list[CarriedOff]:
    """Describe the cuts of a fold, and the motion where both parts are in one island.

    A part that lies where the odometry puts it was not carried off.
    """
    found = []
    for cut in fold.cuts:
        later = part_of(cut.stream, cut.after)
        island = fold.island(*cut.stream)
        place = island.state[island.graph.offset[island.graph.streams[cut.stream][-1]] :][:2]
        by: tuple[float, ...] = ()
        if fold.home.get(later, later) == fold.home[cut.stream]:
            gap, chi2 = _gap(fold, cut.stream, later)
            if cut.after == cut.before + 1 and cost_share(chi2, SEAM_DOF, SUSPICION) <= 1.0:
                continue
            if fold.island(*later).graph.first_sequence(later) == cut.after:
                by = (float(gap[0]), float(gap[1]), wrapped(gap[2]))
        found.append(
            CarriedOff(
                robot=cut.stream[0],
                before=cut.before,
                after=cut.after,
                begin_ns=cut.begin_ns,
                end_ns=cut.end_ns,
                by=by,
                in_all=cut.after > cut.before + 1,
                evidence=cut.evidence,
                place=(float(place[0]), float(place[1])),
            )
        )
    return found


def _gap(fold: Fold, earlier: Stream, later: Stream) -> tuple[Pose, float]:
    island = fold.islands[fold.home[earlier]]
    nodes = [island.graph.streams[earlier][-1], island.graph.streams[later][0]]
    mean, covariance = joint_marginal(island, nodes)
    gap = mean[3:] - mean[:3]
    gap[2] = wrapped(gap[2])
    J = np.hstack([-np.eye(3), np.eye(3)])
    spread = dense.product(dense.product(J, covariance), J.T)
    try:
        metric = information(spread, "a seam")
    except NotACovarianceError:
        return gap, math.inf
    return gap, float(dense.product(dense.product(gap, metric), gap))
