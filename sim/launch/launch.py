"""`teamslam launch`: the whole team as processes, watched until its final map is there."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from sim.launch.supervisor import Child, Ended, end_all
from sim.launch.truth import LiveErrors
from sim.scenario.scenario import Scenario, dumps
from team.keys.credentials import credentials_of
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Bus, BusError, opened
from team.wire.codec import WireError
from team.wire.zenoh_bus import ZenohBus

ROUTER_PATIENCE_S = 20.0
"""The router must say where it listens within this time; a busy machine starts Python slowly."""
REFUSED = 2
"""The exit status of a command that can not do what it was asked for."""
TURN_S = 0.1
_ESSENTIAL = ("router", "world", "central", "recorder")


class LaunchError(RuntimeError):
    """The team could not be started or did not end well; the text says who and why."""


@dataclass
class Outcome:
    """What a launch left behind."""

    log: Path
    folder: Path
    wall_s: float
    processes: list[Ended]
    failures: list[str] = field(default_factory=list)


@dataclass
class Watch:
    """What is known of the team while it runs: the last status of each node, and the last map.

    robots: how many there are to be. errors: against the truth, where there is one. place: by what
    other commands reach the team.
    """

    statuses: dict[str, m.Status] = field(default_factory=dict)
    fused: m.FusedMap | None = None
    failures: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)
    robots: int = 0
    errors: LiveErrors = field(default_factory=LiveErrors)
    place: str = ""

    def take(self, bus: Bus) -> None:
        """Take what has come since."""
        for sample in bus.receive(TURN_S):
            found = ch.channel_of(sample.key)
            if found is None or not self.errors.wants(*found, sample):
                continue
            try:
                channel, _, message = opened(sample)
            except WireError:
                continue
            if isinstance(message, m.Status):
                self.statuses[message.node] = message
            elif isinstance(message, m.FusedMap):
                self.fused = message
            elif isinstance(message, m.Fault):
                self._take_fault(message)
            self.errors.take(channel, message)

    def _take_fault(self, fault: m.Fault) -> None:
        """The first of a node is a failure by name; its status counts the rest."""
        named = f"{fault.node} set aside "
        if not any(failure.startswith(named) for failure in self.failures):
            what = f"{fault.key}: {fault.error} at {fault.place}: {fault.text}"
            self.failures.append(f"{named}{what}")


@dataclass(frozen=True)
class Plan:
    """What is to be launched."""

    scenario: Scenario
    folder: Path
    log: Path
    speed: float
    listen: str
    views: bool = True
    keys: Path | None = None
    insecure: bool = False

    @property
    def door(self) -> list[str]:
        """How every process gets in: the option, or nothing where the door is open."""
        return [] if self.keys is None else ["--keys", str(self.keys)]


def launch(plan: Plan, show: Callable[[Watch], None]) -> Outcome:
    """Start router, recorder, world, centre and robots; return when all have ended.

    `show` is called again and again with what is known. A robot that dies is named and the others
    go on, unless the world still waits for it; when the router, the world, the centre or the
    recorder dies, the run ends. Raises BusError when the router can not listen there, LaunchError
    when it does not come up. SIGINT and SIGTERM end every process and raise KeyboardInterrupt.
    """
    began = time.monotonic()
    plan.folder.mkdir(parents=True, exist_ok=True)
    resolved = plan.folder / "scenario.json"
    resolved.write_text(dumps(plan.scenario))
    watch = Watch(began=began, robots=len(plan.scenario.robots))
    with _interruptible(), _children() as children:
        team = plan.scenario.team
        own = None if plan.keys is None else credentials_of(plan.keys, "operator", team)
        door = "".join(f" {word}" for word in plan.door)
        endpoint = _start_router(plan, children)
        watch.place = f"--team {team} --connect {endpoint}{door}"
        with ZenohBus(team, endpoint, keys=own) as bus:
            bus.subscribe(ch.STATUS)
            bus.subscribe(ch.FUSED_MAP)
            bus.subscribe(ch.FINAL_MAP)
            bus.subscribe(ch.FAULT)
            for channel in watch.errors.listens:
                bus.subscribe(channel)
            for name, arguments in _commands(plan, resolved, endpoint):
                children.append(Child(name, arguments, plan.folder))
            again = {
                f"robot-{r.id}": f"teamslam robot {resolved} {r.id} --connect {endpoint}{door}"
                for r in plan.scenario.robots
            }
            _supervise(children, bus, watch, show, again)
        ended = end_all(children)
    failures = watch.failures + [
        _failure(e)
        for e in ended
        if e.exit != 0
        and not e.asked
        and not any(f.startswith(f"{e.name} ") for f in watch.failures)
    ]
    return Outcome(plan.log, plan.folder, time.monotonic() - began, ended, failures)


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM interrupts as Ctrl-C does, so that the log is completed."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _children() -> Iterator[list[Child]]:
    children: list[Child] = []
    try:
        yield children
    finally:
        end_all(children)


def _start_router(plan: Plan, children: list[Child]) -> str:
    door = [*plan.door, *(["--insecure"] if plan.insecure else [])]
    router = Child("router", ["router", "--listen", plan.listen, *door], plan.folder)
    children.append(router)
    deadline = time.monotonic() + ROUTER_PATIENCE_S
    while time.monotonic() < deadline:
        for line in router.last_lines():
            if line.startswith("listening at "):
                return line.removeprefix("listening at ").strip()
        if router.exit is not None:
            said = "\n".join(router.last_lines()).removeprefix("error: ")
            refused = BusError if router.exit == REFUSED else LaunchError
            raise refused(said or f"the router {router.ended().how}")
        time.sleep(0.02)
    raise LaunchError(f"the router did not come up within {ROUTER_PATIENCE_S:g} s")


def _commands(plan: Plan, resolved: Path, endpoint: str) -> list[tuple[str, list[str]]]:
    common = [str(resolved), "--connect", endpoint, *plan.door]
    speed = "max" if plan.speed == float("inf") else repr(plan.speed)
    robots = [(f"robot-{r.id}", ["robot", *common, r.id]) for r in plan.scenario.robots]
    return [
        ("recorder", ["record", *common, "--output", str(plan.log)]),
        ("central", ["central", *common]),
        *robots,
        *([("viewer", ["viewer", *common])] if plan.views else []),
        ("world", ["world", *common, "--speed", speed]),
    ]


def _supervise(
    children: Sequence[Child],
    bus: Bus,
    watch: Watch,
    show: Callable[[Watch], None],
    again: Mapping[str, str],
) -> None:
    """Until every process but the router has ended, or an essential one has failed.

    again: the commands that start those anew which a run can lose, by name.
    """
    named: dict[str, m.Status | None] = {}  # a process that died -> the world's status then
    while True:
        try:
            watch.take(bus)
        except BusError as error:
            watch.failures.append(str(error))
            return
        for child in children:
            if child.exit in (None, 0) or child.name in named:
                continue
            named[child.name] = watch.statuses.get("world")
            watch.failures.append(_failure(child.ended(), again.get(child.name)))
            if child.name in _ESSENTIAL:
                return
        if _waits_in_vain(watch.statuses.get("world"), named.values()):
            return
        if children[0].exit is not None:
            watch.failures.append("router ended before the team did")
            return
        show(watch)
        if all(child.exit is not None for child in children[1:]):
            return


def _waits_in_vain(world: m.Status | None, then: Iterable[m.Status | None]) -> bool:
    """Whether the world says, after a death, that it still waits for everyone to be there."""
    return world is not None and world.state == "waiting" and any(world is not s for s in then)


def _failure(ended: Ended, again: str | None = None) -> str:
    parts = [f"{ended.name} (pid {ended.pid}) {ended.how}"]
    if again is not None:
        parts.append(f"while the others go on, start it again by: {again}")
    if ended.last_lines:
        parts.append("its last lines:\n" + "\n".join(f"    {line}" for line in ended.last_lines))
    return "; ".join(parts)
