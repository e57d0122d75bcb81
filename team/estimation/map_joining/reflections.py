"""A robot without landmark names whose bearings have the wrong sign.

Where its landmarks outweigh the odometry, its submaps fit each other, and their map is the
reflection of the place; where the odometry outweighs them, the stream is cut as if the robot had
been carried off. The robot's landmarks are therefore reflected and aligned with those of the
others. The match is judged by the number that is expected by chance (`distinctness`).
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.association.voting import PointSet, propose_alignments
from teamslam.team.estimation.contribution import is_map
from teamslam.team.estimation.map_joining.distinctness import (
    LEAST_PAIRS,
    MOST_POINTS,
    list_radii,
    log_by_chance,
)
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.shapes import Float

CHANCE = 1e-3  # probability that a robot that is not mirrored is found so
LEAST_SUBMAPS = 2  # least number of submaps of a landmark, of the robot or of the others
REFLECTION = np.array([1.0, -1.0])


class Reflection(NamedTuple):
    """A robot whose map fits the others' reflected; evidence: −ln of the expectation by chance."""

    robot: str
    evidence: float


def find_reflections(fold: Fold, robots: Iterable[str]) -> Iterator[Reflection]:
    """Find the robots whose map fits that of the others beyond chance only if it is reflected.

    robots: those that something else shows to be at fault, since the others' map fits as well.
    """
    for robot in robots:
        islands = [fold.islands[key] for key in sorted(fold.islands)]
        pairs = [
            (own, others)
            for first in islands
            if len(own := _landmarks(first, robot, is_own=True)) >= LEAST_PAIRS
            for second in islands
            if len(others := _landmarks(second, robot, is_own=False)) >= LEAST_PAIRS
        ]
        same = fold.main.settings.association.same
        limit = core.log(CHANCE / max(len(pairs) * len(list_radii(same)), 1))
        reflected = min((_by_chance(a * REFLECTION, b, same) for a, b in pairs), default=0.0)
        if reflected < limit <= min(_by_chance(a, b, same) for a, b in pairs):
            yield Reflection(robot, -reflected)


def _landmarks(island: Island, robot: str, *, is_own: bool) -> Float[np.ndarray, "n 2"]:
    """List the positions of landmarks that LEAST_SUBMAPS submaps of a robot, or others, observe."""
    counts = np.zeros(len(island.graph.fixed), np.int64)
    for each in island.graph.submaps:
        of = each.contribution
        if (of.robot == robot) is is_own and not is_map(of.stream):
            counts[each.landmarks[each.landmarks >= 0]] += 1
    return island.points(np.flatnonzero(counts >= LEAST_SUBMAPS))


def _by_chance(
    own: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "N 2"], same: float
) -> float:
    """Compute the least ln E of an alignment over the radii; 0 for maps too large to search."""
    if max(len(own), len(others)) > MOST_POINTS:
        return 0.0
    a, b = (PointSet(points, np.zeros(len(points))) for points in (own, others))
    longest = float(np.ptp(np.concatenate((own, others)), axis=0).max())
    found = [0.0]
    for radius in list_radii(same):
        votes = propose_alignments(a, b, radius, longest)
        matched = len(votes[0].first) if votes else 0
        if matched >= LEAST_PAIRS:
            found.append(log_by_chance(len(own), others, matched, radius))
    return min(found)
