"""Commands of one process each: router, world, robot, central, record. `launch` starts them."""

import logging
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import click

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import (
    Group,
    argument,
    fail,
    option,
    output_option,
    rare,
    refuse,
    refusing,
)
from teamslam.sim.scenarios.scenario import Scenario, scenario_warnings, with_options

if TYPE_CHECKING:
    from teamslam.team.recording.parts import OwnLog
    from teamslam.team.wire.channels import Channel

_LOG = logging.getLogger("teamslam")

app = Group()


def _connected(scenario: Scenario, connect: str) -> None:
    _LOG.info("connected to team %s at %s", scenario.team, connect)


@app.declare("teamslam router --listen tcp/192.168.1.5:7447 --keys keys")
def router(
    listen: Annotated[
        str, option("Where to listen; port 0: any free one.", "ENDPOINT")
    ] = opt.LOOPBACK,
    keys: opt.Keys = None,
    insecure: Annotated[
        bool, option("Without keys, admit every process that reaches it, also from other machines.")
    ] = False,
) -> None:
    """Run the team's Zenoh router, of which every other process is a client, until it is
    stopped.

    With --keys it admits nodes with a certificate, each of which may publish on
    its own keys only.
    """
    from teamslam.team.keys.roster import load_roster
    from teamslam.team.shell import process
    from teamslam.team.wire.zenoh.router import router as zenoh_router

    opt.refuse_open_door(listen, keys=keys is not None, insecure=insecure)
    own = None if keys is None else (opt.own_keys(keys, "router"), load_roster(keys))
    at = opt.over_tls(listen) if keys else listen
    with process("router", endless=True) as stop, zenoh_router(at, own) as endpoint:
        if own is not None and own[1].revoked:
            _LOG.info("revoked and refused: %s", ", ".join(sorted(own[1].revoked)))
        click.echo(f"listening at {endpoint}")
        while not stop.wait(1.0):
            if own is not None and time.time() > own[0].ends.timestamp():
                fail(
                    f"{own[0].certificate} has expired, so every link is closed: renew it by "
                    f"`teamslam keys {own[0].team} -o DIR --renew router`, copy it, and start the "
                    "router again"
                )


@app.declare("teamslam world waypoints --speed max")
def world(
    scenario: opt.ScenarioArgument,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    speed: opt.SpeedText = "1",
    recorder: Annotated[bool, rare("Wait for a recorder before the first measurement.")] = True,
    cache: Annotated[
        int | None,
        rare("Measurements per robot that can be asked for again; default: all.", "N", least=0),
    ] = None,
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    dataset: opt.Dataset = None,
) -> None:
    """Run the world: a simulator or a data set that publishes every robot's measurements."""
    from teamslam.sim.publisher.main import run_world
    from teamslam.sim.scenarios.source import streams_of
    from teamslam.team.shell import process

    pace = opt.parse_speed(speed)
    resolved = with_options(opt.scenario_of(scenario), robots=robots, seed=seed, dataset=dataset)
    streams = streams_of(resolved)
    with (
        process("world") as stop,
        opt.connect_bus(resolved.team, connect, keys, "world", stop) as bus,
    ):
        _connected(resolved, connect)
        for text in scenario_warnings(resolved):
            _LOG.warning("%s", text)
        run_world(bus, resolved, streams, stop, speed=pace, recorder=recorder, cache=cache)


@app.declare("teamslam robot waypoints r1 --connect tcp/192.168.1.5:7447")
def robot(
    scenario: opt.ScenarioArgument,
    name: Annotated[str, argument("The robot's name in the scenario, as r1.")],
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    estimator: opt.EstimatorOption = None,
    fusion: opt.FusionOption = None,
    log: Annotated[
        Path | None,
        option(
            "Its own log: what it sends and receives; `teamslam log merge` joins such logs.", "FILE"
        ),
    ] = None,
    peers: opt.Peers = False,
    store: Annotated[
        Path | None,
        rare(
            "With --peers: the file that stores the team's set, of one run only.", "--set", "FILE"
        ),
    ] = None,
    fold: Annotated[
        Literal["always", "request", "end"],
        rare(
            "With --peers: fold the set always, on request (`teamslam map peer`) and at the "
            "end, or at the end only.",
            "always|request|end",
        ),
    ] = "always",
    map_: opt.MapFiles = None,
) -> None:
    """Run a robot, which estimates from its sensor stream and publishes submaps, maps and
    poses.

    After a crash it resumes after its last submap. With --peers it keeps the
    whole team's submaps and computes the team's map itself.
    """
    from teamslam.team.robot.main import RobotShell
    from teamslam.team.shell import process

    resolved = with_options(
        opt.scenario_of(scenario),
        robots=robots,
        seed=seed,
        estimator=estimator,
        fusion=fusion,
        peers=peers,
    )
    config = resolved.config_of(name)
    if config is None:
        known = ", ".join(each.id for each in resolved.robots)
        refuse(f"{scenario} has no robot {name!r}; its robots: {known}")
    opt.check_names(resolved.team, name)
    maps = opt.saved_maps(map_)
    if maps and not resolved.peers:
        refuse("--map is for the centre, or for a robot with --peers")
    with (
        process(f"robot-{name}") as stop,
        _own_log(log, resolved) as tap,
        opt.connect_bus(resolved.team, connect, keys, f"robot-{name}", stop) as bus,
    ):
        bus.tap = tap
        _connected(resolved, connect)
        if not resolved.peers:
            RobotShell(bus, config, stop, exchange=resolved.exchange).run()
            return
        from teamslam.central.peers.main import PeerShell
        from teamslam.sim.radio.bus import behind_radio
        from teamslam.team.peers.set_file import SetFileError

        with refusing(SetFileError):
            shell = PeerShell(
                bus if resolved.radio.is_perfect else behind_radio(bus, name, resolved.radio),
                config,
                stop,
                central=resolved.central,
                robots=[each.id for each in resolved.robots],
                store=store,
                exchange=resolved.exchange,
                when=fold,
                signer=opt.signer_of(keys, f"robot-{name}", resolved.team),
                maps=maps,
            )
        shell.run()


def _own_log(log: Path | None, scenario: Scenario) -> AbstractContextManager["OwnLog | None"]:
    if log is None:
        return nullcontext()
    from teamslam.team.recording.parts import own_log

    return own_log(log, scenario.team)


@app.declare("teamslam central waypoints")
def central(
    scenario: opt.ScenarioArgument,
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    patience: Annotated[
        float | None,
        option(
            "Give up a robot that has been lost for this many seconds; default: wait for "
            "it. A final map without it is provisional.",
            "S",
            least=0.0,
        ),
    ] = None,
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    estimator: opt.EstimatorOption = None,
    fusion: opt.FusionOption = None,
    peers: opt.Peers = False,
    store: Annotated[
        Path | None,
        option(
            "The file that stores the team's set, of one run only; a centre that is started "
            "again continues from it.",
            "--set",
            "FILE",
        ),
    ] = None,
    map_: opt.MapFiles = None,
) -> None:
    """Run the central computer, which fuses the robots' maps and broadcasts the fused map back.

    With --peers it is one more peer, which may join and leave at any time.
    """
    from teamslam.central.main import CentralShell
    from teamslam.central.peers.main import CentreShell
    from teamslam.team.peers.set_file import SetFileError
    from teamslam.team.shell import process

    resolved = with_options(
        opt.scenario_of(scenario),
        robots=robots,
        seed=seed,
        estimator=estimator,
        fusion=fusion,
        peers=peers,
    )
    maps = opt.saved_maps(map_)
    opt.check_joins(resolved, maps)
    with (
        process("central") as stop,
        opt.connect_bus(resolved.team, connect, keys, "central", stop) as bus,
    ):
        _connected(resolved, connect)
        of_team = bus, resolved.central, [config.id for config in resolved.robots], stop
        with refusing(SetFileError):
            if resolved.peers:
                signer = opt.signer_of(keys, "central", resolved.team)
                CentreShell(*of_team, store=store, signer=signer, maps=maps).run()
            else:
                admit = resolved.admits
                CentralShell(*of_team, patience, admit=admit, store=store, maps=maps).run()


@app.declare("teamslam record waypoints -o team.mcap")
def record(
    scenario: opt.ScenarioArgument,
    output: Annotated[Path, output_option("The MCAP file to write.", "FILE")],
    connect: opt.Connect = opt.LOOPBACK,
    keys: opt.Keys = None,
    resume: Annotated[
        bool,
        option(
            "An existing log is of this run, however old: continue it; if it is finished, end "
            "with 0.",
            "--resume",
        ),
    ] = False,
    join_parts: Annotated[
        bool, rare("Join the parts of the log at the end.", "--join/--no-join")
    ] = True,
) -> None:
    """Record every message of the team to one MCAP file, until the team has left.

    Restarted during the run, it writes a further part and requests missed
    messages; at the end the parts are joined. Restarted after the end, it
    completes an interrupted join.
    """
    from teamslam.sim.scenarios.scenario import dumps
    from teamslam.team.recording.parts import check_continues, next_part
    from teamslam.team.recording.provenance import provenance
    from teamslam.team.recording.reader import LogError, parts_of
    from teamslam.team.recording.shell import RecordLoop
    from teamslam.team.shell import process
    from teamslam.team.wire.channels import FINAL_MAP, TEAM_FINAL, robot_node

    resolved = opt.scenario_of(scenario)
    output.parent.mkdir(parents=True, exist_ok=True)
    metadata = {**provenance(), "seed": str(resolved.seed), "scenario": dumps(resolved)}
    exists = output.exists()
    if exists and not output.is_file():
        opt.refuse_existing(output)
    peers = [robot.id for robot in resolved.robots] if resolved.peers else []
    ends = (FINAL_MAP, TEAM_FINAL) if peers else (FINAL_MAP,)
    with refusing(LogError):
        is_over = exists and not check_continues(
            output, resolved.team, metadata, same_run=resume, ends=ends
        )
    if is_over:
        click.echo(f"{output} was finished by an earlier recorder", err=True)
        _fail_if_provisional(_join_parts(output) if join_parts else parts_of(output), ends)
        return
    expected = [robot_node(r.id) for r in resolved.robots]
    expected += ["central"] if resolved.centre else []
    expected += [] if resolved.is_live else ["world"]
    configurations = []
    if resolved.is_live:  # saves other teams' recorders its 105 MB
        from teamslam.team.wire.digest import announce_configuration

        configurations = [announce_configuration("world", 0, 0, resolved)]
    with (
        process("recorder", endless=True) as stop,
        opt.connect_bus(resolved.team, connect, keys, "recorder", stop) as bus,
    ):
        recorder, inventory = next_part(output, resolved.team, metadata)
        _connected(resolved, connect)
        if exists:
            _LOG.info("%s goes on in %s", output, recorder.path.name)
        try:
            more = partial(next_part, output, resolved.team, metadata)
            loop = RecordLoop(bus, recorder, expected, inventory, more, peers)
            written = loop.run(stop, configurations)
            _LOG.info("wrote %s, %d messages", recorder.path, written)
        finally:
            parts = _join_parts(output) if join_parts else parts_of(output)
    _fail_if_provisional(parts, ends)


def _join_parts(log: Path) -> list[Path]:
    from teamslam.team.recording.parts import join_parts

    parts = join_parts(log)
    if len(parts) > 1:
        whole = log.with_stem(f"{log.stem}.whole")
        _LOG.warning(
            "no room to join the parts of the log: all commands read %s as one log; to have one "
            "file elsewhere: teamslam log repair %s --output %s",
            " ".join(str(part) for part in parts),
            log,
            whole,
        )
    return parts


def _fail_if_provisional(parts: Sequence[Path], ends: "Sequence[Channel]") -> None:
    from teamslam.team.recording.reader import LogError, open_log
    from teamslam.team.shell import describe_missing
    from teamslam.team.wire.codec import WireError, decoded
    from teamslam.team.wire.messages import FusedMap

    found: dict[str, str] = {}
    for part in parts:
        try:
            for sample in open_log(part).samples(ends):
                found[sample.key] = describe_missing(decoded(sample.payload, FusedMap))
        except (LogError, WireError, OSError) as error:
            _LOG.debug("%s", error)
    if lacks := "; ".join(dict.fromkeys(filter(None, found.values()))):
        fail(lacks)
