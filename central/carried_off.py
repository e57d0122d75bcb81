"""Find where a robot was carried off, or slipped, and by how much.

Without landmark names the fold cuts its stream there (`continuity`). A robot with named landmarks
that contradicts the rest is examined as follows; its stream is cut at the seam that is found, and
only where none is found is it withdrawn.

Each submap of the robot that shares enough named landmarks with the map of the others is aligned to
it in the frame of its start pose and in that of its end pose. The end of one submap and the start
of the next are one pose: a seam. A robot that was carried off contradicts the map at exactly one
seam; every submap fits the map and every other seam is closed. A wrong sensor or odometry deforms
the submaps, or opens many seams: then nothing is found. A submap absorbs a small motion shortly
before its end: the seam after it shows only a part.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from teamslam.central.withdrawal import ACCORD, AGREEING, SUSPICION, cost_share
from teamslam.team import core
from teamslam.team.config import UNNAMED
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Contribution, Stream, part_of
from teamslam.team.estimation.gaussian import NotACovarianceError, information
from teamslam.team.estimation.map_joining.alignment import Alignment, aligned
from teamslam.team.estimation.map_joining.continuity import Seam
from teamslam.team.estimation.map_joining.gauss_newton import joint_marginal
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.landmark_view import known
from teamslam.team.estimation.map_joining.marginals import landmark_blocks
from teamslam.team.estimation.se2 import compose, wrapped
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.shapes import Float, Int64

LEAST_SHARED = 3
"""Least number of landmarks that a submap shares with the map: two also fit their mirror image."""
LEAST_BEFORE, LEAST_AFTER = 2, 1
"""Least number of submaps that fit the map before and behind the open seam."""
SEAM_DOF = 3.0
"""Degrees of freedom of a seam."""
MOST_SHARED = 40
"""Most landmarks of a submap that are aligned, by smallest id."""
MOST_SUBMAPS = 2000
"""Longer streams are not examined: it would take seconds."""

Pose = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "m m"]


class CarriedOff(NamedTuple):
    """A motion of a robot that its odometry did not measure.

    before, after: numbers of the last submap before it and of the first one after it. begin_ns,
    end_ns: their end and beginning, equal where no submap is between. by: the motion in the map's
    frame (x [m], y [m], turn [rad]). in_all: `by` includes the robot's own motion between the two,
    since the submap between them is spoilt. evidence: χ² of the open seams per degree of freedom,
    or the log-likelihood ratio of a view that changed at once. place: (x, y) [m] in
    the map; of a cut stream only. `by` is empty, where the stream was cut, until its later part has
    a place in the map.
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


class _Placed(NamedTuple):
    """A submap that fits the map: its place in the chain, its start and end pose."""

    at: int
    start: Alignment
    end: Alignment


class _Seam(NamedTuple):
    """Two consecutive submaps, by their places in the chain.

    gap: the motion, in the map's frame, from the end of the one to the start of the other, less the
    robot's own; chi2: its χ².
    """

    before: int
    after: int
    gap: Pose
    chi2: float


def carried_off(rest: Fold, chain: Sequence[Contribution], limit: float) -> CarriedOff | None:
    """Find the seam at which a robot was carried off; None where its submaps do not show exactly
    that.

    rest: the team without the robot. chain: the submaps of one of its streams, in order. limit:
    cost per degree of freedom above which a seam is open, unless chance explains it. The other
    seams agree if their total is at most the share AGREEING of it or within chance, and less than
    that of the open one. A submap in which the robot was carried off may fit nothing, or leave both
    its seams open.
    """
    if not rest.home or len(chain) > MOST_SUBMAPS:
        return None
    placed, misfits = _placed(rest, chain, limit)
    seams = [_seam(chain, one, two) for one, two in pairwise(placed)]
    opened = [each for each in seams if cost_share(each.chi2, SEAM_DOF, SUSPICION) > limit]
    if (
        not opened
        or len(opened) > 2
        or opened[0].after not in (opened[-1].before, opened[-1].after)
    ):
        return None
    before, after = opened[0].before, opened[-1].after
    spoilt = [*misfits, *(each.after for each in opened[:-1])]
    at = {each.before for each in opened}
    closed = [each.chi2 for each in seams if each.before not in at]
    others = math.fsum(closed)
    if (
        len(spoilt) > 1
        or any(not before < k < after for k in spoilt)
        or sum(each.at <= before for each in placed) < LEAST_BEFORE
        or sum(each.at >= after for each in placed) < LEAST_AFTER
        or cost_share(others, SEAM_DOF * len(closed), ACCORD) > AGREEING * limit
        or others > max(each.chi2 for each in opened)
    ):
        return None
    start = next(each.start for each in placed if each.at == after).a_from_b
    end = next(each.end for each in placed if each.at == before).a_from_b
    by = start - end if spoilt else opened[0].gap
    return CarriedOff(
        robot=chain[before].robot,
        before=chain[before].sequence,
        after=chain[after].sequence,
        begin_ns=chain[before].end_ns,
        end_ns=chain[after - 1].end_ns,
        by=(float(by[0]), float(by[1]), wrapped(by[2])),
        in_all=bool(spoilt),
        evidence=math.fsum(each.chi2 for each in opened) / (SEAM_DOF * len(opened)),
    )


def seam_of(chain: Sequence[Contribution], found: CarriedOff) -> Seam:
    """Return the seam at which a stream is cut for its later submaps to keep their own place."""
    stream, before, after = chain[0].stream, found.before, found.after
    evidence = 0.5 * SEAM_DOF * found.evidence
    return Seam(stream, before, after, found.begin_ns, found.end_ns, evidence)


def cuts_of(fold: Fold) -> list[CarriedOff]:
    """Describe the seams at which a fold has cut streams, and the motion where both parts are in
    one island.

    Not carried off is a part that lies where the odometry puts it.
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
    """Return the motion from the end of a part to the oldest start of the next one, and its χ²."""
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


def _placed(
    rest: Fold, chain: Sequence[Contribution], limit: float
) -> tuple[list[_Placed], list[int]]:
    """Return the submaps that fit the map, and the places in the chain of those that do not.

    Submaps that share too few landmarks are neither. The map's landmarks count as independent: an
    error that they share moves both sides of a seam alike.
    """
    ids, points, blocks = landmark_blocks(rest, [i for i in known(rest.main) if i < UNNAMED])
    placed, misfits = [], []
    for at, each in enumerate(chain):
        _, in_map, own = np.intersect1d(ids, each.local.ids, return_indices=True)
        in_map, own = in_map[:MOST_SHARED], own[:MOST_SHARED]
        if len(own) < LEAST_SHARED:
            continue
        covariance = rest.main.settings.covariance_factor * each.local.covariance
        spread = _block_diagonal(blocks[in_map])
        try:
            start = aligned(points[in_map], spread, *_from_start(each.local, covariance, own))
            end = aligned(points[in_map], spread, *_from_end(each.local, covariance, own))
        except NotACovarianceError:
            misfits.append(at)
            continue
        if cost_share(start.chi2, float(start.dof), SUSPICION) > limit:
            misfits.append(at)
        else:
            placed.append(_Placed(at, start, end))
    return placed, misfits


def _block_diagonal(blocks: Float[np.ndarray, "n 2 2"]) -> Matrix:
    n = len(blocks)
    matrix = np.zeros((n, 2, n, 2))
    matrix[np.arange(n), :, np.arange(n)] = blocks
    return matrix.reshape(2 * n, 2 * n)


def _from_start(
    local: LocalMap, covariance: Matrix, own: Int64[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "k k"]]:
    at = _numbers(local, own)
    return local.landmarks[own], covariance[np.ix_(at, at)]


def _from_end(
    local: LocalMap, covariance: Matrix, own: Int64[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "k k"]]:
    """Express landmarks of a submap, with covariance, in the frame of its end pose e: Rᵀ(l − e).

    ∂/∂l = Rᵀ, ∂/∂e = −Rᵀ, and ∂/∂θ = (y, −x) of the result.
    """
    s, c = core.sin_and_cos(float(local.end_pose[2]))
    back = np.array([[c, s], [-s, c]])
    points = dense.product(local.landmarks[own] - local.end_pose[:2], back.T)
    n = len(own)
    jacobian = np.zeros((n, 2, 3 + 2 * n))
    jacobian[:, :, :2] = -back
    jacobian[:, 0, 2], jacobian[:, 1, 2] = points[:, 1], -points[:, 0]
    for k in range(n):
        jacobian[k, :, 3 + 2 * k : 5 + 2 * k] = back
    J = jacobian.reshape(2 * n, 3 + 2 * n)
    at = np.concatenate([np.arange(3), _numbers(local, own)])
    return points, dense.product(dense.product(J, covariance[np.ix_(at, at)]), J.T)


def _numbers(local: LocalMap, own: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
    first = len(local.mean) - 2 * len(local.ids)
    return (first + 2 * own[:, None] + np.arange(2)).ravel()


def _seam(chain: Sequence[Contribution], one: _Placed, two: _Placed) -> _Seam:
    pose, covariance = one.end.a_from_b, one.end.covariance
    for each in chain[one.at + 1 : two.at]:
        step = each.local.end_pose
        s, c = core.sin_and_cos(float(pose[2]))
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        after = compose(pose, step)
        lever = np.eye(3)
        lever[0, 2], lever[1, 2] = pose[1] - after[1], after[0] - pose[0]
        covariance = dense.product(dense.product(lever, covariance), lever.T) + dense.product(
            dense.product(turned, each.local.covariance[:3, :3]), turned.T
        )
        pose = after
    gap = two.start.a_from_b - pose
    gap[2] = wrapped(gap[2])
    try:
        metric = information(covariance + two.start.covariance, "a seam")
    except NotACovarianceError:
        return _Seam(one.at, two.at, gap, math.inf)
    return _Seam(one.at, two.at, gap, float(dense.product(dense.product(gap, metric), gap)))
