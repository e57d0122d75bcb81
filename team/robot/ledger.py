"""Law 1's account: what has become of each measurement of an incarnation."""

from collections import Counter

from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.rejection import Rejection
from team.wire import messages as m

IN_SIGHTING = "in a sighting factor"
"""The disposition of a measurement of teammates that was used."""
INITIAL_POSE = "start pose"
"""The disposition of an incarnation's measurement 0."""


class Ledger:
    """How many measurements of an incarnation ended in which way.

    used: the disposition of a measurement that the estimator takes. A measurement is counted as
    used when it comes; the window that ends says which of them it has not used after all.
    """

    def __init__(self, used: str, resumed: int = 0) -> None:
        self.used = used
        self.counts = Counter({used: resumed} if resumed else {})
        self._sighted: set[int] = set()

    def count(self, rejected: Rejection | None, used: str | None = None) -> None:
        """One measurement more: rejected for this reason, or used."""
        taken = self.used if used is None else used
        self.counts[taken if rejected is None else rejected.disposition] += 1

    def count_sighting(self, number: int, rejected: Rejection | None) -> None:
        """One inter-robot measurement more; whether it finds its pose node the window says."""
        if rejected is None:
            self._sighted.add(number)
        self.count(rejected, IN_SIGHTING)

    def reject(self, count: int, reason: Rejection, used: str | None = None) -> None:
        """So many measurements that were counted as used were not, for this reason."""
        if count:
            self.counts[self.used if used is None else used] -= count
            self.counts[reason.disposition] += count

    def close(self, closed: ClosedWindow) -> None:
        """A window has become a submap, which names what it could not use."""
        self.leave_out(set().union(*(each.measurements for each in closed.sightings)))
        self.reject(closed.late, Rejection.LATE)
        self.reject(closed.unconfirmed, Rejection.UNCONFIRMED)
        self.reject(closed.clutter, Rejection.CLUTTER)
        self.reject(closed.unsolved, Rejection.UNSOLVED)

    def leave_out(self, used: set[int]) -> None:
        """The window ends: inter-robot measurements beyond those used reached no pose node."""
        self.reject(len(self._sighted - used), Rejection.NO_NODE, IN_SIGHTING)
        self._sighted.clear()

    def entries(self) -> tuple[m.Disposition, ...]:
        """The account as the robot's last word has it."""
        return tuple(
            m.Disposition(disposition=name, measurements=count)
            for name, count in sorted(self.counts.items())
            if count
        )
