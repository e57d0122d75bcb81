"""How far a robot may go without the centre: lockstep, credit, and what it reports of itself."""

from dataclasses import dataclass

CREDIT_SUBMAPS = 4
"""A robot is at most this many submaps ahead of a living centre."""
PROGRESS_MEASUREMENTS = 64
"""A robot reports its progress at least once per this many measurements."""


@dataclass
class Pace:
    """What a robot has sent, what the centre has answered, and what of it holds the robot up.

    lockstep: each map that is exchanged is answered before the robot goes on (rules with feedback).
    credit: the submaps that are sent are acknowledged. exchange: the last round that was answered;
    awaited: the round of the last map that was sent. acknowledged: submaps of this incarnation that
    the centre has dealt with; credited: measurements of this incarnation that were reported ahead
    of their use.
    """

    lockstep: bool
    credit: bool
    centre_alive: bool | None = None
    exchange: int = 0
    awaited: int = 0
    acknowledged: int = 0
    credited: int = 0
    unreported: int = 0

    def begin_incarnation(self) -> None:
        """Submaps and measurements are counted anew; rounds are the team's and go on."""
        self.acknowledged = self.credited = 0

    def holds(self, submaps: int) -> bool:
        """Whether a robot that has sent so many submaps waits for the centre.

        A centre that was never heard of gives no credit, but may still answer: lockstep does not
        depend on whose token arrives first.
        """
        if self.lockstep:
            return self.awaited > self.exchange and self.centre_alive is not False
        return self.credit and bool(self.centre_alive) and self._ahead(submaps)

    def _ahead(self, submaps: int) -> bool:
        return submaps - self.acknowledged > CREDIT_SUBMAPS

    def answered(self, exchange: int) -> bool:
        """Take the answer of a round; whether it is news."""
        if not self.lockstep or exchange <= self.exchange:
            return False
        self.exchange = exchange
        return True

    def sent_map(self) -> None:
        """A map was sent for the next round."""
        self.awaited = self.exchange + 1

    def owes(self, received: int, consumed: int) -> bool:
        """Whether a robot in lockstep must report what it has received, not what it has used.

        Else the world would wait for it, and with the world whoever it waits for: a teammate that
        needs more measurements for its map, or the end.
        """
        if received - max(self.credited, consumed) < PROGRESS_MEASUREMENTS:
            return False
        self.credited = received
        return True

    def counted(self) -> bool:
        """One more measurement was used; whether it is time to report."""
        self.unreported += 1
        return self.unreported >= PROGRESS_MEASUREMENTS
