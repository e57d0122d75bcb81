"""Command `teamslam localise`: `launch --localise` of a world, `rerun --localise` of a log."""

from pathlib import Path
from typing import Annotated

import typer

from teamslam.sim.cli.help import Command, output_option
from teamslam.sim.cli.launch import launch
from teamslam.sim.cli.options import Dataset, JsonFile, Robots, Seed, SpeedText
from teamslam.sim.cli.rerun import rerun

app = typer.Typer()


@app.command(
    cls=Command,
    epilog=(
        "teamslam localise --map site.map --dataset my_set\n"
        "teamslam localise --map site.map runs/day2"
    ),
)
def localise(
    map_: Annotated[
        Path, typer.Option("--map", help="The saved map, which stays as it is.", metavar="FILE")
    ],
    source: Annotated[
        str | None,
        typer.Argument(
            help="A scenario, or a log or the folder of a run; default: as of launch.",
            metavar="[SCENARIO|LOG]",
        ),
    ] = None,
    dataset: Dataset = None,
    robots: Robots = None,
    seed: Seed = None,
    speed: SpeedText = "max",
    output: Annotated[Path | None, output_option("The run's folder.", metavar="DIR")] = None,
    json_file: JsonFile = None,
) -> None:
    """Localise robots in a saved map, without mapping.

    The map is neither changed nor extended: the final map is the saved one, and
    poses and paths are in its frame. Robots need no start. With a log, its
    measurements are localised again.
    """
    path = None if source is None else Path(source)
    if path is not None and (path.suffix == ".mcap" or path.is_dir()):
        rerun(path, map_=[map_], localise=True, seed=seed, output=output, json_file=json_file)
        return
    launch(
        source,
        dataset,
        robots,
        seed,
        speed,
        output=output,
        map_=[map_],
        localise=True,
        json_file=json_file,
    )
