"""The robot's node: messages in, messages out; no I/O, no clock.

    receive   handle        a message arrives
    order     Inbox         measurements are put in order
    estimate  Mapper.take   Hybrid-SLAM within the bounds of the sensor
    account   Ledger        law 1: each measurement is used once
    publish   Mapper.out    submaps, poses, maps; then progress

A robot is at most CREDIT_SUBMAPS submaps ahead of a present centre, and reports progress after each
window and every PROGRESS_MEASUREMENTS measurements.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from teamslam.team import translate
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.door import absurd
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.pairs import COMPARISON_ROBOT, PAIRS
from teamslam.team.registry import load
from teamslam.team.robot.ledger import Ledger, OnDisposition
from teamslam.team.robot.mapper import Mapper, Replaced
from teamslam.team.robot.poses import RunningPoses
from teamslam.team.robot.status import status_of
from teamslam.team.robot.stream import EndOfStream, Inbox
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import find_error
from teamslam.team.wire.digest import announce_configuration


@dataclass
class StreamAccount:
    """Counts of the current incarnation, and the last statements of earlier ones.

    consumed: measurements. acknowledged: submaps at the centre. unreported: measurements since the
    last report.
    """

    incarnation: int = 0
    consumed: int = 0
    acknowledged: int = 0
    unreported: int = 0
    ended: list[m.Done] = field(default_factory=list)

    def begin(self, incarnation: int, consumed: int = 0, acknowledged: int = 0) -> None:
        """Begin an incarnation, or continue an earlier process's."""
        self.incarnation, self.consumed = incarnation, consumed
        self.acknowledged = acknowledged

    def acknowledge(self, progress: m.Progress) -> None:
        """Record the number of submaps at the centre."""
        if progress.incarnation == self.incarnation:
            self.acknowledged = max(self.acknowledged, progress.submaps)


AHEAD = 64
"""Submaps of an earlier process that the centre may have received since the request for them."""
CREDIT_SUBMAPS = 4  # most submaps that a robot is ahead of a present centre
PROGRESS_MEASUREMENTS = 64  # most measurements between two reports of progress


class RobotNode:
    """The node of one robot: call `begin`, then `handle` for every message, until `finished`.

    For recomputing a log: announced, the configuration's digest; poses, when and from which priors;
    replaced, sent instead of a window; on_window receives each closed window. final: the team's
    final map. withheld: number of messages that no receiver would accept.
    """

    listens: tuple[ch.Channel, ...] = (
        *ch.SENSORS,
        ch.HEAD,
        ch.END,
        ch.TEAM_END,
        ch.PRIOR,
        ch.FINAL_MAP,
        ch.CENTRAL_PROGRESS,
    )
    makes: type[Mapper] = Mapper

    def __init__(
        self,
        config: RobotConfig,
        exchange: Exchange = "continuous",
        *,
        announced: bytes | None = None,
        poses: RunningPoses | None = None,
        replaced: Replaced | None = None,
        on_window: Callable[[ClosedWindow], None] = lambda _: None,
        on_disposition: OnDisposition | None = None,
    ) -> None:
        self.config = config
        self.robot = config.id
        self._announcement = announce_configuration(ch.robot_node(config.id), 0, 0, config)
        if announced is not None:
            self._announcement = msgspec.structs.replace(self._announcement, digest=announced)
        self.inbox = Inbox()
        self.stream_end = EndOfStream(config.id, self.inbox)
        digest = self._announcement.digest
        self.mapper = self.makes(
            config, exchange, digest, poses, replaced, on_window, on_disposition
        )
        self.out, self.warnings = self.mapper.out, self.mapper.warnings
        self.account = StreamAccount()
        self._centre_alive: bool | None = None
        self.done = self._has_sent_done = False
        self.finished = False
        self.final: m.FusedMap | None = None
        self.withheld = 0

    # Queries of the shell.

    @property
    def ledger(self) -> Ledger:
        """Law 1's account of the current incarnation."""
        return self.mapper.ledger

    @property
    def incarnation(self) -> int:
        """Current incarnation."""
        return self.inbox.incarnation

    @property
    def next_measurement(self) -> int:
        """Counter of the next measurement."""
        return self.inbox.next_measurement

    @property
    def submaps(self) -> int:
        """Number of sent submaps of this incarnation, with those of an earlier process."""
        return self.mapper.submaps.sent

    @property
    def overhears(self) -> tuple[ch.Channel, ...]:
        """Channels of all robots to subscribe to: encounters, if used."""
        return (ch.RENDEZVOUS,) if self.mapper.submaps.buffers else ()

    def request(self) -> m.MeasurementsRequest | None:
        """Return the request for missing measurements, if any."""
        missing = self.stream_end.missing()
        if missing is None:
            return None
        incarnation, first, last = missing
        return m.MeasurementsRequest(
            stamp_ns=self.mapper.now_ns,
            robot=self.robot,
            incarnation=incarnation,
            first=first,
            last=last,
        )

    def status(self) -> m.Status:
        """Return the robot's status for operators."""
        measurements = self.next_measurement
        return status_of(
            self.mapper,
            "done" if self.done else "mapping" if measurements else "waiting",
            self.mapper.all_steps,
            measurements,
            self.withheld,
            waits_for_driver=self.stream_end.waits_for_driver,
        )

    def begin(self) -> list[Outgoing]:
        """Return the first message: the configuration."""
        return [Outgoing(ch.ROBOT_CONFIG, self.robot, self._announcement)]

    def take_over(self, stored: Sequence[m.Message]) -> None:
        """Continue where the centre's set of this robot ends, and answer requests for
        its submaps.
        """
        start = stored[0]
        assert isinstance(start, m.InitialPose)
        of_it = (
            s for s in stored if isinstance(s, m.Submap) and s.incarnation == start.incarnation
        )
        self.resume(start, list(of_it))
        for message in stored:
            self.mapper.submaps.restore(message)

    def resume(self, start: m.InitialPose, submaps: Sequence[m.Submap]) -> None:
        """Continue after an earlier process's submaps of the latest incarnation, from
        sequence 0.
        """
        self.mapper.resume(start, submaps)
        used = submaps[-1].last_measurement + 1
        self.account.begin(start.incarnation, used, len(submaps))
        self.inbox.resume(start.incarnation, used)

    def answer_submaps(self, request: bytes) -> list[bytes]:
        """Answer `SubmapsRequest` with everything sent for fusion, by earlier processes too."""
        return self.mapper.submaps.answer(request)

    def refusal(self, message: m.Message) -> str | None:
        """Return why a message cannot be valid for this robot, or None."""
        if m.is_measurement(message):  # first: most messages are measurements
            own = message.robot == self.robot
            return self.inbox.refusal(message) if own else f"a measurement of {message.robot}"
        refused = absurd(message)
        if refused is not None:
            return refused
        match message:
            case m.Progress() if message.incarnation == self.account.incarnation:
                if message.submaps > self.submaps + AHEAD:
                    return (
                        f"acknowledges {message.submaps} submaps of {self.submaps}: the centre's "
                        "set is of another run; start the centre again with a new --set FILE"
                    )
            case m.End() | m.StreamHead():
                return self.stream_end.refusal(message)
            case _:
                pass
        return None

    # Receive.

    def handle(self, message: m.Message) -> list[Outgoing]:
        """Process one message; its stamp is the time."""
        inbox, end = self.inbox, self.stream_end
        if not m.is_measurement(message):
            self.receive(message)
        elif not self.is_held and inbox.take(message):
            self._consume(message)
        else:
            inbox.put(message)
        if inbox.ahead or inbox.later or end.last is not None or end.is_ordered:
            self.consume()
        return self._publish() if self.out else []

    def receive(self, message: m.Message) -> None:
        """Process a message other than a measurement."""
        match message:
            case m.Prior():
                self.out += self.mapper.poses.take_prior(message)
            case m.FusedMap() if message.final:
                self.finished, self.final = True, message
            case m.Progress():
                self.account.acknowledge(message)
            case m.Rendezvous():
                if self.robot in message.teammates:
                    self._release(())
            case m.Liveliness() if message.node == "central":
                self._centre_alive = message.alive
            case m.Liveliness() | m.End() | m.TeamEnd():
                self.stream_end.receive(message)
            case m.StreamHead():
                head = self.stream_end.take_head(message)
                if head.state != "open":
                    self.out.append(Outgoing(ch.ROBOT_HEAD, self.robot, head))
                if self.account.consumed:
                    self.report_progress()
            case _:
                self.warnings.append(f"no use for a {type(message).__name__}")

    def set_aside(self, message: m.Message, why: str) -> list[Outgoing]:
        """Continue after a measurement whose handling raised, without it.

        The mapper is reset to its last submap and the window's other measurements, or ends with
        `Done` without its last window.
        """
        self.mapper.set_aside()
        if self.done and not self._has_sent_done:
            self._send_last_words()
        self.consume()
        return self._publish() if self.out else []

    # Order and estimate.

    def consume(self) -> None:
        """Consume the measurements in order, while credit lasts."""
        inbox = self.inbox
        while (inbox.ahead or inbox.later) and not self.is_held:
            measurement = inbox.take_next()
            if measurement is None:
                break
            self._consume(measurement)
        if not self.done and self.stream_end.is_reached() and not self.is_held:
            self._finish()

    @property
    def is_held(self) -> bool:
        """Whether the robot has used up its credit at a present centre."""
        if not self._centre_alive:
            return False
        return self.mapper.submaps.sent - self.account.acknowledged > CREDIT_SUBMAPS

    def _consume(self, measurement: m.Measurement) -> None:
        if type(measurement) is m.InitialPose:
            self._leave_incarnation()
            self.mapper.begin(measurement)
            self.account.begin(measurement.incarnation)
        account = self.account
        account.consumed = measurement.number + 1
        if self.mapper.take(measurement):
            self.report_progress()
        if type(measurement) is m.Sightings:
            self._release(measurement.teammates)
        account.unreported += 1
        if account.unreported >= PROGRESS_MEASUREMENTS:
            self.report_progress()

    def _publish(self) -> list[Outgoing]:
        """Return the messages of `out` that every receiver accepts; withhold others with a warning.

        Landmarks that rounding has made unsound are removed from a map.
        """
        sound = []
        for each in self.out:
            why = find_error(each.message)
            if why is not None and isinstance(each.message, m.MapEstimate):
                each = each._replace(message=translate.make_receivable(each.message)[0])
                why = find_error(each.message)
            if why is None:
                sound.append(each)
            else:
                self.withheld += 1
                self.warnings.append(f"withheld: {each.key}, {why}")
        self.out.clear()
        return sound

    def _release(self, seen: tuple[str, ...]) -> None:
        released = self.mapper.submaps.release(seen, self.mapper.now_ns)
        if released:
            self.out += released
            self.report_progress()

    def report_progress(self) -> None:
        """Publish the robot's progress."""
        self.account.unreported = 0
        self.out.append(Outgoing(ch.ROBOT_PROGRESS, self.robot, self.progress()))

    def progress(self) -> m.Progress:
        """Return the numbers of consumed measurements and sent submaps, and the time passed."""
        since_ns = self.mapper.submaps.since_ns
        return m.Progress(
            stamp_ns=self.mapper.passed_ns if since_ns is None else since_ns,
            node=ch.robot_node(self.robot),
            robot=self.robot,
            incarnation=self.account.incarnation,
            measurements=self.account.consumed,
            submaps=self.submaps,
        )

    # An incarnation begins and ends.

    def _leave_incarnation(self) -> None:
        if not self.account.consumed:
            return
        if self.done:  # the driver has returned after its end
            self.done = self._has_sent_done = False
            self.account.ended.append(self.statement())
            return
        self._close_incarnation()
        self._release(())
        self.account.ended.append(self.statement())
        self.report_progress()

    def _close_incarnation(self) -> None:
        if self.mapper.finish():
            self.report_progress()

    def _finish(self) -> None:
        """Finish with the last `Done` first, after which the centre may conclude."""
        self.done = True
        self._close_incarnation()
        self._send_last_words()

    def _send_last_words(self) -> None:
        self._release(())
        statements = [self.statement(), *self.account.ended]
        self._has_sent_done = True
        self.report_progress()
        self.out += (Outgoing(ch.ROBOT_DONE, self.robot, each) for each in statements)

    def statement(self) -> m.Done:
        """Return the account of the incarnation up to its end."""
        account = self.account
        last = self.stream_end.last_of(account.incarnation)
        return m.Done(
            stamp_ns=self.mapper.now_ns,
            robot=self.robot,
            incarnation=account.incarnation,
            measurements=account.consumed if last is None else min(account.consumed, last),
            steps=self.mapper.steps,
            submaps=self.submaps,
            ledger=self.ledger.entries(),
        )


def robot_node(config: RobotConfig, exchange: Exchange = "continuous", **options: Any) -> RobotNode:
    """Make the node of a robot: `RobotNode` for a rule over submaps, else a comparison's."""
    if PAIRS[config.estimator, config.fusion] == "submap":
        return RobotNode(config, exchange, **options)
    made: type[RobotNode] = load(COMPARISON_ROBOT, f"the estimator {config.estimator}")
    return made(config, exchange, **options)
