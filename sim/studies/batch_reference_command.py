"""The command `teamslam batch-reference`."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from sim.cli.options import FAILED, fail

Noise = Annotated[
    Literal["white", "profile"],
    typer.Option(
        help="white: each measurement's error is its own, no inter-robot measurements; profile: "
        "the scenario's errors that persist, biases, and inter-robot measurements."
    ),
]
Source = Annotated[Path, typer.Argument(help="An MCAP log of a team, or a data set.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the figures.")]
app = typer.Typer()


@app.command(name="batch-reference")
def batch_reference(log: Source, noise: Noise = "white", json_file: JsonFile = None) -> None:
    """The batch MAP over all raw measurements of a log: the accuracy that a team can reach."""
    from sim.recorded.data_set import log_or_run
    from sim.studies.batch_reference.reference import LimitError, batch_map

    try:
        result = batch_map(log_or_run(log).samples(), noise)
    except LimitError as error:
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
