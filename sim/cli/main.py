"""All commands of `teamslam`. Every command imports its modules when it runs."""

import typer

from teamslam.sim.cli.calibrate import app as calibrate_commands
from teamslam.sim.cli.compare import app as compare_commands
from teamslam.sim.cli.drivers import app as driver_commands
from teamslam.sim.cli.help import WIDE, Group
from teamslam.sim.cli.importing import app as import_commands
from teamslam.sim.cli.keys import app as key_commands
from teamslam.sim.cli.launch import app as launch_commands
from teamslam.sim.cli.localise import app as localise_commands
from teamslam.sim.cli.log import app as log_tools
from teamslam.sim.cli.maps import app as map_tools
from teamslam.sim.cli.nodes import app as node_commands
from teamslam.sim.cli.orders import app as order_commands
from teamslam.sim.cli.recorded import app as recorded_commands
from teamslam.sim.cli.rerun import app as rerun_commands
from teamslam.sim.cli.scenarios import app as scenario_commands
from teamslam.sim.cli.status import app as status_commands
from teamslam.sim.cli.studies import add_studies
from teamslam.sim.cli.view import app as view_commands

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
    key_commands, recorded_commands, rerun_commands, compare_commands, view_commands,
    calibrate_commands, import_commands, driver_commands, status_commands,
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
