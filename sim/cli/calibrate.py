"""Command `teamslam calibrate`."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from teamslam.sim.cli.help import Command, output_option
from teamslam.sim.cli.options import (
    FAILED,
    WRONG_USE,
    JsonFile,
    fail,
    failing,
    set_aside,
    write_json,
)
from teamslam.team.extras import install_command

app = typer.Typer()


@app.command(cls=Command, epilog="teamslam calibrate my_set -o my_set/scenario.toml")
def calibrate(
    source: Annotated[
        list[Path],
        typer.Argument(
            help="Data sets (folders, UTIAS zips), logs (.mcap), ROS 2 bags; learnt from together."
        ),
    ],
    output: Annotated[
        Path | None, output_option("Write a scenario with the learnt figures.")
    ] = None,
    truth: Annotated[bool, typer.Option(help="Use the ground truth where it is there.")] = True,
    scenario: Annotated[
        str | None, typer.Option(help="The scenario to begin with; default: the source's own.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Calibrate odometry and sensor models from measurements, each figure with its uncertainty.

    With ground truth also clock_offset_s, the delay of detections against
    odometry.
    """
    from dataclasses import asdict, replace

    if find_spec("scipy") is None:
        fail(f"calibrate needs SciPy: {install_command('calibrate')}", WRONG_USE)
    from rich.console import Console
    from rich.table import Table

    from teamslam.sim.calibration.calibrate import calibrate_models
    from teamslam.sim.calibration.figures import CalibrationError
    from teamslam.sim.calibration.scenario import scenario_text
    from teamslam.sim.cli.importing import readable
    from teamslam.sim.cli.options import scenario_of, warn_of_holes
    from teamslam.sim.recorded.streams import measurements_in
    from teamslam.sim.scenarios.scenario import Scenario, builtin_names
    from teamslam.sim.scenarios.source import open_data_set, scenario_beside
    from teamslam.sim.world.streams import WorldStreams
    from teamslam.team.recording.reader import open_log

    if output is not None and output.suffix != ".toml":
        fail(f"--output {output}: a scenario's name ends in .toml", WRONG_USE)
    read: list[tuple[str, WorldStreams, Scenario]] = []
    own = scenario
    for path in source:
        typer.echo(f"reading {path}", err=True)
        with readable(path) as found_at:
            if found_at.suffix == ".mcap":
                warn_of_holes(open_log(found_at))
                read.append((path.name, *measurements_in(found_at)))
                continue
            if not read and scenario is None:
                own = scenario_beside(found_at)
            read.append((path.name, *open_data_set(found_at)[:2]))
    own = None if own in builtin_names() else own
    start = read[0][2] if scenario is None else scenario_of(scenario)
    worlds = [(name, world if truth else replace(world, landmarks=None)) for name, world, _ in read]
    with failing(FAILED, CalibrationError):
        found = calibrate_models(worlds, start, lambda text: typer.echo(text, err=True))
    table = Table("part", "figure", "value", "± (1 σ)", "unit")
    parts = (
        ("motion", found.motion),
        ("sensor", found.sensor),
        *((robot, figures) for robot, figures in found.robots.items()),
        *((robot, (figure,)) for robot, figure in found.clocks.items()),
        ("detections", found.detections),
        ("central", found.central),
    )
    for part, figures in parts:
        for figure in figures:
            numbers = (f"{figure.value:.5g}", f"{figure.sigma:.2g}")
            table.add_row(part, figure.name, *numbers, figure.unit)
    Console().print(table)
    for note in found.notes:
        typer.echo(note)
    write_json(json_file, asdict(found))
    if output is not None:
        names = [name for name, _, _ in read]
        text = scenario_text(found, start, own, names, output)
        if output.exists():
            set_aside(output)
        output.write_text(text, "utf-8")
        typer.echo(f"wrote {output}: `teamslam launch {output} --dataset …` uses it")
