"""Supervise a team's processes: restart dead ones, give up those without progress.

Without recorder or viewer, or with a robot given up, the run continues and fails at its end.
Without router, world or centre it ends; peers need no centre.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.central.desk.orders import publish_order
from teamslam.sim.launch.processes import Child, Ended, Used
from teamslam.sim.launch.watch import TURN_S, Watch
from teamslam.team.shell import describe_missing
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, BusError, Outgoing

FRUITLESS = 5  # consecutive deaths without progress before a process is given up
FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 5.0  # longest wait [s] before a restart


@dataclass
class Supervised:
    """Process restarted by the same command, after growing waits.

    Given up after FRUITLESS deaths without progress. reached: progress at its last death. ended_s:
    detection of its end (monotonic). used: resources of earlier lives.
    """

    name: str
    arguments: list[str]
    folder: Path
    environment: Mapping[str, str]
    restarts: int = 0
    fruitless: int = 0
    reached: float = -1.0
    given_up: bool = False
    over: bool = False
    due: float | None = None
    ended_s: float | None = None
    used: Used = field(default_factory=Used)
    child: Child = field(init=False)

    def __post_init__(self) -> None:
        self._start()

    def _start(self) -> None:
        self.child = Child(self.name, self.arguments, self.folder, self.environment, self.restarts)

    @property
    def is_watched(self) -> bool:
        """Whether it runs or will run again."""
        return not (self.over or self.given_up)

    def has_ended_for(self, time_s: float) -> bool:
        """Whether its end was detected at least this long ago."""
        self.ended_s = self.ended_s or time.monotonic()
        return time.monotonic() - self.ended_s >= time_s

    def died(self, reached: float) -> None:
        """Schedule a restart, or give the process up."""
        self.fruitless = 1 if reached > self.reached else self.fruitless + 1
        self.reached = max(self.reached, reached)
        if self.fruitless >= FRUITLESS:
            self.given_up = True
            return
        wait_s = min(FIRST_WAIT_S * 2.0 ** (self.fruitless - 1), LONGEST_WAIT_S)
        self.due = time.monotonic() + wait_s

    def start_again(self) -> None:
        """Restart it if due."""
        if self.due is not None and time.monotonic() >= self.due:
            self.due = self.ended_s = None
            self.restarts += 1
            self.used = self.used.and_later(self.child.end(0.0).used)
            self._start()


SILENT_S = 10.0  # silence [s] after which a running process is reported
FEW = 3  # above this number, silent processes are only counted
MANY = "many"
REPEAT_S = 60.0  # least time [s] between reports of the same silence
STARTING_S = 60.0  # silence [s] after which a starting process is reported
MEASURE_S = 2.0  # time [s] between memory measurements; the last is at the final map
END_DELAY_S = 1.0  # time [s] after a process's end for the final map to arrive
LEAVING_S = 60.0
"""After the final map, a process is ended and reported if for this long [s] no other has ended and
the recorder has received nothing.
"""
_WITHOUT_IT_NO_MAP = frozenset({"router", "world", "central"})


def _node_of(name: str) -> str:
    return f"robot/{name.removeprefix('robot-')}" if name.startswith("robot-") else name


def _is_needed(name: str, watch: Watch) -> bool:
    return name in _WITHOUT_IT_NO_MAP and not (name == "central" and watch.peers)


def supervise(
    services: Sequence[Supervised],
    bus: Bus,
    watch: Watch,
    show: Callable[[Watch], None],
    end_silent_s: float | None,
) -> None:
    """Watch the processes until all but the router (the first) have ended or are given up.

    end_silent_s: silence [s] after which a process is ended, to be restarted.
    """
    silence = Silence(end_silent_s)
    leaving: _Leaving | None = None
    measure_s: float = -math.inf  # next measurement of memory; inf after the last
    while True:
        _receive(bus, watch)
        is_final = watch.is_over
        now_s = time.monotonic()
        if now_s >= measure_s or (is_final and measure_s < math.inf):
            measure_s = math.inf if is_final else now_s + MEASURE_S
            for service in services:
                service.child.measure()
        for service in services:
            _look_after(service, bus, watch, is_final=is_final)
        if any(s.given_up and _is_needed(s.name, watch) for s in services):
            return
        silence.look(services, watch)
        show(watch)
        if not any(service.is_watched for service in services[1:]):
            return
        leaving = leaving or (_Leaving() if is_final else None)
        if leaving is not None and leaving.stands_still(services, watch):
            _end_who_stays(services[1:], watch)
            return


def _receive(bus: Bus, watch: Watch) -> None:
    try:
        watch.take(bus)
    except BusError as error:
        if str(error) not in watch.failures:
            watch.failures.append(str(error))
        time.sleep(TURN_S)


def _look_after(service: Supervised, bus: Bus, watch: Watch, *, is_final: bool) -> None:
    if not service.is_watched:
        return
    if service.due is not None:
        service.start_again()
        return
    status = service.child.exit
    if status is None:
        return
    if status > 0 and not is_final and not service.has_ended_for(END_DELAY_S):
        return  # a provisional end may not have arrived yet
    failed_at_the_end = is_final and status > 0
    if (status == 0 and service.name != "router") or failed_at_the_end:
        service.over = True
        if failed_at_the_end:
            ended = service.child.ended()
            watch.failures += [] if names_only(ended, lacking_in(watch)) else [failure(ended)]
        return
    ended = service.child.ended()
    service.died(watch.progress(_node_of(service.name)))
    if not service.given_up:
        watch.restarts[service.name] = service.restarts + 1
        watch.note(f"{ended.name} (pid {ended.pid}) {ended.how}: it is started again")
        return
    deaths = f"it died {service.fruitless} times without progress, and is given up"
    watch.given_up.append(service.name)
    watch.failures.append(f"{failure(ended)}; {deaths}")
    node = _node_of(service.name)
    order = m.GivenUp(stamp_ns=0, node=node, by="launch", reason=f"{ended.how}; {deaths}")
    if not _is_needed(service.name, watch):
        with suppress(BusError):  # reported by `_receive`
            publish_order(bus, Outgoing(ch.GIVEN_UP, node, order), watch.signer)


class _Leaving:
    def __init__(self) -> None:
        self._reached = (-1, -1.0)
        self._since_s = 0.0

    def stands_still(self, services: Sequence[Supervised], watch: Watch) -> bool:
        """Whether nothing has changed for LEAVING_S."""
        now_s = time.monotonic()
        reached = sum(not service.is_watched for service in services), watch.progress("recorder")
        if reached != self._reached:
            self._reached, self._since_s = reached, now_s
        return now_s - self._since_s > LEAVING_S


def _end_who_stays(services: Sequence[Supervised], watch: Watch) -> None:
    for service in services:
        if service.is_watched:
            service.child.kill()
            name = f"{service.name} (pid {service.child.pid})"
            stopped = ", since it was stopped" if service.child.is_stopped else ""
            watch.failures.append(
                f"{name} had not left after the final map, with no activity for {LEAVING_S:g} s"
                f"{stopped}: it was ended"
            )


class Silence:
    """Report of processes that send nothing."""

    def __init__(self, end_s: float | None) -> None:
        self._end_s = end_s
        self._silent: set[int] = set()
        self._last_note: dict[str, float] = {}

    def look(self, services: Sequence[Supervised], watch: Watch) -> None:
        """Report newly silent processes; end one after end_silent_s."""
        now = time.monotonic()
        new: list[tuple[Supervised, float]] = []
        for service in services:
            child = service.child
            if not service.is_watched or service.due is not None or child.exit is not None:
                self._silent.discard(child.pid)
                continue
            last_message = watch.last_message.get(_node_of(service.name), 0.0)
            if service.name == "router":  # has no messages: all others are silent with it
                last_message = max(watch.last_message.values(), default=0.0)
            silent_s = now - max(last_message, child.started)
            if silent_s < SILENT_S:
                self._silent.discard(child.pid)
                continue
            if last_message < child.started and silent_s < STARTING_S and not child.is_stopped:
                continue
            if child.pid not in self._silent:
                self._silent.add(child.pid)
                new.append((service, silent_s))
            if self._end_s is not None and silent_s >= self._end_s:
                watch.note(f"{service.name} (pid {child.pid}) was silent {silent_s:.0f} s: ended")
                child.kill()
        self._tell(new, watch)

    def _tell(self, new: Sequence[tuple[Supervised, float]], watch: Watch) -> None:
        many = len(self._silent) > FEW
        for service, silent_s in new:
            if service.child.is_stopped or (not many and self._is_due(service.name)):
                watch.note(_describe_silence(service, silent_s))
        if many and new and self._is_due(MANY):
            named = ", ".join(service.name for service, _ in new[:FEW])
            watch.note(
                f"{len(self._silent)} processes, {named} among them, have sent no message for "
                f"{SILENT_S:.0f} s: this computer may be too busy for the team, which goes on "
                "slower"
            )

    def _is_due(self, subject: str) -> bool:
        now = time.monotonic()
        due = now >= self._last_note.get(subject, -math.inf) + REPEAT_S
        if due:
            self._last_note[subject] = now
        return due


def _describe_silence(service: Supervised, silent_s: float) -> str:
    """Describe a silent process; the remedy is to kill it only if it stands still."""
    child = service.child
    if child.is_stopped:
        state, stands_still = "is stopped (SIGSTOP?)", True
    elif child.is_computing:
        state, stands_still = "is computing", False
    else:
        state, stands_still = "is there", silent_s >= STARTING_S
    remedy = f". To have it started again: kill -9 {child.pid}" * stands_still
    return (
        f"{service.name} (pid {child.pid}) {state} and has sent no message for {silent_s:.0f} s: "
        f"the team may wait for it{remedy}"
    )


def lacking_in(watch: Watch) -> str:
    """Robots missing in the final map."""
    return "" if watch.fused is None or not watch.fused.final else describe_missing(watch.fused)


def names_only(ended: Ended, lacks: str) -> bool:
    """Whether it failed only because of missing robots."""
    last = ended.last_lines[-1] if ended.last_lines else ""
    return bool(lacks) and ended.exit == 1 and last.endswith(f"error: {lacks}")


def failure(ended: Ended) -> str:
    """How a process failed, with its last lines."""
    parts = [f"{ended.name} (pid {ended.pid}) {ended.how}"]
    if ended.last_lines:
        parts.append("its last lines:\n" + "\n".join(f"    {line}" for line in ended.last_lines))
    return "; ".join(parts)
