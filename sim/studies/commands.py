"""Commands that the studies add to `teamslam`."""

import typer

from teamslam.sim.studies.batch_reference_command import app as batch_reference_commands
from teamslam.sim.studies.experiment_command import app as experiment_commands


def register(app: typer.Typer) -> None:
    """Add `experiment` and `batch-reference`."""
    app.add_typer(experiment_commands)
    app.add_typer(batch_reference_commands)
