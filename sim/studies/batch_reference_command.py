"""The command `teamslam batch-reference`."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from teamslam.sim.cli.help import Command
from teamslam.sim.cli.options import FAILED, fail, warn_of_holes

Noise = Annotated[
    Literal["white", "profile"],
    typer.Option(
        help="white: independent errors, no inter-robot measurements; profile: the scenario's "
        "persistent errors, biases, and inter-robot measurements."
    ),
]
Source = Annotated[Path, typer.Argument(help="An MCAP log of a team, a data set or a ROS 2 bag.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the figures.")]
app = typer.Typer()


@app.command(name="batch-reference", cls=Command, epilog="teamslam batch-reference runs/first")
def batch_reference(
    log: Source,
    noise: Noise = "white",
    json_file: JsonFile = None,
    g2o: Annotated[
        Path | None,
        typer.Option(
            help="Write the problem to this file for other optimisers, without solving it."
        ),
    ] = None,
) -> None:
    """The batch MAP over all raw measurements of a log: the accuracy that a team can reach."""
    from teamslam.sim.cli.importing import readable
    from teamslam.sim.recorded.data_set import log_or_run
    from teamslam.sim.studies.batch_reference.g2o import g2o_lines
    from teamslam.sim.studies.batch_reference.measurements import BatchReferenceError
    from teamslam.sim.studies.batch_reference.reference import batch_map
    from teamslam.team.recording.reader import Log

    with readable(log) as source:
        run = log_or_run(source)
    if isinstance(run, Log):
        warn_of_holes(run)
    if g2o is not None:
        try:
            lines = list(g2o_lines(run.samples()))
        except BatchReferenceError as error:
            fail(str(error), FAILED)
        g2o.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
        typer.echo(f"wrote {g2o}: {len(lines)} lines")
        return
    try:
        result = batch_map(run.samples(), noise)
    except BatchReferenceError as error:
        fail(str(error), FAILED)
    figures = result.to_json()
    typer.echo(json.dumps(figures, indent=2))
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2) + "\n")


@app.command(name="limit", hidden=True)
def limit(log: Source, noise: Noise = "white", json_file: JsonFile = None) -> None:
    """The former name of `batch-reference`."""
    typer.echo("`teamslam limit` is called `teamslam batch-reference` now", err=True)
    batch_reference(log, noise, json_file)
