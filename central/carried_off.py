"""Describe the seams at which the fold cut a stream: its robot was carried off or slipped.

With landmark names the fold makes no cut; the diagnosis (`hypotheses`) names the jump.
"""

import math
from collections.abc import Iterator

import numpy as np

from teamslam.central.withdrawal import SUSPICION, cost_share
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Stream, part_of
from teamslam.team.estimation.gaussian import NotACovarianceError, information
from teamslam.team.estimation.map_joining.gauss_newton import joint_marginal
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.se2 import wrapped
from teamslam.team.shapes import Float
from teamslam.team.wire import messages as m

SEAM_DOF = 3.0
"""Degrees of freedom of a seam."""

Pose = Float[np.ndarray, "3"]
REMEDY = "leave the robot on the ground, or restart its process where it is put down"
START_REMEDY = "correct its initial pose by that, or remove it: a robot is joined without one"
OTHER_START = "; two initial poses contradict each other, so {other}'s may be the wrong one"
"""Of a team with two known initial poses: a majority would tell."""


def cuts_of(fold: Fold) -> Iterator[m.Diagnosis]:
    """Describe the cuts of a fold, with the motion in the map's frame (x [m], y [m], turn [rad])
    where both parts are in one island. A part that lies where the odometry puts it was not carried
    off.
    """
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
        yield m.Diagnosis(
            cause="carried_off",
            robot=cut.stream[0],
            value=by,
            evidence=cut.evidence,
            remedy=REMEDY,
            at_ns=cut.begin_ns,
            place=(float(place[0]), float(place[1])),
        )


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
