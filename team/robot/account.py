"""How far a robot is: the measurements that it has consumed, and what it reports of them."""

from dataclasses import dataclass, field

from teamslam.team.robot.mapper import Mapper
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m


@dataclass
class StreamAccount:
    """The counts of the incarnation in progress, and the last statements of those before it.

    consumed: measurements; steps: odometry intervals that this process has consumed; all_steps:
    those of all incarnations. acknowledged: submaps that the centre has dealt with. unreported:
    measurements since the last report.
    """

    robot: str
    incarnation: int = 0
    consumed: int = 0
    steps: int = 0
    all_steps: int = 0
    acknowledged: int = 0
    unreported: int = 0
    ended: list[m.Done] = field(default_factory=list)

    def begin(self, incarnation: int, consumed: int = 0, acknowledged: int = 0) -> None:
        """Begin an incarnation, or continue one behind the submaps of an earlier process."""
        self.incarnation, self.consumed = incarnation, consumed
        self.acknowledged, self.steps = acknowledged, 0

    def count(self, measurement: m.Measurement) -> None:
        """Count a measurement that is consumed next."""
        self.consumed = measurement.number + 1
        if isinstance(measurement, m.AnyOdometry):
            self.steps += 1
            self.all_steps += 1

    def acknowledge(self, progress: m.Progress) -> None:
        """Note how many submaps the centre has dealt with."""
        if progress.incarnation == self.incarnation:
            self.acknowledged = max(self.acknowledged, progress.submaps)

    def progress(self, mapper: Mapper) -> m.Progress:
        """How many measurements were consumed and submaps sent, and the time that has passed."""
        since_ns = mapper.submaps.since_ns
        return m.Progress(
            stamp_ns=mapper.passed_ns if since_ns is None else since_ns,
            node=ch.robot_node(self.robot),
            robot=self.robot,
            incarnation=self.incarnation,
            measurements=self.consumed,
            submaps=mapper.submaps.sent,
        )

    def statement(self, mapper: Mapper, last: int | None) -> m.Done:
        """The account of the incarnation, without what was consumed behind its end.

        last: its number of measurements; None while it has not ended.
        """
        return m.Done(
            stamp_ns=mapper.now_ns,
            robot=self.robot,
            incarnation=self.incarnation,
            measurements=self.consumed if last is None else min(self.consumed, last),
            steps=self.steps,
            submaps=mapper.submaps.sent,
            ledger=mapper.ledger.entries(),
        )
