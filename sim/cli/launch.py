"""Commands `teamslam launch` and `teamslam localise`."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, replace
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from teamslam.central.desk.names import data_set_name
from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import (
    INTERRUPTED,
    Group,
    argument,
    fail,
    network,
    option,
    output_option,
    rare,
    refuse,
)
from teamslam.sim.cli.importing import import_into
from teamslam.sim.cli.results import Steps, print_evaluation, print_nis, print_written, read_run
from teamslam.sim.cli.view import FoxglovePort, Open, Port, show_on_page
from teamslam.sim.scenarios.scenario import ASSUMED_NAME, Scenario, scenario_warnings, with_options
from teamslam.team.extras import install_command

if TYPE_CHECKING:
    from teamslam.central.desk.report.run import Run
    from teamslam.sim.launch.launch import Outcome, Plan
    from teamslam.sim.world.streams import WorldStreams

app = Group()


@app.declare("teamslam launch waypoints --view\nteamslam launch --dataset my_set -o runs/first")
def launch(
    scenario: Annotated[
        str | None,
        argument("A built-in scenario or a .toml file; default: thesis, or the data set's own."),
    ] = None,
    dataset: opt.Dataset = None,
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    speed: opt.SpeedText = "max",
    view: Annotated[bool, option("Show the run on a page, until Ctrl-C.", "--view")] = False,
    output: Annotated[
        Path | None, output_option("The run's folder; default: a new one below runs/.", "DIR")
    ] = None,
    identities: opt.IdentitiesOption = None,
    without_centre: Annotated[
        bool, option("No central computer: robots are peers.", "--without-centre")
    ] = False,
    report: Annotated[bool, option("Draw the pictures and write the report.")] = True,
    browser: Open = None,
    map_: opt.MapFiles = None,
    localise: opt.Localise = False,
    record: Annotated[
        Path | None, rare("The log to write; default: log.mcap in the run's folder.", "FILE")
    ] = None,
    json_file: opt.JsonFile = None,
    pieces: opt.Pieces = None,
    estimator: opt.EstimatorOption = None,
    fusion: opt.FusionOption = None,
    peers: opt.Peers = False,
    comm_range: Annotated[
        float | None,
        rare(
            "Peers reach each other within this true distance in metres.",
            "--comm-range",
            "M",
            least=0.001,
        ),
    ] = None,
    views: Annotated[bool, rare("Record what Foxglove, Lichtblick and Rerun draw, too.")] = True,
    end_silent: Annotated[
        float | None,
        rare(
            "End a process that is silent for this many seconds, so that it is started "
            "again; default: only name it.",
            "S",
            least=10.0,
        ),
    ] = None,
    port: Port = 0,
    foxglove_port: FoxglovePort = None,
    listen: Annotated[
        str, network("Where the router listens; port 0: any free one.", "ENDPOINT")
    ] = opt.ANY_PORT,
    keys: opt.Keys = None,
    insecure: Annotated[
        bool, network("Without keys, admit everyone who reaches the router.")
    ] = False,
) -> None:
    """Launch a whole team, watch it, and end with a report and a log.

    Robots, world, central computer, recorder and router are processes. Exit
    status 0 only if every process ended well and every robot is in the final map;
    else 1. 2: wrong use; 130: interrupted.
    """
    pace = opt.parse_speed(speed)
    opt.refuse_open_door(listen, keys=keys is not None, insecure=insecure)
    if dataset is not None:
        from teamslam.team.ros2.bags import is_bag

        if is_bag(dataset):
            output = output or _new_folder(dataset.stem or "bag")
            dataset = import_into(dataset, output / (dataset.stem or "bag"))
    name = scenario or ("thesis" if dataset is None else opt.scenario_for(dataset))
    listed = opt.scenario_of(name)
    resolved = with_options(
        listed,
        robots=robots if pieces is None else pieces,
        seed=seed,
        estimator=estimator,
        fusion=fusion,
        dataset=dataset,
        peers=peers,
        centre=not without_centre,
        comm_range_m=comm_range,
        identities=identities,
        localise=localise,
    )
    if localise:
        opt.check_localises(map_, resolved)
    opt.check_joins(resolved, opt.saved_maps(map_))
    if pieces is not None:
        opt.check_pieces(resolved)
    resolved, missing, streams = _checked_world(resolved, listed)
    if name == ASSUMED_NAME and dataset is not None and streams is not None:
        click.echo(_how_to_learn(dataset, streams), err=True)
    if resolved.is_live and listen == opt.ANY_PORT:
        listen = opt.LOOPBACK  # must be reachable by drivers
    for text in (*scenario_warnings(resolved), *missing, *_time_warnings(streams)):
        click.echo(f"warning: {text}", err=True)
    if json_file is not None:
        _check_writable(json_file)
    folder = output or _new_folder(_name_of(resolved) or f"{resolved.name}-{resolved.seed}")
    log = record or folder / "log.mcap"
    log.parent.mkdir(parents=True, exist_ok=True)
    _keep_earlier(log)
    folder.mkdir(parents=True, exist_ok=True)
    from teamslam.sim.launch.launch import Plan

    plan = Plan(
        scenario=resolved,
        folder=folder,
        log=log,
        speed=pace,
        listen=listen if keys is None else opt.over_tls(listen),
        views=views,
        end_silent_s=end_silent,
        keys=keys and keys.resolve(),
        insecure=insecure,
        maps=tuple(map_ or ()),
    )
    for earlier_set in plan.earlier_sets:
        opt.set_aside(earlier_set)
    page = (
        show_on_page(log, "127.0.0.1", port, foxglove_port, browser, growing=True)
        if view
        else nullcontext()
    )
    with page as at:
        outcome = _launch(plan)
        try:
            _conclude(outcome, json_file, report=report)
        except KeyboardInterrupt:
            again = f"`teamslam report {outcome.log} -o {outcome.folder}` makes the report"
            fail(f"interrupted: the run is in {outcome.log}; {again}", INTERRUPTED)
        if at is not None:
            _keep_showing(at.url, log)


@app.declare(
    "teamslam localise --map site.map --dataset my_set\nteamslam localise --map site.map runs/day2"
)
def localise(
    map_: Annotated[Path, option("The saved map, which stays as it is.", "--map", "FILE")],
    source: Annotated[
        str | None,
        argument(
            "A scenario, or a log or the folder of a run; default: as of launch.", "[SCENARIO|LOG]"
        ),
    ] = None,
    dataset: opt.Dataset = None,
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    speed: opt.SpeedText = "max",
    output: Annotated[Path | None, output_option("The run's folder.", "DIR")] = None,
    json_file: opt.JsonFile = None,
) -> None:
    """Localise robots in a saved map, without mapping.

    The map is neither changed nor extended: the final map is the saved one, and
    poses and paths are in its frame. Robots need no start. With a log, its
    measurements are localised again.
    """
    from teamslam.sim.cli.rerun import rerun

    path = None if source is None else Path(source)
    if path is not None and (path.suffix == ".mcap" or path.is_dir()):
        rerun(path, map_=[map_], localise=True, seed=seed, output=output, json_file=json_file)
        return
    launch(
        source,
        dataset,
        robots,
        seed,
        speed,
        output=output,
        map_=[map_],
        localise=True,
        json_file=json_file,
    )


def _name_of(scenario: Scenario) -> str:
    path = getattr(scenario.world, "path", "")
    return data_set_name(Path(path).resolve()) if path else ""


def _launch(plan: "Plan") -> "Outcome":
    from teamslam.sim.launch.launch import LaunchError, launch
    from teamslam.sim.launch.live import show_live

    scenario = plan.scenario
    try:
        with show_live(_name_of(scenario) or f"{scenario.name}, seed {scenario.seed}") as show:
            return launch(plan, show)
    except LaunchError as error:
        fail(str(error))
    except KeyboardInterrupt:
        recorded_note = f"; {plan.log} holds what was recorded" if plan.log.exists() else ""
        fail(f"interrupted: every process of the team was ended{recorded_note}")


def _keep_showing(url: str, log: Path) -> None:
    from teamslam.team.shell import process

    with process("launch", endless=True) as stop:  # Ctrl-C may follow the line at once
        click.echo(f"page  {url} until Ctrl-C; later: teamslam view {log}")
        stop.wait()


def _checked_world(
    scenario: Scenario, listed: Scenario
) -> "tuple[Scenario, list[str], WorldStreams | None]":
    from teamslam.sim.world.config import LiveWorld, SimulatedWorld

    if isinstance(scenario.world, SimulatedWorld | LiveWorld):
        return scenario, [], None
    from teamslam.sim.scenarios.source import streams_of, with_present_robots

    present, missing = with_present_robots(scenario, listed)
    return present, [missing] if missing else [], streams_of(present)


def _time_warnings(streams: "WorldStreams | None") -> list[str]:
    if streams is None:
        return []
    from teamslam.central.desk.evaluation.clocks import separate_times_warning
    from teamslam.sim.datasets.folder_odometry import PACE

    notes = ((each.robot, note) for each in streams.streams for note in each.notes)
    paces = [f"{robot}: {note}" for robot, note in notes if note.startswith(PACE)]
    separate = separate_times_warning(streams.spans_ns)
    return [*paces, *([separate] if separate is not None else [])]


def _how_to_learn(dataset: Path, streams: "WorldStreams") -> str:
    from teamslam.sim.calibration.data import LEAST_SPANS, SPAN_S, moving_stretches

    found = moving_stretches(streams.streams)
    if found >= LEAST_SPANS:
        command = f"`teamslam calibrate {dataset} -o {dataset / 'scenario.toml'}`"
        if find_spec("scipy") is None:
            command = f"`{install_command('calibrate')}`, then {command}"
        if streams.landmarks is not None and any(s.truth is not None for s in streams.streams):
            return f"{command} learns your robots' own from the data"
        return (
            f"{command} learns the odometry's scales; without true paths and landmarks not the "
            "noise: write what you know of it into that file, and change it as the report's "
            "covariance scale advises (docs/faq.md)"
        )
    return (
        f"the data have {found} stretch{'es' * (found != 1)} of {SPAN_S:.0f} s with "
        f"motion, and `teamslam calibrate` needs {LEAST_SPANS}: write what you know of your robots "
        f"into {dataset / 'scenario.toml'} (docs/your_data.md), or record more"
    )


def _check_writable(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        is_new = not path.exists()
        path.open("a").close()
        if is_new:  # a waiting reader must find the file complete
            path.unlink()
    except OSError as error:
        refuse(f"--json {path}: {error.strerror}; give another path")


def _new_folder(name: str) -> Path:
    stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    base = Path("runs") / f"{name}-{stamp}"
    folder, number = base, 1
    while folder.exists():
        number += 1
        folder = base.with_name(f"{base.name}-{number}")
    return folder


def _keep_earlier(log: Path) -> None:
    if log.exists() and not log.is_file():
        refuse(f"--record {log}: not a regular file; give the path of a new log")
    if log.exists():
        from teamslam.team.recording.reader import part_of, parts_of

        parts = parts_of(log)
        aside = opt.set_aside(log)
        for number, part in enumerate(parts[1:], 2):
            part.rename(part_of(aside, number))


def _conclude(outcome: "Outcome", json_file: Path | None, *, report: bool) -> None:
    from teamslam.central.desk.evaluation.figures import to_json
    from teamslam.central.desk.names import in_order
    from teamslam.central.desk.report.run import read_log
    from teamslam.team.recording.parts import join_parts
    from teamslam.team.recording.reader import LogError, open_log

    join_parts(outcome.log)  # joined here, where it may take long
    click.echo(f"the run is over: {outcome.end_reason}; scoring it", err=True)
    steps = Steps()
    steps.begin("scoring the run")
    extra: dict[str, Any] = {
        "processes": {
            ended.name: {"pid": ended.pid, "exit": ended.exit} | asdict(outcome.used[ended.name])
            for ended in outcome.processes
        },
        "failures": outcome.failures,
        "restarts": outcome.restarts,
        "given_up": outcome.given_up,
        "log": str(outcome.log),
        "folder": str(outcome.folder),
        "wall_s": outcome.wall_s,
    }
    try:
        log = replace(open_log(outcome.log), reading=steps.share)
        reading = read_log(log)
    except (LogError, OSError) as error:
        outcome.failures += [*outcome.deaths, f"the log can not be evaluated: {error}"]
        figures = extra
    else:
        evaluation = reading.evaluation
        figures = to_json(evaluation, extra)
        print_evaluation(evaluation)
        if report:
            _write_report(read_run(log, reading, steps, proves_ledger=False), outcome, figures)
        if evaluation.map is None:
            outcome.failures.append("the run ended without a final map")
        outcome.failures += evaluation.disagreement
        outcome.failures += evaluation.failures  # with the reasons
        is_whole = not outcome.failures and reading.is_whole
        if outcome.deaths and is_whole:
            text = "; ".join(outcome.deaths)
            click.echo(f"note: {text}; map and log are whole")
        else:
            outcome.failures += outcome.deaths
    for name in in_order(outcome.restarts):
        times = outcome.restarts[name]
        click.echo(f"{name} was started again {opt.count_noun(times, 'time')}")
    click.echo(f"log   {outcome.log}")
    click.echo(f"{outcome.wall_s:.1f} s of wall time of the run")
    click.echo(f"show  teamslam view {outcome.log}")
    opt.write_json(json_file, figures)
    if outcome.failures:
        fail("\n".join(outcome.failures))


def _write_report(run: "Run", outcome: "Outcome", figures: Mapping[str, Any]) -> None:
    from teamslam.central.desk.report.page import write_report
    from teamslam.central.desk.report.run import run_figures

    click.echo("drawing the pictures and writing the report", err=True)
    print_nis(run.history)
    try:
        print_written(write_report(run, outcome.folder, {**figures, **run_figures(run)}))
    except OSError as error:
        outcome.failures.append(
            f"{outcome.folder}: can not write the report: {error.strerror}; "
            f"`teamslam report {outcome.log} -o FOLDER` makes it elsewhere"
        )
