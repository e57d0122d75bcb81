"""What a centre that is started again believes of withdrawals that robots say they have heard.

An order lives in the cache of who gave it: an operator's command ends at once, and a centre that
died has lost its own. The robots repeat what they heard, each under its own key, and one that lies
must not be able to withdraw a teammate. So an order is believed from the robot that it withdraws,
or from two others at the least, if they are more than half of all others. Hence, where only one
other robot is left to say it (a team of two whose withdrawn robot has gone), the operator has to
repeat the order: what is not believed is named.
"""

from collections.abc import Sequence

from team.wire import messages as m

LEAST_WITNESSES = 2
"""Robots that say the same of another one: nobody withdraws a teammate alone."""


class WithdrawalWitnesses:
    """Who has said what about whose withdrawal."""

    def __init__(self, robots: Sequence[str]) -> None:
        self._robots = frozenset(robots)
        self._said: dict[str, dict[str, m.WithdrawalHeard]] = {}

    def admit(self, robot: str) -> None:
        """From now on the robot is in the team."""
        self._robots |= {robot}

    def take(self, heard: m.WithdrawalHeard) -> m.Withdrawal | None:
        """The order, once it is to be believed; strangers are not listened to."""
        if not {heard.robot, heard.withdrawn} <= self._robots:
            return None
        self._said.setdefault(heard.withdrawn, {})[heard.robot] = heard
        if not self._believed(heard.withdrawn):
            return None
        return m.Withdrawal(
            stamp_ns=heard.stamp_ns, robot=heard.withdrawn, by=heard.by, reason=heard.reason
        )

    def _believed(self, robot: str) -> bool:
        witnesses = self._said[robot].keys()
        others = len(self._robots) - 1
        return robot in witnesses or (
            len(witnesses) >= LEAST_WITNESSES and 2 * len(witnesses) > others
        )

    def unconfirmed(self, withdrawn: Sequence[str]) -> tuple[str, ...]:
        """What is not believed and not known otherwise, in words, with the remedy."""
        return tuple(
            f"{', '.join(sorted(said))} heard that {robot} is withdrawn, too few to be believed: "
            f"if it is, order it again by `teamslam withdraw {robot}`"
            for robot, said in sorted(self._said.items())
            if robot not in withdrawn and not self._believed(robot)
        )
