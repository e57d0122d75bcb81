"""Find the robot that contradicts the rest beyond chance, so that the team goes on without it.

A robot's disagreement is the largest of three figures, near or below 1 where its covariances are
right: its share of the joint cost per degree of freedom; the unweighted χ²/dof that most of its
submaps exceed, the newest if it has few; and that which most of the newest inter-robot measurements
by or of it exceed.

An overconfident robot, or one that fixes the frame, makes only others disagree. So each is left out
in turn, and withdrawn if the rest agree without it, and without no other. Two robots that
contradict each other, and no third, are reported and both stay, unless one contradicts itself when
alone.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np

from teamslam.team.estimation.map_joining.marginals import Agreement
from teamslam.team.shapes import Float

LEAST_SUBMAPS = 8  # least submaps for a median over all, and for withdrawal before the final map
FEWEST, NEWEST, MOST_OF = 2, 4, 3
"""With fewer submaps a robot is judged by the disagreement that MOST_OF its NEWEST ones exceed, or
all of FEWEST or more.
"""
AGREEING = 0.5  # share of the limit that no disagreement may exceed for the rest to agree
TRIED = 3
"""Most robots left out for a trial, the most suspect first; as many again of those that disagree
least, since the map follows an overconfident robot.
"""
LEAST_DOF = 3.0  # least degrees of freedom of a share of the joint cost that is judged
SUSPICION, ACCORD = 20.0, 7.0
"""Exponents of the chance that a sound robot's share exceeds `_bound`: for a suspect, and for one
no longer in accord with the rest.
"""

Without = Callable[[Collection[str]], Agreement | None]
"""Agreement of the team without some robots; None if none is left."""


@dataclass(frozen=True)
class Trial:
    """The robot that is wrong beyond chance; undecided: robots that contradict each other
    (opposed).
    """

    robot: str | None = None
    reason: str = ""
    undecided: str = ""
    opposed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Suspension:
    """Why a robot is left out of running maps; retried: size of the set at the next test."""

    reason: str
    retried: float


@dataclass(frozen=True)
class Conviction:
    """The robots that a fold leaves out by itself.

    suspended: left out until tested again. at: the last tick that this is based on. tested_from:
    the first tick tested under it.
    """

    withdrawn: Mapping[str, str] = field(default_factory=dict)
    suspended: Mapping[str, Suspension] = field(default_factory=dict)
    at: float = -math.inf
    tested_from: float = -math.inf

    def withdraw(self, robot: str, reason: str, at: float) -> "Conviction":
        """Withdraw one more robot."""
        without = self.acquit(robot, at, -math.inf)
        return replace(without, withdrawn={**self.withdrawn, robot: reason})

    def suspend(self, robot: str, suspension: Suspension, at: float) -> "Conviction":
        """Suspend one more robot."""
        suspended = {**self.suspended, robot: suspension}
        return replace(self, suspended=suspended, at=max(self.at, at), tested_from=-math.inf)

    def acquit(self, robot: str, at: float, tested_from: float) -> "Conviction":
        """Restore a suspended robot, to be tested."""
        suspended = {each: why for each, why in self.suspended.items() if each != robot}
        return replace(self, suspended=suspended, at=max(self.at, at), tested_from=tested_from)


def disagreement(
    agreement: Agreement, chance: float = SUSPICION, least: int = FEWEST
) -> dict[str, float]:
    """Return each robot's disagreement; costs of a probability above e^−chance do not count."""
    submaps = agreement.submaps
    seen: dict[str, list[tuple[float, float]]] = {}
    for observer, teammate, chi2 in agreement.sightings:
        for robot in (observer, teammate):
            seen.setdefault(robot, []).append((chi2, 2.0))
    found = {}
    for robot in sorted({*submaps.of_robots, *agreement.robots}):
        costs = submaps.table[:2, submaps.of_robots.get(robot, [])]
        of_submaps = _most(costs[:, costs[1] >= 1.0], chance, least)
        of_sightings = _most_of_newest(seen.get(robot, []), chance, NEWEST)
        share = _share(*agreement.robots.get(robot, (0.0, 0.0)), chance)
        values = [each for each in (of_submaps, of_sightings, share) if each is not None]
        if values:
            found[robot] = max(values)
    return found


def _most(costs: Float[np.ndarray, "2 n"], chance: float, least: int = FEWEST) -> float | None:
    """χ²/dof that most submaps exceed; costs: χ² and dof of each, oldest first."""
    chi2, dof = costs
    if len(dof) >= LEAST_SUBMAPS:
        return float(median((chi2 / dof).tolist()))
    return _most_of_newest(list(zip(chi2.tolist(), dof.tolist(), strict=True)), chance, least)


def _most_of_newest(
    costs: Sequence[tuple[float, float]], chance: float, least: int
) -> float | None:
    """χ²/dof that MOST_OF the NEWEST costs exceed, at most 1 where chance explains it; None with
    too few.

    The probability that k of n exceed χ² bounds of probability e^−x each is below C(n, k) e^(−kx).
    """
    if len(costs) < least:
        return None
    newest = costs[-NEWEST:]
    most = min(MOST_OF, len(newest))
    beyond = (chance + math.log(math.comb(len(newest), most))) / most
    shares = sorted(cost_share(chi2, dof, beyond) for chi2, dof in newest)
    return shares[-most]


def _share(chi2: float, dof: float, chance: float) -> float | None:
    """Joint cost per degree of freedom, at most 1 where chance explains it; None with too few. One
    without, or infinite, has overflown.
    """
    if not math.isfinite(chi2) or not math.isfinite(dof):
        return math.inf
    if chi2 <= _bound(max(dof, LEAST_DOF), chance):
        return None if dof < LEAST_DOF else min(chi2 / dof, 1.0)
    return chi2 / max(dof, LEAST_DOF)


def _bound(dof: float, chance: float) -> float:
    """χ² of a probability below e^−chance (Laurent & Massart 2000, lemma 1)."""
    return dof + 2.0 * math.sqrt(dof * chance) + 2.0 * chance


def find_suspects(agreement: Agreement, limit: float) -> list[str]:
    """List the robots with a disagreement above the limit, the most suspect first."""
    found = disagreement(agreement)
    wrong = sorted((-value, robot) for robot, value in found.items() if value > limit)
    return [robot for _, robot in wrong]


def hold_trial(agreement: Agreement, limit: float, without: Without) -> Trial:
    """Find the robot that is wrong beyond chance.

    It is the only one without which the rest agree, at least two of them; or the only one of those
    that contradicts itself.
    """
    found = disagreement(agreement)
    suspected = find_suspects(agreement, limit)
    if not suspected:
        return Trial()
    team = {*found, *agreement.robots}
    if _contradict_alone(suspected[:TRIED], team, limit, without) > 1:
        return Trial()
    others = sorted({*found} - {*suspected}, key=lambda robot: (found[robot], robot))
    candidates = [*suspected[:TRIED], *others[:TRIED]]
    cleared: dict[str, dict[str, float]] = {}
    for robot in candidates:
        rest = without({robot})
        left = {} if rest is None else disagreement(rest, ACCORD)
        if left and max(left.values()) <= AGREEING * limit:
            cleared[robot] = left
    wrong = [
        robot
        for robot in cleared
        if (len(cleared) == 1 and len(cleared[robot]) > 1)
        or _contradicts_itself(without(team - {robot}), robot, limit)
    ]
    if len(wrong) != 1:
        opposed = tuple(sorted(cleared))
        return Trial(undecided=_words_of(opposed, found), opposed=opposed)
    robot = wrong[0]
    return Trial(
        robot,
        f"its submaps contradict the rest: cost {_largest(found):.1f} per degree of freedom with "
        f"it; without it {_largest(cleared[robot]):.1f} or less",
    )


def _contradict_alone(
    robots: Collection[str], team: Collection[str], limit: float, without: Without
) -> int:
    """Count the robots whose submaps disagree when alone: noise that the team states too small."""
    if len(robots) < 2:
        return 0
    alone = (without({*team} - {robot}) for robot in robots)
    found = (disagreement(each, ACCORD) for each in alone if each is not None)
    return sum(max(each.values(), default=0.0) > AGREEING * limit for each in found)


def cost_share(chi2: float, dof: float, chance: float) -> float:
    """Cost per degree of freedom, at most 1 where e^−chance explains it."""
    share = _share(chi2, dof, chance)
    return 1.0 if share is None else share


def _contradicts_itself(alone: Agreement | None, robot: str, limit: float) -> bool:
    if alone is None:
        return False
    chi2, dof, *_ = alone.submaps.table.tolist()
    chance = SUSPICION + math.log(max(len(chi2), 1))
    costs = [cost_share(*each, chance) for each in zip(chi2, dof, strict=True)]
    return max([*costs, disagreement(alone).get(robot, 0.0)]) > limit


def _largest(found: Mapping[str, float]) -> float:
    return max(found.values())


def _words_of(opposed: tuple[str, ...], found: Mapping[str, float]) -> str:
    if len(opposed) < 2:
        return ""
    return (
        f"{', '.join(opposed)} contradict each other: cost {_largest(found):.1f} per degree of "
        "freedom together, none without one of them; nobody is withdrawn, as either may be wrong: "
        "check their data, then `teamslam withdraw` one"
    )
