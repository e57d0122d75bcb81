"""The ledger of law 1: the disposition of each measurement of an incarnation."""

from collections import Counter

from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.rejection import Rejection
from team.wire import messages as m

IN_SIGHTING = "in a sighting factor"
"""The disposition of an inter-robot measurement that was used."""
INITIAL_POSE = "start pose"
"""The disposition of an incarnation's measurement 0."""


class Ledger:
    """Counts the measurements of an incarnation by their disposition.

    used: the disposition of a measurement that the estimator takes. A measurement is counted as
    used when it arrives; when its window ends, those that it has not used are moved to their
    reason.
    """

    def __init__(self, used: str, resumed: int = 0) -> None:
        self.used = used
        self.counts = Counter({used: resumed} if resumed else {})
        self._sighted: set[int] = set()

    def count(self, rejected: Rejection | None, used: str | None = None) -> None:
        """Count a measurement: rejected for this reason, or used."""
        taken = self.used if used is None else used
        self.counts[taken if rejected is None else rejected.disposition] += 1

    def count_sighting(self, number: int, rejected: Rejection | None) -> None:
        """Count an inter-robot measurement; its window decides whether it reaches a pose node."""
        if rejected is None:
            self._sighted.add(number)
        self.count(rejected, IN_SIGHTING)

    def reject(self, count: int, reason: Rejection, used: str | None = None) -> None:
        """Move measurements that were counted as used to this reason for rejection."""
        if count:
            self.counts[self.used if used is None else used] -= count
            self.counts[reason.disposition] += count

    def close(self, closed: ClosedWindow) -> None:
        """Take the dispositions of a window that has become a submap."""
        self.leave_out(set().union(*(each.measurements for each in closed.sightings)))
        self.reject(closed.late, Rejection.LATE)
        self.reject(closed.unconfirmed, Rejection.UNCONFIRMED)
        self.reject(closed.clutter, Rejection.CLUTTER)
        self.reject(closed.unsolved, Rejection.UNSOLVED)

    def leave_out(self, used: set[int]) -> None:
        """Reject a window's inter-robot measurements that reached no pose node."""
        self.reject(len(self._sighted - used), Rejection.NO_NODE, IN_SIGHTING)
        self._sighted.clear()

    def entries(self) -> tuple[m.Disposition, ...]:
        """The dispositions as the robot's `Done` reports them."""
        return tuple(
            m.Disposition(disposition=name, measurements=count)
            for name, count in sorted(self.counts.items())
            if count
        )
