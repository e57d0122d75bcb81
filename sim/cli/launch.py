"""`teamslam launch`."""

import json
import threading
import time
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sim.cli.options import (
    ANY_PORT,
    FAILED,
    WRONG_USE,
    Dataset,
    EstimatorOption,
    FusionOption,
    Keys,
    Robots,
    Seed,
    SpeedText,
    fail,
    over_tls,
    parsed_speed,
    refuse_open_door,
    scenario_for,
    scenario_of,
)
from sim.cli.view import FoxglovePort, Open, Port, shown_on_page
from sim.scenarios.scenario import Scenario, doubts, with_options

if TYPE_CHECKING:
    from sim.launch.launch import Outcome

PREPARING_S = 2.0
"""The kernels are spoken of when they take longer: then they are being compiled."""
app = typer.Typer()


@app.command()
def launch(
    scenario: Annotated[
        str | None,
        typer.Argument(
            help="A built-in scenario or a .toml file; default: thesis, or the data set's own."
        ),
    ] = None,
    dataset: Dataset = None,
    robots: Robots = None,
    estimator: EstimatorOption = None,
    fusion: FusionOption = None,
    seed: Seed = None,
    speed: SpeedText = "max",
    record: Annotated[
        Path | None, typer.Option(help="The log to write; default: log.mcap in the run's folder.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the result as JSON, too.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The run's folder; default: a new one below runs/."),
    ] = None,
    listen: Annotated[
        str, typer.Option(help="Where the router listens; port 0: any free one.")
    ] = ANY_PORT,
    keys: Keys = None,
    insecure: Annotated[
        bool, typer.Option(help="Without keys, let in whoever reaches the router.")
    ] = False,
    report: Annotated[bool, typer.Option(help="Draw the pictures and write the report.")] = True,
    views: Annotated[
        bool, typer.Option(help="Record what Foxglove, Lichtblick and Rerun draw, too.")
    ] = True,
    end_silent: Annotated[
        float | None,
        typer.Option(
            help="End a process that has said nothing for so many seconds, so that it is started "
            "again; default: name it only.",
            min=10.0,
        ),
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show the run on a page, until Ctrl-C.")
    ] = False,
    port: Port = 0,
    foxglove_port: FoxglovePort = 8765,
    browser: Open = None,
) -> None:
    """Launch a whole team here, watch it, and end with a report and a log.

    Every robot, the world, the central computer, the recorder and the router are processes.
    """
    from sim.scenarios.source import with_present_robots

    pace = parsed_speed(speed)
    refuse_open_door(listen, keys=keys is not None, insecure=insecure)
    name = scenario or ("thesis" if dataset is None else scenario_for(dataset))
    resolved = with_options(
        scenario_of(name),
        robots=robots,
        seed=seed,
        estimator=estimator,
        fusion=fusion,
        dataset=dataset,
    )
    resolved, missing = with_present_robots(resolved)
    _check_world(resolved)
    for text in (*doubts(resolved), *([missing] if missing else [])):
        typer.echo(f"warning: {text}", err=True)
    if json_file is not None:
        _check_writable(json_file)
    folder = output or _new_folder(resolved)
    log = record or folder / "log.mcap"
    log.parent.mkdir(parents=True, exist_ok=True)
    _keep_earlier(log)
    from sim.launch.launch import LaunchError, Plan
    from sim.launch.launch import launch as launched
    from sim.launch.live import shown

    _prepare(resolved)
    door = listen if keys is None else over_tls(listen)
    plan = Plan(
        scenario=resolved,
        folder=folder,
        log=log,
        speed=pace,
        listen=door,
        views=views,
        end_silent_s=end_silent,
        keys=keys and keys.resolve(),
        insecure=insecure,
    )
    page = (
        shown_on_page(log, "127.0.0.1", port, foxglove_port, browser, growing=True)
        if view
        else nullcontext()
    )
    with page as at:
        try:
            with shown(f"{resolved.name}, seed {resolved.seed}") as show:
                outcome = launched(plan, show)
        except LaunchError as error:
            fail(str(error), FAILED)
        except KeyboardInterrupt:
            kept = f"; {log} holds what was recorded" if log.exists() else ""
            fail(f"interrupted: every process of the team was ended{kept}", FAILED)
        _conclude(resolved, outcome, json_file, report=report)
        if at is not None:
            _keep_showing(at.url, log)


def _keep_showing(url: str, log: Path) -> None:
    """The page stays until somebody ends the command."""
    from team.shell import process

    typer.echo(f"page  {url} until Ctrl-C; later: teamslam view {log}")
    with process("launch", endless=True) as stop:
        stop.wait()


def _check_world(scenario: Scenario) -> None:
    """A data set that can not be read is found before any process starts."""
    from sim.scenarios.source import streams_of
    from sim.world.config import FolderWorld, UtiasWorld

    if isinstance(scenario.world, UtiasWorld | FolderWorld):
        streams_of(scenario)


def _check_writable(path: Path) -> None:
    """A result that can not be written is found before the run, not after it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a").close()
    except OSError as error:
        fail(f"--json {path}: {error.strerror}; give another path", WRONG_USE)


def _new_folder(scenario: Scenario) -> Path:
    stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    base = Path("runs") / f"{scenario.name}-{scenario.seed}-{stamp}"
    folder, number = base, 1
    while folder.exists():
        number += 1
        folder = base.with_name(f"{base.name}-{number}")
    return folder


def _keep_earlier(log: Path) -> None:
    """A log is never overwritten: an earlier one of the same name steps aside."""
    if log.exists() and not log.is_file():
        fail(f"--record {log}: not a regular file; give the path of a new log", WRONG_USE)
    if log.exists():
        number = 1
        while (aside := log.with_name(f"{log.name}.{number}")).exists():
            number += 1
        log.rename(aside)
        typer.echo(f"{log} was there already: it is now {aside}", err=True)


def _prepare(scenario: Scenario) -> None:
    from sim.launch.warm_up import warm_up

    text = "preparing the kernels (compiled once per machine) …"
    said = threading.Timer(PREPARING_S, typer.echo, [text], {"err": True})
    said.start()
    began = time.monotonic()
    try:
        warm_up(scenario.estimator, scenario.fusion)
    finally:
        said.cancel()
        said.join()
    took = time.monotonic() - began
    if took > PREPARING_S:
        typer.echo(f"kernels ready after {took:.1f} s", err=True)


def _conclude(
    scenario: Scenario, outcome: "Outcome", json_file: Path | None, *, report: bool
) -> None:
    """Evaluate the log, print the result, write the report; end with 1 if anything failed."""
    from rich.console import Console

    from central.desk.evaluation.evaluation import evaluate, to_json, with_holes
    from central.desk.evaluation.history import history
    from central.desk.export.take_home import taken_home
    from central.desk.report.page import write_report
    from central.desk.report.run import Run, nis_line, run_figures
    from central.desk.report.tables import summary_tables
    from central.desk.verification.recorded import recorded
    from team.recording.reader import LogError, open_log

    console = Console()
    extra: dict[str, Any] = {
        "processes": {e.name: {"pid": e.pid, "exit": e.exit} for e in outcome.processes},
        "failures": outcome.failures,
        "restarts": outcome.restarts,
        "given_up": outcome.given_up,
        "log": str(outcome.log),
        "folder": str(outcome.folder),
        "wall_s": outcome.wall_s,
    }
    try:
        log = open_log(outcome.log)
        evaluation = with_holes(evaluate(log.samples()), log)
    except (LogError, OSError) as error:
        outcome.failures.append(f"the log can not be evaluated: {error}")
        figures = extra
    else:
        figures = to_json(evaluation, extra)
        for table in summary_tables(evaluation):
            console.print(table)
        for note in evaluation.notes:
            console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
        if report:
            home = taken_home(recorded(log))
            run = Run(evaluation, history(log.samples()), log.metadata, taken_home=home)
            if (line := nis_line(run)) is not None:
                console.print(line, highlight=False, soft_wrap=True)
            for path in write_report(run, outcome.folder, {**figures, **run_figures(run)}):
                console.print(f"wrote {path}", highlight=False, soft_wrap=True)
        if evaluation.map is None:
            outcome.failures.append("the run ended without a final map")
    for name, times in sorted(outcome.restarts.items()):
        text = f"{name} was started again {times} time{'' if times == 1 else 's'}"
        console.print(text, highlight=False)
    console.print(f"log   {outcome.log}", highlight=False, soft_wrap=True)
    console.print(f"{outcome.wall_s:.1f} s of wall time", highlight=False)
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2) + "\n")
    if outcome.failures:
        fail("\n".join(outcome.failures), FAILED)
