"""Detect a pose covariance that understates the uncertainty: a curved valley of the cost.

One heading is displaced and everything else solved given it: the profile of the cost (Bates & Watts
1988, chapter 6). For a quadratic cost its rise is the χ² of the displacement.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Stream, named
from teamslam.team.estimation.gaussian import deviation, information
from teamslam.team.estimation.map_joining.gauss_newton import (
    FULL_AGE,
    Island,
    age_factors,
    joint_marginal,
    solve_with_fixed,
)
from teamslam.team.estimation.se2 import compose, inverse, logarithm

STEPS = (1.0, 2.0, 3.0)  # displacements of a heading, in its standard deviations
ITERATIONS = 4
SHORTEST = 0.01  # squared length, in standard deviations, of the last step
STRAIGHT_RAD = 0.1  # deviation [rad] of a heading below which the cost is taken as quadratic
BENT = 4.0  # reported ratio of χ² to the rise of the cost: the ellipse is too short by half
UNLIKELY = 10.8275661707  # rise of the cost of an unlikely place: `chi2_limit(1, 1e-3)`


class UnderstatedUncertainty(NamedTuple):
    """Displacement [m] of a pose, rise of the cost there, χ² by the pose's covariance."""

    distance: float
    rise: float
    chi2: float

    @property
    def ratio(self) -> float:
        """χ² over the rise of the cost; 1 for a quadratic cost."""
        return self.chi2 / max(self.rise, 1.0)


def heading_sigma(island: Island, node: int) -> float:
    """Compute the standard deviation [rad] of a pose's heading; 0 for a given pose."""
    graph = island.graph
    if graph.fixed[node]:
        return 0.0
    return deviation(graph.pattern.block(island.selected_covariance, node, node)[2, 2])


def profile(island: Island, node: int) -> Iterator[tuple[Island, float]]:
    """Profile the cost: islands with one heading displaced, and each rise.

    Empty if the heading deviates by less than STRAIGHT_RAD.
    """
    _, covariance = joint_marginal(island, [node])
    sigma = deviation(covariance[2, 2])
    if sigma < STRAIGHT_RAD:
        return
    island = age_factors(island, FULL_AGE)
    heading = int(island.graph.offset[node]) + 2
    for sign in (1.0, -1.0):
        walked = island
        for before, after in zip((0.0, *STEPS), STEPS, strict=False):
            by = sign * (after - before) * sigma
            walked = solve_with_fixed(walked, heading, by, ITERATIONS, shortest=SHORTEST)
            rise = walked.cost - island.cost
            if not rise <= UNLIKELY:  # nor where the cost is no number
                break
            yield walked, rise


def ends(island: Island) -> list[tuple[Stream, str, int]]:
    """List the first and last pose of every stream unless given, with a word for each."""
    return [
        (stream, where, nodes[k])
        for stream, nodes in sorted(island.graph.streams.items())
        for where, k in (("started", 0), ("ended", -1))
        if not island.graph.fixed[nodes[k]]
    ]


def understated_uncertainty(island: Island, node: int) -> UnderstatedUncertainty | None:
    """Find the likely place of a pose that its covariance understates most."""
    mean, covariance = joint_marginal(island, [node])
    # The χ² is that of the motion mean ∘ Exp(η), so that a turn about a far point is not taken for
    # a bend; to first order η = A (dx, dy, dθ), whatever the distance to the frame's origin.
    s, c = core.sin_and_cos(mean[2])
    A = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    metric = information(dense.congruent(A, covariance), "a pose")
    found = []
    for walked, rise in profile(island, node):
        pose = walked.value(node)
        eta = logarithm(compose(inverse(mean), pose))
        distance = core.hypot(*(pose - mean)[:2])
        found.append(UnderstatedUncertainty(distance, rise, dense.quadratic(metric, eta)))
    worst = max(found, key=lambda each: each.ratio, default=None)
    return None if worst is None or worst.ratio < BENT else worst


def nonlinearity_warnings(island: Island) -> list[str]:
    """Warn where the covariance of a first or last pose understates its uncertainty."""
    texts = []
    for stream, where, node in ends(island):
        if island.graph.fixed[island.graph.streams[stream][0]]:
            continue
        found = understated_uncertainty(island, node)
        if found is not None:
            texts.append(
                f"{named(stream)} may have {where} farther off than its covariance allows: "
                f"{found.distance:.1f} m away for {found.rise:.1f} more in chi², by the "
                f"covariance {found.chi2:.0f}"
            )
    return texts
