"""Points known in the frames of two islands, and the alignments that they allow.

Such a point is a shared landmark, or a teammate observed from a pose node: in the observer's island
it lies at pose ∘ (range, bearing), in its own island at its pose node. An inter-robot measurement
and the reverse one are two points.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining import alignment
from teamslam.team.estimation.map_joining.gauss_newton import Island, joint_marginal
from teamslam.team.estimation.map_joining.saved_maps import LEAST_AGREEING, agreeing
from teamslam.team.estimation.map_joining.submap_graph import Graph, observer_of, teammate_of
from teamslam.team.estimation.models import located
from teamslam.team.estimation.se2 import transformed
from teamslam.team.shapes import Float

JointPoints = tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m m"]]
"""n points [m] and their joint covariance, m = 2n."""
HEADINGS = 24
MOST_POINTS = 24
"""Most points for which more than the best heading is tried: more points do not fit at two
headings, and would make the search slow.
"""
MOST_FIXES = 60
"""Most fixes by which islands are aligned: the work grows with the cube of their number."""
HOPELESS = 100.0
"""Rise of χ² above the best heading's beyond which a heading is not tried."""


class SharedPoint(NamedTuple):
    """One point: its node in the main island and in the other, and the measurement that ties them.

    seen: the inter-robot measurement; None for a shared landmark. from_main: the observer is in the
    main island, whose node is then the observer's. The measured point is at `seen.point` of the
    teammate.
    """

    main: int
    other: int
    seen: InterRobotFactor | None = None
    from_main: bool = False


def ties(main: Graph, other: Graph, sightings: Sequence[InterRobotFactor]) -> list[SharedPoint]:
    """List the shared landmarks by id, then the inter-robot measurements between the islands in
    order.
    """
    shared = sorted(main.landmarks.keys() & other.landmarks.keys())
    found = [SharedPoint(main.landmarks[id_], other.landmarks[id_]) for id_ in shared]
    for each in sightings:
        for observers, seen, from_main in ((main, other, True), (other, main, False)):
            observer, teammate = observer_of(observers, each), teammate_of(seen, each)
            if observer is not None and teammate is not None:
                nodes = (observer, teammate) if from_main else (teammate, observer)
                found.append(SharedPoint(*nodes, each, from_main))
    return found


def sound_ties(
    main: Island, other: Island, tied: Sequence[SharedPoint]
) -> tuple[list[SharedPoint], list[InterRobotFactor]]:
    """Return the points by which islands are aligned, and the fixes that are left out of it.

    At most MOST_FIXES fixes are used, evenly spaced in time. Of these, those that no rigid motion
    places together with most of the others are left out; the robust loss discounts them once the
    islands are one.
    """
    every = [each for each in tied if each.seen is not None and each.seen.is_fix]
    if len(every) <= LEAST_AGREEING:
        return list(tied), []
    fixes = every[:: -(-len(every) // MOST_FIXES)]
    in_main = _points(main, [(t.main, t.seen, t.from_main) for t in fixes])
    in_other = _points(other, [(t.other, t.seen, not t.from_main) for t in fixes])
    limit = chi2_limit(2, 1.0 - main.settings.alignment_confidence)
    agree = agreeing(*in_main, *in_other, limit).tolist()
    sound = {id(each) for each, is_one in zip(fixes, agree, strict=True) if is_one}
    aside = [each for each in every if id(each) not in sound]
    out = {id(each) for each in aside}
    seen = [each.seen for each in aside if each.seen is not None]
    return [each for each in tied if id(each) not in out], seen


def aligned_by(
    main: Island, other: Island, tied: Sequence[SharedPoint]
) -> alignment.Alignment | None:
    """Align the other island with the main one; None where the points do not suffice."""
    if len(tied) < alignment.NEEDED:
        return None
    in_main = _points(main, [(t.main, t.seen, t.from_main) for t in tied])
    in_other = _points(other, [(t.other, t.seen, not t.from_main) for t in tied])
    return alignment.align(*in_main, *in_other)


def _points(island: Island, at: Sequence[tuple[int, InterRobotFactor | None, bool]]) -> JointPoints:
    """Return the positions of nodes, of the teammates measured from them, or of their own measured
    points, with joint covariance.

    at: node, measurement, and whether the node is the observer's.
    """
    mean, covariance = joint_marginal(island, [node for node, _, _ in at])
    points = np.empty((len(at), 2))
    J = np.zeros((2 * len(at), len(mean)))
    noise = np.zeros((2 * len(at), 2 * len(at)))
    begin = 0
    for k, (node, seen, is_observer) in enumerate(at):
        rows, value = slice(2 * k, 2 * k + 2), mean[begin:]
        J[rows, begin : begin + 2] = np.eye(2)
        points[k] = value[:2]
        if seen is not None and not is_observer and seen.is_fix:
            points[k] = transformed(value[:3], seen.point)
            x, y = points[k] - value[:2]
            J[rows, begin + 2] = -y, x
        elif seen is not None and is_observer:
            distance, bearing = float(seen.measurement[0]), float(seen.measurement[1])
            points[k] = located(value[:3], distance, bearing)
            x, y = points[k] - value[:2]
            J[rows, begin + 2] = -y, x
            direction = core.atan2(y, x)
            s, c = core.sin_and_cos(direction)
            polar = np.array([[c, -distance * s], [s, distance * c]])
            noise[rows, rows] = dense.product(dense.product(polar, seen.covariance), polar.T)
        begin += int(island.graph.offset[node + 1] - island.graph.offset[node])
    return points, dense.product(dense.product(J, covariance), J.T) + noise


def headings_that_fit(
    main: Island, other: Island, tied: Sequence[SharedPoint]
) -> list[Float[np.ndarray, "3"]]:
    """Find every main_from_other whose heading is a local minimum of the shared points' χ².

    The best translation at each heading of a grid follows in closed form from the joint covariance
    of the points. Headings worse by more than HOPELESS are left out; with more than MOST_POINTS
    points only the best one is returned.
    """
    if not alignment.NEEDED <= len(tied) <= MOST_POINTS:
        return []
    in_main = _points(main, [(t.main, t.seen, t.from_main) for t in tied])
    in_other = _points(other, [(t.other, t.seen, not t.from_main) for t in tied])
    grid = [2.0 * math.pi * k / HEADINGS - math.pi for k in range(HEADINGS)]
    found = [alignment.fit_at_heading(*in_main, *in_other, heading) for heading in grid]
    costs = [chi2 for _, chi2 in found]
    limit = min(costs) + HOPELESS
    return [
        np.array([*shift, heading])
        for k, (heading, (shift, chi2)) in enumerate(zip(grid, found, strict=True))
        if chi2 <= min(costs[k - 1], costs[(k + 1) % HEADINGS], limit)
    ]
