"""Commands that compute a log again: rerun and verify-ledger."""

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sim.cli_options import FAILED, WRONG_USE, fail

if TYPE_CHECKING:
    from sim.rerun import Verification

app = typer.Typer()

OFFENDERS = 20
"""Offenders that are printed; the JSON file has all."""

LogArgument = Annotated[Path, typer.Argument(help="An MCAP log of a team.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the figures as JSON, too.")]


@app.command()
def rerun(
    log: LogArgument,
    verify: Annotated[
        bool, typer.Option("--verify", help="Compute every recomputable message again; compare.")
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Compute a log again: to verify it."""
    if not verify:
        fail("say what to compute again: --verify", WRONG_USE)
    _verify(log, json_file)


def _verify(path: Path, json_file: Path | None) -> None:
    from sim.rerun import verify
    from sim.rerun_log import RerunError
    from team.recording.reader import open_log

    log = open_log(path)
    began = time.monotonic()
    try:
        result = verify(log)
    except RerunError as error:
        fail(f"{path}: {error}", FAILED)
    elapsed_s = time.monotonic() - began
    _print_verification(result, elapsed_s)
    if json_file is not None:
        figures = asdict(result) | {"elapsed_s": elapsed_s, "equal": result.first is None}
        json_file.write_text(json.dumps(figures, indent=2) + "\n")
    if not log.complete:
        typer.echo(f"{path} is cut: its last messages may lack their inputs", err=True)
    if result.first is not None:
        fail(f"the first difference: {result.first}", FAILED)


def _print_verification(result: "Verification", elapsed_s: float) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for heading in ("channel", "messages", "equal", "within tolerance", "different"):
        table.add_column(heading, justify="left" if heading == "channel" else "right")
    for row in result.channels:
        cells = (row.messages, row.equal, row.close, row.different)
        table.add_row(row.channel, *(f"{n:,}" for n in cells))
    console = Console()
    console.print(table)
    for row in result.channels:
        if row.first is not None:
            console.print(f"{row.channel}: {row.first}", highlight=False, markup=False)
    if result.other_platform:
        from sim.rerun_compare import RELATIVE

        differing = ", ".join(result.other_platform)
        note = f"another platform ({differing}): numbers compared within {RELATIVE:g}, not bits"
        console.print(note, highlight=False, markup=False)
    if result.unsound:
        console.print(f"{result.unsound} samples are no sound messages: left out", highlight=False)
    different = sum(row.different for row in result.channels)
    verdict = "all equal" if not different else f"{different} different"
    if not different and any(row.close for row in result.channels):
        verdict = "all equal within the tolerance"
    console.print(
        f"{result.messages:,} messages from {result.readings:,} readings: {verdict}; "
        f"{elapsed_s:.1f} s for {result.span_s:.0f} s of team time, "
        f"{result.span_s / elapsed_s:.0f} × real time",
        highlight=False,
    )


@app.command(name="verify-ledger")
def verify_ledger(log: LogArgument, json_file: JsonFile = None) -> None:
    """Prove that each reading of a log was used once: its disposition, its submap, its maps."""
    from rich.console import Console
    from rich.table import Table

    from sim.ledger import ledger
    from sim.rerun_log import RerunError, recorded
    from team.recording.reader import open_log

    try:
        found = ledger(recorded(open_log(log)))
    except RerunError as error:
        fail(f"{log}: {error}", FAILED)
    robots = sorted({robot for robot, _ in found.entries})
    table = Table("disposition")
    for robot in [*robots, "all"]:
        table.add_column(robot, justify="right")
    of_robots = [found.totals(robot) for robot in robots]
    for disposition, count in found.totals().items():
        counts = [*(totals.get(disposition, 0) for totals in of_robots), count]
        table.add_row(disposition, *(f"{n:,}" for n in counts))
    console = Console()
    console.print(table)
    used = sum(1 for maps in found.maps.values() if maps)
    console.print(f"{len(found.maps)} submaps, {used} of them in a map", highlight=False)
    if json_file is not None:
        json_file.write_text(json.dumps(found.to_json(), indent=2) + "\n")
    for offender in found.offenders[:OFFENDERS]:
        typer.secho(offender, fg="red", err=True)
    if found.offenders:
        fail(f"{len(found.offenders)} offenders against the ledger", FAILED)
    console.print(found.statement(), highlight=False, soft_wrap=True)
