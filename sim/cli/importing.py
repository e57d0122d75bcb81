"""Commands on a user's data: import, calibrate."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import click
from click.exceptions import Exit

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import (
    WRONG_USE,
    Group,
    argument,
    failing,
    option,
    output_option,
    refuse,
)
from teamslam.sim.cli.results import print_table
from teamslam.team.extras import install_command

app = Group()


@app.declare(
    "teamslam import odom.csv tags.csv --robot r1 --columns columns.toml -o my_set", name="import"
)
def import_(
    source: Annotated[
        list[Path],
        argument(
            "CSV files of one robot, ROS 2 bags (.mcap, .db3, folders), a team's log, or a "
            "UTIAS set."
        ),
    ],
    output: Annotated[Path | None, output_option("Folder for the data set.")] = None,
    robot: Annotated[
        str | None, option("The robot's name, if it is one; it may be added to a data set.")
    ] = None,
    start: Annotated[
        list[str] | None,
        option(
            "Where it started, and how well that is known (m, rad); repeatable.",
            "[ROBOT:]x,y,theta[,sigma,sigma]",
        ),
    ] = None,
    columns: Annotated[Path | None, option("TOML file that maps columns.", "FILE")] = None,
    ros2: Annotated[Path | None, option("TOML file that assigns topics.", "FILE")] = None,
    truth: Annotated[
        Path | None, option("The robot's true path: CSV, or TUM's format.", "FILE")
    ] = None,
) -> None:
    """Convert logs to a data set for launch, calibrate, rerun and batch-reference."""
    import re

    from teamslam.sim.datasets.folder_files import ROBOT_NAME
    from teamslam.sim.datasets.tables import DatasetError
    from teamslam.sim.importing.proposal import ProposalWrittenError
    from teamslam.sim.importing.source import (
        Request,
        add_robot,
        check_sources,
        import_data,
        proposal,
        takes_robot,
    )

    if output is None:
        if text := proposal(source[0]):
            click.echo(text)
            return
        refuse("give the folder for the data set: -o FOLDER")
    if robot is not None and not re.fullmatch(ROBOT_NAME, robot):
        refuse(f"--robot {robot}: a small letter, then small letters, digits and _")
    adds = robot is not None and takes_robot(output, robot)
    if output.exists() and not adds and (not output.is_dir() or any(output.iterdir())):
        refuse(
            f"{output} is not empty: give a new folder, or --robot with a new name to add a robot "
            "to a data set"
        )
    began = time.monotonic()
    request = Request(
        sources=source,
        robot=robot,
        starts=dict(map(opt.parse_start, start or [])),
        columns=columns,
        ros2=ros2,
        truth=truth,
    )
    try:
        report = add_robot(request, output) if adds else import_data(request, output)
        elapsed_s = time.monotonic() - began
        try:
            read = _as_read(output)
        except DatasetError:
            check_sources(report.tables)  # names the user's file in place of the written one
            raise
        notes = dict.fromkeys([*report.notes, *read])  # each once
    except ProposalWrittenError as proposed:
        shutil.rmtree(output / robot if adds and robot else output, ignore_errors=True)
        click.echo(str(proposed))
        raise Exit(WRONG_USE) from None
    except BaseException:  # remove a partial data set, whose folder the next attempt may use
        shutil.rmtree(output / robot if adds and robot else output, ignore_errors=True)
        raise
    for note in notes:
        click.echo(note)
    if report.messages:
        rate = report.messages / elapsed_s
        click.echo(f"{opt.count_noun(report.messages, 'message')}, {rate:,.0f} a second")
    click.echo(f"wrote {output}: `teamslam launch --dataset {output}` runs the team on it")


def import_into(path: Path, folder: Path) -> Path:
    """Import a bag or log; returns the folder."""
    from teamslam.sim.importing.source import Request, import_data

    if folder.exists() and any(folder.iterdir()):
        refuse(f"{folder} is not empty: give another --output")
    for note in import_data(Request(sources=[path]), folder).notes:
        click.echo(note, err=True)
    click.echo(f"imported {path} into {folder}", err=True)
    return folder


@contextmanager
def readable(path: Path) -> Iterator[Path]:
    """Yield a ROS 2 bag as a temporary data set; other paths as they are."""
    from tempfile import TemporaryDirectory

    from teamslam.sim.importing.source import Request, import_data, is_ros2_bag
    from teamslam.team.recording.reader import log_file

    if log_file(path).is_file():  # a run's folder, or a file
        path = log_file(path)
    if not is_ros2_bag(path):
        yield path
        return
    with TemporaryDirectory() as place:
        folder = Path(place) / path.stem
        for note in import_data(Request(sources=[path]), folder).notes:
            click.echo(note, err=True)
        yield folder


def _as_read(folder: Path) -> list[str]:
    from teamslam.central.desk.evaluation.clocks import separate_times_warning
    from teamslam.sim.datasets.tables import DatasetError
    from teamslam.sim.scenarios.source import open_data_set

    streams, _, _ = open_data_set(folder)
    if not any(len(stream.intervals.end_ns) for stream in streams.streams):
        raise DatasetError(
            "no robot has odometry, so there is nothing to run: `--columns FILE` names the files "
            "and columns of its [odometry] (docs/your_data.md)"
        )
    lines = list(streams.notes)
    if (warning := separate_times_warning(streams.spans_ns)) is not None:
        lines.append(warning)
    for stream in streams.streams:
        seen, teammates = len(stream.landmark_detections.ids), len(stream.teammate_detections.ids)
        driven = opt.count_noun(len(stream.intervals.end_ns), "odometry interval")
        pose = "known" if stream.start is not None else "not known"
        lines.append(
            f"{stream.robot}: {driven}, {opt.count_noun(seen, 'measurement')}, "
            f"{opt.count_noun(teammates, 'sighting')}, initial pose {pose}"
        )
        lines += [f"{stream.robot}: {note}" for note in stream.notes]
    return lines


@app.declare("teamslam calibrate my_set -o my_set/scenario.toml")
def calibrate(
    source: Annotated[
        list[Path],
        argument(
            "Data sets (folders, UTIAS zips), logs (.mcap), ROS 2 bags; learnt from together."
        ),
    ],
    output: Annotated[
        Path | None, output_option("Write a scenario with the learnt figures.")
    ] = None,
    truth: Annotated[bool, option("Use the ground truth where it is there.")] = True,
    scenario: Annotated[
        str | None, option("The scenario to begin with; default: the source's own.")
    ] = None,
    json_file: opt.JsonFile = None,
) -> None:
    """Calibrate odometry and sensor models from measurements, each figure with its uncertainty.

    With ground truth also clock_offset_s, the delay of detections against
    odometry.
    """
    from dataclasses import asdict, replace

    if find_spec("scipy") is None:
        refuse(f"calibrate needs SciPy: {install_command('calibrate')}")
    from rich.table import Table

    from teamslam.sim.calibration.calibrate import calibrate_models
    from teamslam.sim.calibration.figures import CalibrationError
    from teamslam.sim.calibration.scenario import scenario_text
    from teamslam.sim.recorded.streams import measurements_in
    from teamslam.sim.scenarios.scenario import Scenario, builtin_names
    from teamslam.sim.scenarios.source import open_data_set, scenario_beside
    from teamslam.sim.world.streams import WorldStreams

    if output is not None and output.suffix != ".toml":
        refuse(f"--output {output}: a scenario's name ends in .toml")
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)  # fails before minutes of computation
    read: list[tuple[str, WorldStreams, Scenario]] = []
    own = scenario
    for path in source:
        click.echo(f"reading {path}", err=True)
        with readable(path) as found_at:
            if found_at.suffix == ".mcap":
                opt.open_log(found_at)
                read.append((path.name, *measurements_in(found_at)))
                continue
            if not read and scenario is None:
                own = scenario_beside(found_at)
            read.append((path.name, *open_data_set(found_at)[:2]))
    own = None if own in builtin_names() else own
    start = read[0][2] if scenario is None else opt.scenario_of(scenario)
    worlds = [(name, world if truth else replace(world, landmarks=None)) for name, world, _ in read]
    with failing(CalibrationError):
        found = calibrate_models(worlds, start, lambda text: click.echo(text, err=True))
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
    print_table(table)
    for note in found.notes:
        click.echo(note)
    opt.write_json(json_file, asdict(found))
    if output is not None:
        names = [name for name, _, _ in read]
        text = scenario_text(found, start, own, names, output)
        if output.exists():
            opt.set_aside(output)
        output.write_text(text, "utf-8")
        click.echo(f"wrote {output}: `teamslam launch {output} --dataset …` uses it")
