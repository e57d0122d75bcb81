"""Commands of `sim/studies`, which an installation may lack; looked up by name."""

from importlib import import_module

import typer

from teamslam.sim.cli.options import WRONG_USE, fail

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
