"""The driver's publishing thread: connect to the router, and reconnect, until closed."""

import logging
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import msgspec

from teamslam.team.door import MOST_LIVES
from teamslam.team.driver.journal import JournalError, replace_journal
from teamslam.team.driver.node import SourceNode
from teamslam.team.end_query import EndQuery
from teamslam.team.keys.roster import KeysError
from teamslam.team.shell import Shell
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import BusError
from teamslam.team.wire.zenoh.bus import ZenohBus

HEAD_S = 1.0
PACE_S = 0.01
ATTEMPT_S = 0.3  # duration [s] of an attempt to reach a router that is not there
AGAIN_S = 2.0  # wait [s] before another attempt to reach the router
SECOND_PATIENCE_S = 6.0
"""Wait [s] for another driver's token: that of a cut-off driver lasts for its lease of 5 s."""
HEAR_S = 0.5  # time [s] within which a present robot's process reports its progress
HEAR_RUN_S = 3.0
"""Longest time [s] until a present recorder's status names the run, for a stream of some run."""
FIRST_S = 10.0  # longest time [s] for a first attempt that reaches the router
LAST_S = 5.0  # longest time [s] for the remaining publications at the end
_LOG = logging.getLogger("teamslam")


class Link:
    """Run a source's node on a bus of its own; `lock` guards writes to the journal."""

    def __init__(
        self,
        node: SourceNode,
        *,
        team: str,
        connect: str,
        keys: Path | str | None,
        lock: threading.Lock,
    ) -> None:
        self._node = node
        self._name = ch.source_node(node.journal.robot)
        self._team, self._connect = team, connect
        self._keys = None if keys is None else Path(keys)
        self._lock = lock
        self._leaving = threading.Event()
        self._up = threading.Event()
        self._tried = threading.Event()
        self._is_open = False
        self.left = ""  # description of a stream that is set aside; empty: none
        self._moved = threading.Condition()
        self._trouble: Exception | None = None
        self._failure: Exception | None = None
        self._unheard = False
        self._attempt_s = ATTEMPT_S
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)

    def open(self, patience_s: float) -> str:
        """Start the thread and wait for the router; raises BusError or KeysError after patience_s.

        0: log the first failure; a stream that a run has received waits for the first attempt,
        since another run does not continue it. Returns the description of one set aside, or "".
        """
        self._unheard = not patience_s
        self._attempt_s = patience_s or ATTEMPT_S
        self._thread.start()
        until = time.monotonic() + patience_s + SECOND_PATIENCE_S
        while patience_s and not self._up.is_set():
            if self._trouble is not None or time.monotonic() >= until:
                self.close()
                raise self._trouble or BusError(f"no router answers at {self._connect}")
            self._up.wait(0.02)
        if self._node.journal.run:
            self._tried.wait(FIRST_S)
        with self._lock:
            self._is_open = True
        return self.left

    def close(self) -> None:
        """Publish the remaining messages and stop the thread."""
        self._leaving.set()
        self._thread.join(3.0 * LAST_S)

    @property
    def failure(self) -> str | None:
        """The exception that ended the thread, in words, or None."""
        failed = self._failure
        return None if failed is None else f"{type(failed).__name__}: {failed}"

    def wait(self, timeout_s: float) -> None:
        """Wait for a change of the node's state."""
        with self._moved:
            self._moved.wait(timeout_s)

    def status(self) -> m.Status:
        """Return the node's status, with problems of the link."""
        status = self._node.status()
        if self._trouble is None:
            return status
        warnings = (str(self._trouble), *status.warnings)
        return msgspec.structs.replace(status, warnings=warnings)

    def why_it_waits(self) -> str:
        """Describe the process that `end` needs, with the remedy."""
        if self._trouble is not None:
            return str(self._trouble)
        robot = self._node.journal.robot
        if ch.robot_node(robot) not in self._node.alive:
            return (
                f"{robot} waits for its process, which is absent: start `teamslam robot`; all "
                f"measurements are in {self._node.journal.path}"
            )
        return f"{robot} has {self._node.delivered[1]} measurements by now"

    def _run(self) -> None:
        while not self._leaving.is_set() and not self._node.finished:
            try:
                self._connected()
                self._trouble = None
            except JournalError as error:  # the driver's next call raises it
                _LOG.error("%s", error)
                self._trouble = self._failure = error
                return
            except (BusError, KeysError) as error:
                if self._up.is_set() or self._unheard:
                    _LOG.warning("%s", error)
                self._unheard = False
                self._trouble = error
                self._tried.set()
                self._leaving.wait(AGAIN_S)
            except Exception as error:  # the driver's next call raises it
                self._trouble = self._failure = error
                raise
            finally:
                self._tried.set()

    def _connected(self) -> None:
        own = None
        if self._keys is not None:
            from teamslam.team.keys.credentials import credentials_of

            own = credentials_of(self._keys, f"source-{self._node.journal.robot}", self._team)
        connect = self._connect.replace("tcp/", "tls/", 1) if own else self._connect
        with ExitStack() as stack:
            bus = stack.enter_context(ZenohBus(self._team, connect, self._attempt_s, own))
            self._claim_name(bus)
            shell = Shell(bus, self._node, self._name, self._leaving)
            own_ends = (ch.FINAL_MAP, ch.TEAM_FINAL)  # without a centre its own robot's
            shell.end_query = EndQuery(bus, self._name, own_ends, self._node.journal.robot)
            self._node.alive.clear()
            self._node.run = ""
            for channel in self._node.listens:
                bus.subscribe(channel, self._node.journal.robot)
            if self._node.on_message is not None:
                for channel in self._node.results:
                    bus.subscribe(channel, self._node.journal.robot)
                bus.subscribe(ch.STATUS, ch.robot_node(self._node.journal.robot))
            bus.subscribe(ch.HEAD)
            bus.subscribe(ch.STATUS, "recorder")
            bus.subscribe(ch.SET_SUMMARY, ch.robot_node(self._node.journal.robot))
            bus.watch_alive()
            shell.answer(ch.MEASUREMENTS, self._node.journal.robot, self._node.measurements)
            self._check_progress(shell, bus)
            if not self._up.is_set():
                self._check_run()
            others = [] if self._node.alive else bus.other_teams()
            if others:
                _LOG.warning(
                    "%s: no process of team %s is at %s, but of %s: is the team's name right?",
                    self._node.journal.robot, self._team, self._connect, ", ".join(others),
                )  # fmt: skip
            shell.begin()
            self._up.set()
            self._tried.set()
            self._trouble, self._attempt_s = None, ATTEMPT_S
            self._serve(shell, bus)

    def _claim_name(self, bus: ZenohBus) -> None:
        deadline = time.monotonic() + SECOND_PATIENCE_S
        while bus.is_alive(self._name):
            if time.monotonic() >= deadline or self._leaving.wait(0.5):
                raise BusError(
                    f"another process is {self._name} in this team already: stop that one first"
                )

    def _check_progress(self, shell: Shell, bus: ZenohBus) -> None:
        """Compare the robot's progress with the file: more means that it had another file."""
        began = time.monotonic()
        journal = self._node.journal
        self._node.listening = True
        while (passed_s := time.monotonic() - began) < HEAR_S or (
            passed_s < HEAR_RUN_S
            and journal.run
            and "recorder" in self._node.alive
            and not self._node.run
        ):
            shell.take(bus.receive(0.05))
        self._node.listening = False
        incarnation, measurements = self._node.delivered
        mine = journal.count(incarnation)
        if incarnation <= journal.incarnation and measurements <= mine:
            return
        if incarnation < journal.first_incarnation:
            return
        if incarnation >= MOST_LIVES:
            self._node.warnings.append(
                f"the team is at incarnation {incarnation} of {journal.robot}, the last possible "
                "one: start the team's processes again"
            )
        elif not journal.incarnation:
            with self._lock:
                journal.mark("open", incarnation=incarnation + 1)
            self._node.warnings.append(
                f"{journal.robot} had another file before: its stream begins again"
            )
        else:
            self._node.warnings.append(
                f"the team has measurements of {journal.robot} that are not in {journal.path}: "
                "stop, and start with the file that has them, or with an empty one"
            )
        _LOG.warning("%s", self._node.warnings[-1])

    def _check_run(self) -> None:
        """Set the stream of an earlier run aside, of which this run's robot has nothing."""
        journal, run = self._node.journal, self._node.run
        is_earlier = journal.run and run not in ("", journal.run)
        if not is_earlier or not journal.calls or self._node.delivered > (0, 0):
            return
        with self._lock:
            fresh, self.left = replace_journal(
                journal,
                f"is of an earlier run of team {self._team}",
                journal.latency_ns,
                journal.team,
                journal.start,
            )
            self._node.replace(fresh)
            if self._is_open:
                self._node.warnings.append(self.left)

    def _note_run(self) -> None:
        if self._node.run not in ("", self._node.journal.run):
            with self._lock:
                self._node.journal.mark_run(self._node.run)

    def _serve(self, shell: Shell, bus: ZenohBus) -> None:
        head_due, last, said = 0.0, 0.0, 0
        while True:
            out = self._node.publish()
            now = time.monotonic()
            if not out and (now >= head_due or self._node.has_new_state):
                out = self._node.head()
                head_due = now + HEAD_S
            shell.publish(out)
            shell.take(bus.receive(0.0 if out else PACE_S))
            self._note_run()
            if self._node.ordered_to_end and self._node.journal.state == "open":
                with self._lock:
                    self._node.journal.mark("ended")
            shell.query_end()
            shell.report()
            for warning in self._node.warnings[said:]:
                _LOG.warning("%s", warning)
            said = len(self._node.warnings)
            with self._moved:
                self._moved.notify_all()
            if self._leaving.is_set() or self._node.finished:
                last = last or now + LAST_S
                settled = not self._node.has_more and not (
                    self._node.finished and self._node.recorder_lacks
                )
                if settled or now >= last:
                    break
        shell.publish(self._node.head())
        shell.report(last=True)
