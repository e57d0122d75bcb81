"""Common steps of result commands: read, print, name files."""

import shlex
import sys
import time
from collections.abc import Iterable
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.table import Table

    from teamslam.central.desk.evaluation.history import History
    from teamslam.central.desk.evaluation.results import Evaluation
    from teamslam.central.desk.report.run import Reading, Run
    from teamslam.team.recording.reader import Log
    from teamslam.team.wire.bus import Sample

PATIENCE_S = 3.0  # time [s] between lines and before the first, so short work prints none


class Steps:
    """Print the current step and its progress, at most once in PATIENCE_S."""

    def __init__(self) -> None:
        self._what = ""
        self._due = time.monotonic() + PATIENCE_S

    def begin(self, what: str) -> None:
        """Begin the next step."""
        self._what = what
        self.print_if_due("")

    def share(self, done: float) -> None:
        """Report the done share, 0 to 1."""
        self.print_if_due(f": {done:.0%}")

    def robot(self, name: str) -> None:
        """Report the step's robot."""
        self.print_if_due(f": {name}")

    def print_if_due(self, words: str) -> None:
        """Print the step if a line is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + PATIENCE_S
            click.echo(f"{self._what}{words}", err=True)


def read_run(log: "Log", reading: "Reading", steps: Steps, *, proves_ledger: bool) -> "Run":
    """Contents of a report; proves_ledger: also prove the ledger."""
    from teamslam.central.desk.export.take_home import take_home
    from teamslam.central.desk.ledger import ledger
    from teamslam.central.desk.report.run import Run
    from teamslam.central.desk.verification.recorded import RerunError

    found, why = None, Run.no_ledger
    if proves_ledger:
        steps.begin("proving the ledger (--no-ledger leaves it out)")
        try:
            found, why = ledger(reading.recorded, steps.robot), ""
        except RerunError as error:
            why = str(error)
    steps.begin("smoothing the paths")
    home = take_home(reading.recorded, steps.robot)
    command = shlex.join(("teamslam", *sys.argv[1:]))
    return Run(reading.evaluation, reading.history, log.metadata, found, why, home, command)


def print_table(table: "Table") -> None:
    """Print a table as wide as the terminal."""
    from rich.console import Console

    Console().print(table)


def print_evaluation(evaluation: "Evaluation") -> None:
    """Print tables and notes."""
    from teamslam.central.desk.report.tables import summary_tables

    for table in summary_tables(evaluation):
        print_table(table)
    print_notes(evaluation.refused_maps, evaluation.notes)


def print_notes(warnings: Iterable[str], notes: Iterable[str]) -> None:
    """Print warnings, then notes."""
    for warning in warnings:
        click.echo(f"warning: {warning}")
    for note in notes:
        click.echo(f"note: {note}")


def print_nis(history: "History") -> None:
    """Print the NIS per degree of freedom of every robot that has one."""
    per_dof = {name: of.per_dof for name, of in history.innovations.items()}
    if parts := [f"{name} {value:.2f}" for name, value in per_dof.items() if value is not None]:
        click.echo(f"NIS per dof: {', '.join(parts)}")


def print_changes(evaluation: "Evaluation") -> None:
    """Print the landmarks that have changed since the saved maps, if any was loaded."""
    from teamslam.central.desk.report.tables import describe_changes

    if evaluation.map is not None and evaluation.map.changes:
        click.echo(f"changes: {describe_changes(evaluation.map.changes)}")


def print_placements(samples: "Iterable[Sample]", start_ns: int) -> None:
    """Print when and where each robot was placed first in the saved map."""
    from teamslam.central.desk.names import in_order
    from teamslam.team.config import MAP
    from teamslam.team.wire import channels as ch, messages as m
    from teamslam.team.wire.arrays import floats
    from teamslam.team.wire.bus import open_valid

    first: dict[str, m.PoseEstimate] = {}
    poses = (sample for sample in samples if ch.row_of(sample.key) is ch.TEAM_POSE)
    for _, _, pose in open_valid(poses):
        if isinstance(pose, m.PoseEstimate) and pose.frame.startswith(MAP):
            first.setdefault(pose.robot, pose)
    for robot in in_order(first):
        pose = first[robot]
        x, y, heading = floats(pose.pose, "pose").tolist()
        click.echo(
            f"{robot}: placed first after {(pose.stamp_ns - start_ns) * 1e-9:.1f} s at "
            f"x {x:.2f} m, y {y:.2f} m, heading {degrees(heading):.0f}°"
        )


def print_written(paths: Iterable[Path]) -> None:
    """Print the first written path, and the names of the others."""
    first, *others = paths
    click.echo(f"wrote {first}")
    if others:
        names = ", ".join(f"{each.name}/" if each.is_dir() else each.name for each in others)
        click.echo(f"      beside it: {names}")
