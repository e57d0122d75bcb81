"""Entry of `teamslam`: run the command, turn errors into exit statuses."""

import os
import sys
from importlib import import_module

# Before NumPy: one BLAS thread per process, for equal bits everywhere and no contention.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402 - the threads of BLAS are set before anything imports NumPy

from teamslam.sim.cli.options import FAILED, WRONG_USE  # noqa: E402
from teamslam.sim.cli.plain import parse_plainly  # noqa: E402

PLAIN = {
    "launch": "launch",
    **dict.fromkeys(("router", "record", "central", "robot", "world"), "nodes"),
}
"""Commands that start a team, with their modules: no other command is imported for them."""


def main() -> None:
    """Run a command; wrong use exits with 2, a failed run with 1, without a traceback."""
    try:
        _run(sys.argv[1:])
    except Exception as error:
        from teamslam.team.wire.text import printable_lines

        advice = _advice(error)
        if advice is None:
            raise
        status, text = advice
        typer.secho(f"error: {printable_lines(text)}", fg="red", err=True)
        sys.exit(status)


def _run(words: list[str]) -> None:
    if words and words[0] in PLAIN:
        commands = import_module(f"teamslam.sim.cli.{PLAIN[words[0]]}")
        function = getattr(commands, words[0])
        arguments = parse_plainly(function, words[1:])
        if arguments is not None:
            try:
                function(**arguments)
            except typer.Exit as left:
                sys.exit(left.exit_code)
            return
    from teamslam.sim.cli.main import app

    typer.main.get_command(app)()


def _advice(error: Exception) -> tuple[int, str] | None:
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
