"""Decides which withdrawals a centre that is started again believes, from what robots report.

An order is in the cache of its author: an operator's command ends at once, and a centre that died
has lost its own orders. The robots repeat the orders that they have received, each under its own
key, and a lying robot must not be able to withdraw a teammate. So an order is believed from the
withdrawn robot itself, or from two other robots at least that are more than half of all others.
Where only one other robot is left (a team of two whose withdrawn robot has gone), the operator has
to repeat the order; orders that are not believed are named.
"""

from collections.abc import Sequence

from team.wire import messages as m

LEAST_WITNESSES = 2
"""Least number of other robots that report an order: no robot withdraws a teammate alone."""


class WithdrawalWitnesses:
    """The reports of robots about each withdrawal."""

    def __init__(self, robots: Sequence[str]) -> None:
        self._robots = frozenset(robots)
        self._reports: dict[str, dict[str, m.WithdrawalHeard]] = {}

    def admit(self, robot: str) -> None:
        """Add a robot to the team."""
        self._robots |= {robot}

    def take(self, report: m.WithdrawalHeard) -> m.Withdrawal | None:
        """Take a report; returns the order once it is believed. Reports of strangers are
        ignored.
        """
        if not {report.robot, report.withdrawn} <= self._robots:
            return None
        self._reports.setdefault(report.withdrawn, {})[report.robot] = report
        if not self._believed(report.withdrawn):
            return None
        return m.Withdrawal(
            stamp_ns=report.stamp_ns, robot=report.withdrawn, by=report.by, reason=report.reason
        )

    def _believed(self, robot: str) -> bool:
        witnesses = self._reports[robot].keys()
        others = len(self._robots) - 1
        return robot in witnesses or (
            len(witnesses) >= LEAST_WITNESSES and 2 * len(witnesses) > others
        )

    def unconfirmed(self, withdrawn: Sequence[str]) -> tuple[str, ...]:
        """The reported orders that are not believed and not known otherwise, in words, with the
        remedy.
        """
        return tuple(
            f"{', '.join(sorted(reporters))} report that {robot} is withdrawn, too few to be "
            f"believed: if it is, order it again by `teamslam withdraw {robot}`"
            for robot, reporters in sorted(self._reports.items())
            if robot not in withdrawn and not self._believed(robot)
        )
