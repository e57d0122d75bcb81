"""All commands of `teamslam`, and its entry: errors become exit statuses without a traceback."""

import os
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module

# Before NumPy: one BLAS thread per process, for equal bits everywhere and no contention.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import click  # noqa: E402 - the threads of BLAS are set before anything imports NumPy

from teamslam.sim.cli import commands  # noqa: E402
from teamslam.sim.cli.commands import FAILED, INTERRUPTED, WRONG_USE, Group  # noqa: E402

STUDIES = "teamslam.sim.studies"
SECTIONS: Mapping[str, Mapping[str, str]] = {
    "Run a team": {
        "launch": "launch",
        "localise": "launch",
        "scenarios": "scenarios",
        "simulate": "scenarios",
    },
    "Look at a run": {
        "view": "view",
        "report": "recorded",
        "compare": "recorded",
        "rerun": "rerun",
        "map": "maps",
        "log": "log",
        "verify-ledger": "rerun",
        "repair": "recorded",
    },
    "Use your data": {
        "import": "importing",
        "calibrate": "importing",
        "batch-reference": f"{STUDIES}.commands",
        "experiment": f"{STUDIES}.experiment_command",
    },
    "Run one process": {
        "router": "nodes",
        "record": "nodes",
        "central": "nodes",
        "robot": "nodes",
        "driver": "drivers",
        "world": "nodes",
        "viewer": "view",
        "replay": "recorded",
    },
    "Operate a running team": dict.fromkeys(
        ("status", "end", "withdraw", "verdict", "keys"), "orders"
    ),
}
"""Commands by task, the most frequent first, and their modules."""
MODULES = {name: module for names in SECTIONS.values() for name, module in names.items()}


class _Team(Group):
    @property
    def by_section(self) -> Mapping[str, Iterable[str]]:
        return SECTIONS

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(MODULES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; all for an unknown name, so that the closest is found."""
        for name in [cmd_name] if cmd_name in MODULES else MODULES:
            if name not in self.commands:
                self.add_command(_imported(name), name)
        return self.commands.get(cmd_name)


def _imported(name: str) -> click.Command:
    module = MODULES[name]
    is_study = module.startswith(STUDIES)
    try:
        group: Group = import_module(module if is_study else f"teamslam.sim.cli.{module}").app
    except ModuleNotFoundError as error:
        if not is_study or error.name not in (STUDIES, module):
            raise
        return _missing(name)
    return group if group.name == name else group.commands[name]


def _missing(name: str) -> click.Command:
    def missing() -> None:
        commands.refuse(
            f"`teamslam {name}` is a study, and this installation is without the folder "
            "sim/studies: install teamslam with it"
        )

    context = {"allow_extra_args": True, "ignore_unknown_options": True}
    return click.Command(name, context, missing, hidden=True, add_help_option=False)


app = _Team(
    "teamslam",
    help="Multi-robot SLAM as real processes over Zenoh.",
    epilog="teamslam launch waypoints --view\nteamslam COMMAND --help",
    context_settings={"max_content_width": 100},
)
click.version_option(
    package_name="teamslam", message="teamslam %(version)s", help="Print the version."
)(app)


def load_all() -> Group:
    """All commands, imported."""
    app.get_command(click.Context(app), "")
    return app


def main() -> None:
    """Run a command; wrong use exits with 2, a failed run with 1, Ctrl-C with 130."""
    try:
        sys.exit(app.main(prog_name="teamslam", standalone_mode=False))
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.Abort:
        sys.exit(INTERRUPTED)
    except Exception as error:
        advice = _advice(error)
        if advice is None:
            raise
        status, text = advice
        commands.print_error(text)
        sys.exit(status)


def _advice(error: Exception) -> tuple[int, str] | None:
    from teamslam.sim.datasets.tables import DatasetError
    from teamslam.sim.scenarios.document import ScenarioError
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
