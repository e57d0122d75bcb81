"""Commands that the studies add to `teamslam`."""

import json
from pathlib import Path
from typing import Annotated, Literal

import click

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import Group, argument, failing, option

Noise = Annotated[
    Literal["white", "profile"],
    option(
        "white: independent errors, no inter-robot measurements; profile: the scenario's "
        "persistent errors, biases, and inter-robot measurements."
    ),
]
Source = Annotated[Path, argument("An MCAP log of a team, a data set or a ROS 2 bag.")]
JsonFile = Annotated[Path | None, option("Write the figures.", "--json")]
app = Group()


@app.declare("teamslam batch-reference runs/first", name="batch-reference")
def batch_reference(log: Source, noise: Noise = "white", json_file: JsonFile = None) -> None:
    """The batch MAP over all raw measurements of a log: the accuracy that a team can reach."""
    from teamslam.sim.cli.importing import readable
    from teamslam.sim.recorded.chains import BatchReferenceError
    from teamslam.sim.recorded.world import log_or_run
    from teamslam.sim.studies.batch_reference.reference import batch_map
    from teamslam.team.recording.reader import Log

    with readable(log) as source:
        run = log_or_run(source)
    if isinstance(run, Log):
        opt.warn_of_holes(run)
    with failing(BatchReferenceError):
        result = batch_map(run.samples(), noise)
    figures = result.to_json()
    click.echo(json.dumps(figures, indent=2))
    opt.write_json(json_file, figures)
