"""Limits how far a robot runs ahead of the centre: lockstep and credit; and when it reports
progress.
"""

from dataclasses import dataclass

CREDIT_SUBMAPS = 4
"""A robot is at most this many submaps ahead of a centre that is present."""
PROGRESS_MEASUREMENTS = 64
"""A robot reports its progress at least once per this many measurements."""


@dataclass
class Pace:
    """What a robot has sent and the centre has answered, and whether the robot must wait.

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
        """Begin an incarnation: submaps and measurements are counted from 0; rounds go on, they
        are the team's.
        """
        self.acknowledged = self.credited = 0

    def holds(self, submaps: int) -> bool:
        """Whether a robot that has sent so many submaps waits for the centre.

        A centre that was never present gives no credit, but may still answer: lockstep does not
        depend on the order in which tokens arrive.
        """
        if self.lockstep:
            return self.awaited > self.exchange and self.centre_alive is not False
        is_ahead = submaps - self.acknowledged > CREDIT_SUBMAPS
        return is_ahead and self.credit and bool(self.centre_alive)

    def answered(self, exchange: int) -> bool:
        """Take the answer of a round; returns whether it is new."""
        if not self.lockstep or exchange <= self.exchange:
            return False
        self.exchange = exchange
        return True

    def sent_map(self) -> None:
        """Note that a map was sent for the next round."""
        self.awaited = self.exchange + 1

    def owes(self, received: int, consumed: int) -> bool:
        """Whether a robot in lockstep must report the measurements received, not those used.

        Otherwise the world would wait for it, and with the world a teammate that needs more
        measurements for its map, or the end.
        """
        if received - max(self.credited, consumed) < PROGRESS_MEASUREMENTS:
            return False
        self.credited = received
        return True

    def counted(self) -> bool:
        """Count a used measurement; returns whether progress is to be reported."""
        self.unreported += 1
        return self.unreported >= PROGRESS_MEASUREMENTS
