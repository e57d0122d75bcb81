"""`teamslam`: the command line. Every command imports its modules when it runs."""

import os
import sys
from functools import cache
from typing import Any

# Before NumPy: one BLAS thread per process, for equal bits everywhere and no contention.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402 - the threads of BLAS are set before anything imports NumPy

from teamslam.sim.cli.calibrate import app as calibrate_commands  # noqa: E402
from teamslam.sim.cli.compare import app as compare_commands  # noqa: E402
from teamslam.sim.cli.drivers import app as driver_commands  # noqa: E402
from teamslam.sim.cli.help import WIDE, Group  # noqa: E402
from teamslam.sim.cli.importing import app as import_commands  # noqa: E402
from teamslam.sim.cli.keys import app as key_commands  # noqa: E402
from teamslam.sim.cli.launch import app as launch_commands  # noqa: E402
from teamslam.sim.cli.log import app as log_tools  # noqa: E402
from teamslam.sim.cli.nodes import app as node_commands  # noqa: E402
from teamslam.sim.cli.options import FAILED, WRONG_USE  # noqa: E402
from teamslam.sim.cli.orders import app as order_commands  # noqa: E402
from teamslam.sim.cli.recorded import app as recorded_commands  # noqa: E402
from teamslam.sim.cli.rerun import app as rerun_commands  # noqa: E402
from teamslam.sim.cli.scenarios import app as scenario_commands  # noqa: E402
from teamslam.sim.cli.status import app as status_commands  # noqa: E402
from teamslam.sim.cli.studies import add_studies  # noqa: E402
from teamslam.sim.cli.view import app as view_commands  # noqa: E402

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
    launch_commands, scenario_commands, node_commands, order_commands, key_commands,
    recorded_commands, rerun_commands, compare_commands, view_commands, calibrate_commands,
    import_commands, driver_commands, status_commands,
):  # fmt: skip
    app.add_typer(_part)
app.add_typer(log_tools)
add_studies(app)


@app.callback(invoke_without_command=True)
def _version(version: bool = typer.Option(False, "--version", help="Print the version.")) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"teamslam {installed('teamslam')}")
        raise typer.Exit


@cache
def command() -> Any:
    """All commands, built from their functions."""
    return typer.main.get_command(app)


def main() -> None:
    """Run a command; wrong use exits with 2, a failed run with 1, without a traceback."""
    try:
        command()()
    except Exception as error:
        from teamslam.team.wire.text import lines

        advice = _advice(error)
        if advice is None:
            raise
        status, text = advice
        typer.secho(f"error: {lines(text)}", fg="red", err=True)
        sys.exit(status)


def _advice(error: Exception) -> tuple[int, str] | None:
    """Exit status and text for an expected error, or None.

    Exception modules are imported only if raised there: a router needs no SciPy.
    """
    from teamslam.sim.datasets.tables import DatasetError
    from teamslam.sim.scenarios.checks import ScenarioError
    from teamslam.team.keys.roster import KeysError
    from teamslam.team.recording.reader import LogError
    from teamslam.team.recording.recorder import RecorderError
    from teamslam.team.shell import FaultyRunError
    from teamslam.team.wire.bus import BusError

    if isinstance(error, ScenarioError | DatasetError | LogError | BusError | KeysError):
        return WRONG_USE, str(error)
    if isinstance(error, FileExistsError | NotADirectoryError | IsADirectoryError):
        return WRONG_USE, f"{error.filename}: {error.strerror}; give another path"
    if isinstance(error, RecorderError | FaultyRunError):
        return FAILED, str(error)
    if isinstance(error, OSError):
        return FAILED, f"{error.filename}: {error.strerror}" if error.filename else str(error)
    return None
