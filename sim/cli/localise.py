"""Command `teamslam localise`: `launch --localise` of a world, `rerun --localise` of a log."""

from pathlib import Path
from typing import Annotated

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import Group, argument, option, output_option
from teamslam.sim.cli.launch import launch
from teamslam.sim.cli.rerun import rerun

app = Group()


@app.declare(
    "teamslam localise --map site.map --dataset my_set\nteamslam localise --map site.map runs/day2"
)
def localise(
    map_: Annotated[Path, option("The saved map, which stays as it is.", "--map", "FILE")],
    source: Annotated[
        str | None,
        argument(
            "A scenario, or a log or the folder of a run; default: as of launch.", "[SCENARIO|LOG]"
        ),
    ] = None,
    dataset: opt.Dataset = None,
    robots: opt.Robots = None,
    seed: opt.Seed = None,
    speed: opt.SpeedText = "max",
    output: Annotated[Path | None, output_option("The run's folder.", "DIR")] = None,
    json_file: opt.JsonFile = None,
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
