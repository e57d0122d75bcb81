"""`teamslam viewer`, a node that publishes views, and `teamslam view`, a log or a run on a page."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from sim.cli_nodes import LOOPBACK
from sim.cli_options import Connect, ScenarioArgument, scenario_of

_LOG = logging.getLogger("teamslam")

app = typer.Typer()


@app.command()
def viewer(scenario: ScenarioArgument, connect: Connect = LOOPBACK) -> None:
    """Publish what Foxglove, Lichtblick and Rerun draw, once a second of team time.

    The recorder stores it beside the team's own messages. Ends after the final map.
    """
    from sim.view.viewer import run_viewer
    from team.shell import process
    from team.wire.zenoh_bus import ZenohBus

    resolved = scenario_of(scenario)
    with process("viewer", endless=True) as stop, ZenohBus(resolved.team, connect) as bus:
        _LOG.info("connected to team %s at %s", resolved.team, connect)
        _LOG.info("published %d views", run_viewer(bus, stop))


@app.command()
def view(
    log: Annotated[Path, typer.Argument(help="An MCAP log of a team.")],
    export: Annotated[
        Path | None,
        typer.Option(help="Write the log with its views to this new file, and end."),
    ] = None,
    layout: Annotated[
        Path | None, typer.Option(help="Write a Foxglove layout for this team, and end.")
    ] = None,
) -> None:
    """Look at a log."""
    from sim.view.export import export_views
    from team.recording.reader import open_log

    opened = open_log(log)
    if export is not None:
        typer.echo(f"{export}: {export_views(opened, export)} messages")
