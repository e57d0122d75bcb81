"""Process of a robot: the node's shell, which recovers missed messages and resumes an earlier
process.
"""

import logging
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

import msgspec

from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.containment import reply_of
from teamslam.team.robot.node import robot_node
from teamslam.team.shell import ASK_TIMEOUT_S, RECORDER, MissingMeasurements, Shell
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, BusError, Sample, Tap
from teamslam.team.wire.codec import WireError, decoded, encoded

SECOND_PATIENCE_S = 6.0
"""Wait [s] for another process' token, which lasts for its lease of 5 s after a cut."""
SECOND_PERIOD_S = 0.5
CONFIRMED_S = 1.0  # wait [s] between two requests to the source for its stream's incarnation
MOST_DOUBTED = 1_000  # most ends that the source has not confirmed yet
LOG_LOOK_S, LOG_RARELY_S = 2.0, 60.0
"""Least and greatest wait [s] between two checks for losses of the robot's own log."""
_LOG = logging.getLogger("teamslam")


class RobotShell:
    """Process of a robot: it subscribes, resumes an earlier process, and runs.

    `run` raises BusError when another process runs this robot for `patience_s`; FaultyRunError, at
    its end, when messages were set aside.
    """

    def __init__(
        self,
        bus: Bus,
        config: RobotConfig,
        stop: threading.Event,
        patience_s: float = SECOND_PATIENCE_S,
        exchange: Exchange = "continuous",
    ) -> None:
        self.bus = bus
        self._stop = stop
        self._patience_s = patience_s
        self._config, self._exchange = config, exchange
        self.node = robot_node(config, exchange)
        self._first_of: dict[int, Sample] = {}
        self._confirm_at = 0.0
        self._doubted: dict[tuple[int, int], Sample] = {}
        self._ends_due_s = 0.0
        self._log_due_s = 0.0
        self._log_look_s = LOG_LOOK_S
        self.run_in(Shell(bus, self.node, ch.robot_node(config.id), stop))

    def run_in(self, shell: Shell) -> None:
        """Set the shell of this process' node."""
        self.shell = shell
        shell.believed = self._believed
        self._missing = MissingMeasurements(shell, lambda each: self.node.inbox.confirm(each))

    def run(self) -> None:
        """Run until the final map arrives."""
        name = self.node.robot
        self._be_the_only_one()
        self._subscribe()
        self.shell.answer(ch.SENT, name, lambda request: self.node.answer_submaps(request))
        self.shell.query_end()
        if not self.node.finished and self._resume():
            self._catch_up()
        self._look_for_driver()
        self.shell.run(self._duty)
        self._complete_log()
        _LOG.info("%d submaps from %d measurements", self.node.submaps, self.node.next_measurement)
        self._await_recorder()
        self.shell.end(self._final)

    def _subscribe(self) -> None:
        for channel in self.node.listens:
            self.bus.subscribe(channel, self.node.robot)
        for channel in self.node.overhears:
            self.bus.subscribe(channel)
        self.bus.watch_alive("central")
        self.bus.watch_alive(RECORDER)

    @property
    def _final(self) -> m.FusedMap | None:
        return self.node.final

    def _duty(self) -> None:
        self.look_for_gaps()

    def look_for_gaps(self) -> None:
        """Request missing measurements from the source."""
        requested = self.node.request()
        self._missing.look(() if requested is None else (requested,))
        if self._doubted and time.monotonic() >= self._ends_due_s:
            self._ask_about_ends()
        if time.monotonic() >= self._log_due_s:
            lost = self._complete_log()
            self._log_look_s = min(2.0 * self._log_look_s, LOG_RARELY_S) if lost else LOG_LOOK_S
            self._log_due_s = time.monotonic() + self._log_look_s

    def _complete_log(self) -> bool:
        """Request what the robot's log lost, with answers to its own requests; return whether any
        was lost.
        """
        lost = False
        tap: Tap | None = getattr(self.bus, "tap", None)
        for incarnation, first, last in () if tap is None else tap.lost(self.node.robot):
            here = incarnation == self.node.incarnation
            used = min(last, self.node.next_measurement - 1) if here else last
            if first <= used:
                lost = True
                if self._ask_source(incarnation, first, used, only=True) is None:
                    break
        return lost

    def _ask_source(
        self, incarnation: int, first: int, last: int, *, only: bool = False
    ) -> list[m.Measurement] | None:
        """Request measurements first … last of the stream; None without a valid answer."""
        request = m.MeasurementsRequest(
            stamp_ns=0,
            robot=self.node.robot,
            incarnation=incarnation,
            first=first,
            last=last,
            only=only,
        )
        try:
            replies = self.bus.ask(ch.MEASUREMENTS, self.node.robot, request, ASK_TIMEOUT_S)
            return [reply_of(reply, m.Measurement) for reply in replies]
        except (BusError, WireError) as error:
            _LOG.warning("measurements %d to %d of its source: %s", first, last, error)
            return None

    def _look_for_driver(self) -> None:
        driver = ch.source_node(self.node.robot)
        there = m.Liveliness(stamp_ns=0, node=driver, alive=self.bus.is_alive(driver))
        self.node.handle(there)
        self.bus.watch_alive(driver)

    def _await_recorder(self) -> None:
        """Run until the recorder has every submap; it has no other source."""
        recorded: dict[int, int] = {}

        def take(samples: Sequence[Sample]) -> None:
            for sample in samples:
                if sample.key == ch.RECORDER_PROGRESS.key(self.node.robot):
                    with suppress(WireError):
                        progress = decoded(sample.payload, m.Progress)
                        recorded[progress.incarnation] = max(
                            recorded.get(progress.incarnation, 0), progress.submaps
                        )

        self.bus.subscribe(ch.RECORDER_PROGRESS, self.node.robot)
        own = self.node.incarnation, self.node.submaps
        self.shell.wait_for_recorder(lambda: recorded.get(own[0], 0) < own[1], take)

    def _be_the_only_one(self) -> None:
        node = ch.robot_node(self.node.robot)
        deadline = time.monotonic() + self._patience_s
        while self.bus.is_alive(node):
            if time.monotonic() >= deadline or self._stop.wait(SECOND_PERIOD_S):
                raise BusError(
                    f"another process is {node} in this team already: "
                    "stop that one first, or start another robot"
                )

    def _resume(self) -> bool:
        """Resume from an earlier process's submaps at the centre; return whether there are any."""
        requested = m.SubmapsRequest(stamp_ns=0, robot=self.node.robot)
        try:
            replies = self.bus.ask(ch.SUBMAPS, "", requested, ASK_TIMEOUT_S)
        except BusError as error:  # a centre that does not answer: the same submaps once more
            _LOG.warning("%s", error)
            return False
        if not replies:
            return False
        try:
            start = reply_of(replies[0], m.InitialPose)
            last = self._beginning_at_source()
            if last is not None and last.incarnation < start.incarnation:
                _LOG.warning(
                    "the centre has incarnation %d of this robot, of which its source knows "
                    "nothing: the stream begins again",
                    start.incarnation,
                )
                return False
            self.node.take_over([start, *(reply_of(reply, m.Message) for reply in replies[1:])])
        except Exception as error:
            sample = Sample(ch.SUBMAPS.key(), replies[0], 0, 0, -1)
            self.shell.publish([self.shell.boundary.note(error, sample, "")])
            self.node = self.shell.node = robot_node(self._config, self._exchange)
            return False
        _LOG.info(
            "resumed after submap %d of incarnation %d",
            self.node.submaps - 1,
            self.node.incarnation,
        )
        return True

    def _catch_up(self) -> None:
        while True:
            first = self.node.next_measurement
            replies = self._missing.ask(
                m.MeasurementsRequest(
                    stamp_ns=0,
                    robot=self.node.robot,
                    incarnation=self.node.incarnation,
                    first=first,
                    last=-1,
                )
            )
            if not replies or self.node.next_measurement == first:
                return

    def _believed(self, samples: Sequence[Sample]) -> list[Sample]:
        """Drop ends and initial poses that the source does not confirm; without a source (a
        replayed log) the message alone counts.
        """
        passed = []
        for sample in samples:
            if self._is_doubted(sample):
                continue
            found = _beginning(sample, self.node.robot)
            if found is None or found <= self.node.incarnation:
                passed.append(sample)
            else:
                self._first_of[found] = sample
        if self._first_of and time.monotonic() >= self._confirm_at:
            self._confirm_at = time.monotonic() + CONFIRMED_S
            last = self._beginning_at_source()
            first_of, self._first_of = self._first_of, {}
            silent = last is None and self._source_is_there
            for incarnation, sample in sorted(first_of.items()):
                if silent:  # it has not published yet what would be asked for
                    self._first_of[incarnation] = sample
                elif last is not None and incarnation == last.incarnation:
                    passed.append(
                        msgspec.structs.replace(
                            sample, payload=encoded(last), stamp_ns=last.stamp_ns
                        )
                    )
                elif last is None or incarnation < last.incarnation:
                    passed.append(sample)
                else:
                    why = f"of incarnation {incarnation}, of which its source knows nothing"
                    self.shell.boundary.refuse(sample, why)
        return passed

    def _is_doubted(self, sample: Sample) -> bool:
        """Return whether a sample is an announced end; without keys any node may announce one."""
        if sample.key != ch.END.key():
            return False
        try:
            last = self.node.stream_end.announced_by(decoded(sample.payload, m.End))
        except WireError:
            return False
        if last not in self._doubted and len(self._doubted) >= MOST_DOUBTED:
            return False
        self._doubted[last] = sample
        return True

    def _ask_about_ends(self) -> None:
        self._ends_due_s = time.monotonic() + CONFIRMED_S
        doubted, self._doubted = self._doubted, {}
        for (incarnation, count), sample in doubted.items():
            there = self._ask_source(incarnation, max(count - 1, 0), count, only=True)
            if there is None:
                self._doubted[incarnation, count] = sample
                continue
            numbers = {each.number for each in there}
            if count and numbers == {count - 1}:
                self.node.stream_end.at_source = incarnation, count
            elif numbers or (count and self._source_is_there):
                why = f"an end of {self.node.robot} at {count}, which is not its source's"
                self.shell.boundary.refuse(sample, why)
                continue
            self.shell.take([sample])

    @property
    def _source_is_there(self) -> bool:
        return any(self.bus.is_alive(n) for n in ("world", ch.source_node(self.node.robot)))

    def _beginning_at_source(self) -> m.InitialPose | None:
        starts = [x for x in self._ask_source(0, 0, 0) or () if isinstance(x, m.InitialPose)]
        return max(starts, key=lambda start: start.incarnation, default=None)


def _beginning(sample: Sample, robot: str) -> int | None:
    if sample.key != ch.START.key(robot):
        return None
    try:
        start = decoded(sample.payload, m.InitialPose)
    except WireError:
        return None  # the shell counts it
    return start.incarnation if start.number == 0 else None
