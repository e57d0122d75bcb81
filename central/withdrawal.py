"""Finds the robot that contradicts the rest beyond chance, so that the team goes on without it.

A robot's disagreement is the median over its submaps of χ²/dof at the joint estimate: near or below
1 for a robot whose covariances are right, whatever a few of its submaps are. One wrong robot
distorts the map and makes others disagree, too. So it is found by leaving out: a robot is withdrawn
only if the rest agree without it; where only one other robot is left, only if it contradicts itself
when alone, since of two that disagree either may be wrong.
"""

from collections.abc import Callable, Collection
from statistics import median

from team.estimation.map_joining.marginals import Agreement

LEAST_SUBMAPS = 8
"""Least number of submaps of a robot for it to be judged."""
AGREEING = 0.5
"""The rest agree if no disagreement is above this share of the limit."""
TRIED = 3
"""Most robots that are left out for a trial, the most suspect first."""

Without = Callable[[Collection[str]], Agreement | None]
"""The agreement of the team without some robots; None: nothing is left."""


def disagreement(agreement: Agreement) -> dict[str, float]:
    """The median of χ²/dof over the submaps of each robot that has enough of them."""
    ratios: dict[str, list[float]] = {}
    for (robot, _), _, chi2, dof, _ in agreement.submaps:
        if dof >= 1.0:
            ratios.setdefault(robot, []).append(chi2 / dof)
    return {r: median(ratios[r]) for r in sorted(ratios) if len(ratios[r]) >= LEAST_SUBMAPS}


def suspects(agreement: Agreement, limit: float) -> list[str]:
    """The robots whose disagreement is above the limit, the most suspect first."""
    found = disagreement(agreement)
    wrong = sorted((-value, robot) for robot, value in found.items() if value > limit)
    return [robot for _, robot in wrong]


def convicted(agreement: Agreement, limit: float, without: Without) -> tuple[str, str] | None:
    """The robot that is wrong beyond chance, and why, in words; None if there is none."""
    found = disagreement(agreement)
    verdicts = []
    for robot in suspects(agreement, limit)[:TRIED]:
        rest = without({robot})
        if rest is None:
            continue
        others = disagreement(rest)
        if not others or max(others.values()) > AGREEING * limit:
            continue
        if len(others) == 1:
            alone = without(others)
            if alone is None or disagreement(alone).get(robot, 0.0) <= limit:
                continue
        verdicts.append((max(others.values()), robot))
    if not verdicts:
        return None
    agreed, robot = min(verdicts)
    return robot, (
        f"its submaps contradict the rest: median cost {found[robot]:.1f} per degree of freedom; "
        f"without it the others' is {agreed:.1f} or less"
    )
