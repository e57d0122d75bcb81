"""All commands of `teamslam`. Every command imports its modules when it runs."""

from importlib import import_module

import typer

from teamslam.sim.cli.drivers import app as driver_commands
from teamslam.sim.cli.help import WIDE, Group
from teamslam.sim.cli.importing import app as import_commands
from teamslam.sim.cli.launch import app as launch_commands
from teamslam.sim.cli.localise import app as localise_commands
from teamslam.sim.cli.log import app as log_tools
from teamslam.sim.cli.maps import app as map_tools
from teamslam.sim.cli.nodes import app as node_commands
from teamslam.sim.cli.options import WRONG_USE, fail
from teamslam.sim.cli.orders import app as order_commands
from teamslam.sim.cli.recorded import app as recorded_commands
from teamslam.sim.cli.rerun import app as rerun_commands
from teamslam.sim.cli.scenarios import app as scenario_commands
from teamslam.sim.cli.view import app as view_commands

STUDIES = "teamslam.sim.studies"
COMMANDS = ("experiment", "batch-reference")


def add_studies(app: typer.Typer) -> None:
    """Register the studies' commands; if missing, each reports it and exits with 2."""
    try:
        studies = import_module(f"{STUDIES}.commands")
    except ModuleNotFoundError as error:
        if error.name not in (STUDIES, f"{STUDIES}.commands"):
            raise
        for name in COMMANDS:
            _add_missing(app, name)
    else:
        studies.register(app)


def _add_missing(app: typer.Typer, name: str) -> None:
    context = {"allow_extra_args": True, "ignore_unknown_options": True}

    @app.command(name=name, hidden=True, context_settings=context, add_help_option=False)
    def missing() -> None:
        fail(
            f"`teamslam {name}` is a study, and this installation is without the folder "
            "sim/studies: install teamslam with it",
            WRONG_USE,
        )


app = typer.Typer(
    cls=Group,
    help="Multi-robot SLAM as real processes over Zenoh.",
    epilog="teamslam launch waypoints --view\nteamslam COMMAND --help",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings=WIDE,
)
for _part in (
    launch_commands, localise_commands, scenario_commands, node_commands, order_commands,
    recorded_commands, rerun_commands, view_commands, import_commands, driver_commands,
):  # fmt: skip
    app.add_typer(_part)
app.add_typer(log_tools)
app.add_typer(map_tools)
add_studies(app)


@app.callback(invoke_without_command=True)
def _version(version: bool = typer.Option(False, "--version", help="Print the version.")) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"teamslam {installed('teamslam')}")
        raise typer.Exit
