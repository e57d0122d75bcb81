"""The ledger of law 1: the disposition of each measurement."""

from collections import defaultdict
from collections.abc import Callable, Iterable

from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.rejection import Rejection
from teamslam.team.wire import messages as m

IN_SIGHTING = "in a sighting factor"  # disposition of a used inter-robot measurement
INITIAL_POSE = "start pose"  # disposition of an incarnation's measurement 0

OnDisposition = Callable[[int, str], None]
"""Receives the counter of a measurement and its disposition, which replaces an earlier one."""


class Ledger:
    """Numbers of an incarnation's measurements by disposition.

    used: disposition of an accepted measurement, counted on arrival. Scans and inter-robot
    measurements are stored until the closing window lists those not used.
    """

    def __init__(
        self, used: str, resumed: int = 0, on_disposition: OnDisposition | None = None
    ) -> None:
        self.used = used
        self.counts: dict[str, int] = defaultdict(int, {used: resumed} if resumed else {})
        self._on_disposition = on_disposition
        self._scans: dict[int, int] = {}
        self._detections: dict[int, int] = {}
        self._sighted: set[int] = set()

    def count(self, measurement: m.Measurement, rejected: Rejection | None) -> None:
        """Count a measurement: rejected for this reason, or used."""
        number, disposition = measurement.number, self.used
        if rejected is not None:
            disposition = rejected.disposition
        elif type(measurement) in m.ODOMETRY:  # first: most measurements are
            pass
        elif type(measurement) is m.InitialPose:
            disposition = INITIAL_POSE
        elif type(measurement) in (m.Sightings, m.Fix):
            self._sighted.add(number)
            disposition = IN_SIGHTING
        else:
            self._scans[number] = measurement.stamp_ns
            if type(measurement) is m.Detections:
                self._detections[number] = measurement.stamp_ns
        self.counts[disposition] += 1
        if self._on_disposition is not None:
            self._on_disposition(number, disposition)

    def _reject(self, numbers: Iterable[int], reason: Rejection, used: str) -> None:
        for number in numbers:
            self.counts[used] -= 1
            self.counts[reason.disposition] += 1
            if self._on_disposition is not None:
                self._on_disposition(number, reason.disposition)
            self._scans.pop(number, None)
            self._detections.pop(number, None)

    def _last_scans(self, count: int) -> list[int]:
        by_stamp = sorted(self._scans, key=lambda number: (self._scans[number], number))
        return by_stamp[len(by_stamp) - count :]

    def cover(self, until_ns: int) -> None:
        """Count every scan up to this time as used, for an estimator without windows."""
        self._scans = {n: at_ns for n, at_ns in self._scans.items() if at_ns > until_ns}
        self._detections.clear()

    def close(self, closed: ClosedWindow) -> None:
        """Recount the measurements that a closed window rejects."""
        self.leave_out(set().union(*(each.measurements for each in closed.sightings)))
        if closed.late:
            self._reject(self._last_scans(closed.late), Rejection.LATE, self.used)
        behind = {n: at_ns for n, at_ns in self._scans.items() if at_ns > closed.end_ns}
        if closed.unsolved:
            self._reject(sorted(self._scans.keys() - behind), Rejection.UNSOLVED, self.used)
        for at_ns, is_clutter in () if closed.became is None else closed.became.silent:
            number = next((n for n, at in self._detections.items() if at == at_ns), None)
            if number is not None:
                reason = Rejection.CLUTTER if is_clutter else Rejection.UNCONFIRMED
                self._reject([number], reason, self.used)
        self._scans = behind
        self._detections.clear()

    def leave_out(self, used: set[int]) -> None:
        """Recount inter-robot measurements that reached no pose node."""
        self._reject(sorted(self._sighted - used), Rejection.NO_NODE, IN_SIGHTING)
        self._sighted.clear()

    def uncover(self, count: int) -> None:
        """Recount a stream's last scans, after all odometry."""
        self._reject(self._last_scans(count), Rejection.NOT_COVERED, self.used)

    def entries(self) -> tuple[m.Disposition, ...]:
        """List the dispositions for the robot's `Done`."""
        return tuple(
            m.Disposition(disposition=name, measurements=count)
            for name, count in sorted(self.counts.items())
            if count
        )
