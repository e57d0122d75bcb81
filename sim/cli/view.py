"""Commands `teamslam viewer`, a node that publishes views, and `teamslam view`, a page."""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import Group, fail, option, rare, refuse
from teamslam.sim.cli.results import Steps
from teamslam.team.extras import install_command

if TYPE_CHECKING:
    from teamslam.central.desk.view.server import Shown
    from teamslam.team.recording.reader import Log

_LOG = logging.getLogger("teamslam")
FOXGLOVE_PORT = 8765
Port = Annotated[int, rare("Where the page is served; 0: any free port.", "PORT", least=0)]
FoxglovePort = Annotated[
    int | None,
    rare(
        "Where Foxglove can connect; 0: any free port; default: 8765, or a free one if that "
        "is taken, if foxglove-sdk is installed.",
        "PORT",
        least=0,
    ),
]
Open = Annotated[
    bool | None, option("Open the page; default: where there is a display.", "--open/--no-browser")
]
app = Group()


@app.declare("teamslam viewer waypoints")
def viewer(
    scenario: opt.ScenarioArgument, connect: opt.Connect = opt.LOOPBACK, keys: opt.Keys = None
) -> None:
    """Publish views for Foxglove, Lichtblick and Rerun, once a second of team time.

    The recorder stores them beside the team's messages. Ends after the final map.
    """
    from teamslam.central.desk.view.export import run_viewer
    from teamslam.team.shell import process

    resolved = opt.scenario_of(scenario)
    with (
        process("viewer", endless=True) as stop,
        opt.connect_bus(resolved.team, connect, keys, "viewer", stop) as bus,
    ):
        _LOG.info("connected to team %s at %s", resolved.team, connect)
        peers = [each.id for each in resolved.robots] if resolved.peers else []
        _LOG.info("published %d views", run_viewer(bus, stop, peers))


@app.declare("teamslam view runs/first")
def view(
    log: opt.LogArgument,
    port: Port = 0,
    foxglove_port: FoxglovePort = None,
    host: Annotated[
        str, rare("The address to serve at; others than 127.0.0.1 show it to others.", "ADDRESS")
    ] = "127.0.0.1",
    browser: Open = None,
    follow: Annotated[
        bool, option("The log is being recorded, or will be: show it as it grows.")
    ] = False,
    export: Annotated[
        Path | None,
        option("Write the log with what other tools draw to this new file, and end.", "FILE"),
    ] = None,
    export_video: Annotated[
        Path | None, option("Write the run as an animated GIF, and end.", "--export-video", "FILE")
    ] = None,
    layout: Annotated[
        Path | None, option("Write a Foxglove layout for this team's log, and end.", "FILE")
    ] = None,
) -> None:
    """Show a log, or a running team by its log, on a page in a browser.

    Map with uncertainty, robots, paths, errors with bounds, consistency, traffic
    and events, without remote content. With foxglove-sdk installed, Foxglove and
    Lichtblick can connect, too; the log opens there in any case.
    Ends with Ctrl-C.
    """
    from teamslam.team.recording.reader import log_file, open_log
    from teamslam.team.shell import process

    log = log_file(log)
    if export_video is not None:
        _write_video(log, export_video)
        return
    if not follow or log.exists():
        opened = open_log(log) if follow else opt.open_log(log)
        if export is not None or layout is not None:
            _write(opened, export, layout)
            return
    elif export is not None or layout is not None:
        refuse(f"{log}: not found; --export and --layout need a log")
    with (
        process("view", endless=True) as stop,
        show_on_page(log, host, port, foxglove_port, browser, growing=follow) as shown,
    ):
        stop.wait()
        if shown.feed.error is not None:
            refuse(shown.feed.error)


@contextmanager
def show_on_page(
    log: Path,
    host: str,
    port: int,
    foxglove_port: int | None,
    browser: bool | None,
    *,
    growing: bool,
) -> Iterator["Shown"]:
    """Serve a log, and open the page on request or on a display."""
    from teamslam.central.desk.view.server import free_port, session

    has_sdk = find_spec("foxglove") is not None
    if foxglove_port is not None and not has_sdk:
        refuse(f"--foxglove-port needs Foxglove's SDK: {install_command('foxglove')}")
    note = ""
    if foxglove_port is None and has_sdk:
        foxglove_port = free_port(host, FOXGLOVE_PORT)
        if not foxglove_port:
            note = f"   ({FOXGLOVE_PORT} is taken; --foxglove-port chooses another)"
    with session(log, host, port, foxglove_port, growing=growing) as shown:
        click.echo(f"page      {shown.url}")
        if shown.foxglove:
            click.echo(f"foxglove  {shown.foxglove}{note}")
        if _has_display() if browser is None else browser:
            import webbrowser

            webbrowser.open(shown.url)
        yield shown


def _has_display() -> bool:
    """Whether a browser is visible; text browsers would occupy the terminal."""
    windows = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    return bool(windows) and sys.stdout.isatty()


def _write_video(log: Path, path: Path) -> None:
    from teamslam.central.desk.evaluation.evaluation import evaluate
    from teamslam.central.desk.pictures.film import draw_film, maps_over_time
    from teamslam.team.wire.channels import FINAL_MAP, FUSED_MAP
    from teamslam.team.wire.codec import decoded
    from teamslam.team.wire.messages import FusedMap

    if path.suffix != ".gif" or not path.parent.is_dir():
        refuse(f"--export-video {path}: give a .gif in an existing folder")
    steps = Steps()
    opened = replace(opt.open_log(log), reading=steps.share)
    steps.begin("reading the run")
    maps = (decoded(s.payload, FusedMap) for s in opened.samples((FUSED_MAP, FINAL_MAP)))
    evaluation, drawn = evaluate(opened.samples()), maps_over_time(maps)
    steps.begin("drawing the film")
    if not draw_film(evaluation, drawn, path, steps.share):
        fail(f"{log} has no final map or no poses to draw")
    click.echo(f"wrote {path}: {path.stat().st_size / 1e6:.1f} MB")


def _write(log: "Log", export: Path | None, layout: Path | None) -> None:
    from teamslam.central.desk.view.export import export_views
    from teamslam.central.desk.view.layout import layout as layout_of
    from teamslam.team.wire.channels import ROBOT_CONFIG

    for path in (export, layout):
        if path is not None:
            opt.refuse_existing(path)
    if export is not None:
        click.echo(f"{export}: {export_views(log, export)}")
    if layout is not None:
        owners = {ROBOT_CONFIG.owner(sample.key) for sample in log.samples((ROBOT_CONFIG,))}
        layout.write_text(layout_of(log.team, [name for name in owners if name]), "utf-8")
        click.echo(f"wrote {layout}: import it in Foxglove or Lichtblick")
