"""`teamslam launch`: the team as processes, supervised until the final map."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from teamslam.central.desk.peers_as_centre import LISTENS, PeersAsCentre
from teamslam.sim.launch.processes import Ended, Used, end_all, environment_of
from teamslam.sim.launch.supervision import Supervised, failure, lacking_in, names_only, supervise
from teamslam.sim.launch.watch import COMPARED, Watch
from teamslam.sim.scenarios.scenario import Scenario, dumps
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import BusError
from teamslam.team.wire.zenoh.bus import ZenohBus


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Processes of `launch`, with files and options."""

    scenario: Scenario
    folder: Path
    log: Path
    speed: float
    listen: str
    views: bool = True
    end_silent_s: float | None = None
    keys: Path | None = None
    insecure: bool = False
    maps: tuple[Path, ...] = ()

    @property
    def door(self) -> list[str]:
        """Certificate option of every process."""
        return [] if self.keys is None else ["--keys", str(self.keys)]

    def fold_options(self, node: str) -> list[str]:
        """Options of a peer or centre that joins submaps: file of its set, saved maps."""
        scenario = self.scenario
        if not (scenario.peers or (node == "central" and scenario.central.fusion == "join")):
            return []
        maps = [word for path in self.maps for word in ("--map", str(path.resolve()))]
        return ["--set", str(self.folder / f"{node}.set"), *maps]

    @property
    def earlier_sets(self) -> list[Path]:
        """Sets of an earlier run in this folder."""
        return sorted(self.folder.glob("*.set"))


ROUTER_PATIENCE_S = 20.0  # time [s] within which the router reports its endpoint
POSES = (ch.OWN_POSE, ch.TEAM_POSE)  # channels that may lose messages to a slow observer
REFUSED = 2  # exit status for an impossible request


class LaunchError(RuntimeError):
    """The team did not start."""


@dataclass
class Outcome:
    """Result of a launch.

    deaths: processes killed at the end and not restarted; no failure if map and log are whole.
    used: resources over all lives.
    """

    log: Path
    folder: Path
    wall_s: float
    processes: list[Ended]
    failures: list[str] = field(default_factory=list)
    deaths: list[str] = field(default_factory=list)
    restarts: dict[str, int] = field(default_factory=dict)
    given_up: list[str] = field(default_factory=list)
    used: dict[str, Used] = field(default_factory=dict)
    end_reason: str = ""


def launch(plan: Plan, show: Callable[[Watch], None]) -> Outcome:
    """Start router, recorder, world, centre and robots; return when all have ended.

    A dead process is restarted or given up. Raises BusError if the router cannot listen,
    LaunchError if it does not start. SIGINT and SIGTERM end every process and raise
    KeyboardInterrupt.
    """
    began, environment = time.monotonic(), environment_of(time.time_ns())
    resolved = plan.folder / "scenario.json"
    resolved.write_text(dumps(plan.scenario))
    services: list[Supervised] = []

    def start(name: str, words: list[str]) -> Supervised:
        services.append(Supervised(name, words, plan.folder, environment))
        return services[-1]

    def end() -> list[Ended]:
        return end_all([service.child for service in services])

    with _interruptible(), ExitStack() as running:
        running.callback(end)
        insecure = ["--insecure"] if plan.insecure else []
        router = start("router", ["router", "--listen", plan.listen, *plan.door, *insecure])
        ids = tuple(robot.id for robot in plan.scenario.robots)
        drivers = ids if plan.scenario.is_live else None
        watch = Watch(began=began, robots=ids, drivers=drivers)
        team = plan.scenario.team
        own = None
        if plan.keys is not None:
            from teamslam.team.keys.credentials import credentials_of

            own = credentials_of(plan.keys, "operator", team)
        endpoint, connected = enter_team(
            router, lambda at: ZenohBus(team, at, keys=own, sheds=POSES)
        )
        watch.place = " ".join(("--team", team, "--connect", endpoint, *plan.door))
        at = f'team="{team}", connect="{endpoint}"'
        watch.call = at if plan.keys is None else f'{at}, keys="{plan.keys}"'
        with connected as bus:
            for channel in (ch.STATUS, ch.FUSED_MAP, ch.FINAL_MAP, ch.FAULT, *COMPARED):
                bus.subscribe(channel)
            if plan.scenario.peers:
                watch.peers = frozenset(ids)
                watch.centre = PeersAsCentre(watch.peers)
                for channel in LISTENS:
                    bus.subscribe(channel)
                bus.watch_alive("central")
                if own is not None:
                    from teamslam.team.keys.signing import Signer

                    watch.signer = Signer(own)
            for name, words in _commands(plan, resolved, endpoint):
                start(name, words)
            supervise(services, bus, watch, show, plan.end_silent_s)
        ended = end()
    lacks = lacking_in(watch)
    wrong = [
        each
        for each in ended
        if each.exit != 0
        and not each.asked
        and not any(text.startswith(f"{each.name} ") for text in watch.failures)
        and not names_only(each, lacks)
    ]
    failures = watch.failures + [failure(each) for each in wrong if each.exit > 0]
    failures += [lacks] if lacks else []
    return Outcome(
        log=plan.log,
        folder=plan.folder,
        wall_s=time.monotonic() - began,
        processes=ended,
        failures=failures,
        deaths=[failure(each) for each in wrong if each.exit < 0],
        restarts=watch.restarts,
        given_up=watch.given_up,
        used={s.name: s.used.and_later(e.used) for s, e in zip(services, ended, strict=True)},
        end_reason=watch.end_reason,
    )


@contextmanager
def _interruptible() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C, so the log is completed."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def enter_team(router: Supervised, enter: Callable[[str], ZenohBus]) -> tuple[str, ZenohBus]:
    """Router's endpoint, and a bus there.

    A router killed meanwhile is restarted; its own refusal is raised.
    """
    while True:
        try:
            endpoint = _endpoint(router)
            return endpoint, enter(endpoint)
        except (BusError, LaunchError):
            if router.child.exit is None or router.child.exit >= 0:
                raise
            router.died(0.0)
            if router.given_up:
                raise
        while router.due is not None:
            time.sleep(0.02)
            router.start_again()


def _endpoint(service: Supervised) -> str:
    router = service.child
    deadline = time.monotonic() + ROUTER_PATIENCE_S
    while time.monotonic() < deadline:
        for line in router.last_lines():
            if line.startswith("listening at "):
                endpoint = line.removeprefix("listening at ").strip()
                service.arguments[2] = endpoint
                return endpoint
        if router.exit is not None:
            words = "\n".join(router.last_lines()).removeprefix("error: ")
            refused = BusError if router.exit == REFUSED else LaunchError
            raise refused(words or f"the router {router.ended().how}")
        time.sleep(0.02)
    raise LaunchError(f"the router did not come up within {ROUTER_PATIENCE_S:g} s")


def _commands(plan: Plan, resolved: Path, endpoint: str) -> list[tuple[str, list[str]]]:
    common = [str(resolved), "--connect", endpoint, *plan.door]
    speed = "max" if plan.speed == float("inf") else repr(plan.speed)
    recording = ["record", *common, "--output", str(plan.log), "--resume", "--no-join"]
    commands = [("recorder", recording)]
    if not plan.scenario.is_live:
        commands.append(("world", ["world", *common, "--speed", speed]))
    if plan.scenario.centre:
        commands.append(("central", ["central", *common, *plan.fold_options("central")]))
    ids = (each.id for each in plan.scenario.robots)
    commands += [(f"robot-{i}", ["robot", *common, i, *plan.fold_options(i)]) for i in ids]
    return commands + ([("viewer", ["viewer", *common])] if plan.views else [])
