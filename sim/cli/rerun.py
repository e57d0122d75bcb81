"""Commands that recompute a log: rerun and verify-ledger."""

import math
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import Group, argument, fail, failing, option, output_option, refuse
from teamslam.sim.cli.results import (
    Steps,
    print_changes,
    print_nis,
    print_notes,
    print_placements,
    print_table,
    print_written,
    read_run,
)

if TYPE_CHECKING:
    from teamslam.central.desk.report.run import Reading
    from teamslam.central.desk.verification.verification import Verification
    from teamslam.sim.recorded.changed_run import Changes
    from teamslam.team.wire.bus import Sample

app = Group()

NETWORK_CHANGES = "Another network"
OFFENDERS = 20  # most printed violations; the JSON file has all


@app.declare("teamslam rerun runs/first --verify\nteamslam rerun runs/first --without r3")
def rerun(
    log: Annotated[Path, argument("An MCAP log of a team, a data set or a ROS 2 bag.")],
    verify: Annotated[
        bool, option("Compute every recomputable message again; compare.", "--verify")
    ] = False,
    without: Annotated[
        list[str] | None, option("A robot to leave out; repeatable.", "ROBOT")
    ] = None,
    output: Annotated[
        Path | None, output_option("Folder for log and report of the computed run.", "DIR")
    ] = None,
    particles: Annotated[int | None, option("Particles of each robot.", "N", least=4)] = None,
    window: Annotated[float | None, option("Seconds of a submap's window.", "S")] = None,
    seed: Annotated[
        int | None, option("Seed of the estimators and of the losses.", "N", least=0)
    ] = None,
    map_: opt.MapFiles = None,
    localise: opt.Localise = False,
    noise: Annotated[
        list[str] | None,
        option(
            "Robots assume another noise: odometry=2, range=0.5, bearing=3; repeatable.",
            "KIND=FACTOR",
        ),
    ] = None,
    loss: Annotated[
        float,
        option(
            "Probability that a submap is lost on its way; it is sent again.",
            "P",
            section=NETWORK_CHANGES,
        ),
    ] = 0.0,
    delay: Annotated[
        float,
        option("Seconds that submaps need to the centre.", "S", least=0.0, section=NETWORK_CHANGES),
    ] = 0.0,
    no_centre: Annotated[
        str | None, option("Seconds without a centre, as 60-120.", "SPAN", section=NETWORK_CHANGES)
    ] = None,
    partition: Annotated[
        list[str] | None,
        option(
            "Robots cut off from the centre, and when, as r1,r2:100-200.",
            "ROBOTS:SPAN",
            section=NETWORK_CHANGES,
        ),
    ] = None,
    fusion: opt.FusionOption = None,
    estimator: opt.EstimatorOption = None,
    json_file: opt.JsonFile = None,
) -> None:
    """Recompute a log, to verify it or to compare it under other conditions.

    With --verify every message is recomputed from the inputs that it names.
    Otherwise the recorded measurements pass through the same nodes again, with
    the given changes; without a change, as if every message arrived at once. For
    a data set, the reference run is computed, too. No process is started. Exit
    status 0 only if the log is complete and every robot that is not left out is in
    the final map, with --verify only if all is equal; else 1. 2: wrong use.
    """
    from teamslam.sim.recorded.changed_run import Changes

    opt.saved_maps(map_)
    if localise:
        opt.check_localises(map_)
    if window is not None and not 0.0 < window < math.inf:
        refuse(f"--window {window}: give a positive number")
    if not 0.0 <= loss < 1.0:
        refuse(f"--loss {loss}: give a probability from 0 to below 1")
    changes = Changes(
        without=tuple(without or ()),
        fusion=fusion,
        estimator=estimator,
        particles=particles,
        window_s=window,
        seed=seed,
        loss=loss,
        delay_s=delay,
        no_centre=None if no_centre is None else _span(no_centre, "--no-centre"),
        partitions=tuple(_partition(each) for each in partition or ()),
        noise=_noise(noise or []),
        maps=tuple(map(str, map_ or ())),
        localise=localise,
    )
    if output is not None:
        opt.check_folder(output)
    if not verify:
        _compare(log, changes, json_file, output)
    elif changes == Changes():
        _verify(log, json_file)
    else:
        refuse("--verify compares with the log as it is: leave the changes away")


def _span(text: str, option: str) -> tuple[float, float]:
    first, _, last = text.partition("-")
    begin, end = opt.number_in(first), opt.number_in(last)
    if not 0.0 <= begin < end < math.inf:
        refuse(f"{option} {text}: give seconds since the log's first measurement, as 60-120")
    return begin, end


def _partition(text: str) -> tuple[tuple[str, ...], tuple[float, float]]:
    robots, colon, span = text.partition(":")
    if not (robots and colon):
        refuse(f"--partition {text}: give robots and seconds, as r1,r2:100-200")
    return tuple(robots.split(",")), _span(span, "--partition")


def _noise(asked: list[str]) -> tuple[tuple[str, float], ...]:
    from teamslam.sim.recorded.changed_run import KINDS

    factors: dict[str, float] = {}
    for text in asked:
        kind, _, number = text.partition("=")
        factor = opt.number_in(number)
        if kind not in KINDS or not 0.0 < factor < math.inf:
            refuse(
                f"--noise {text}: give one of {', '.join(KINDS)} and a factor above 0, as range=2"
            )
        if kind in factors:
            refuse(f"--noise {text}: {kind} is given twice")
        factors[kind] = factor
    return tuple(factors.items())


def _compare(path: Path, changes: "Changes", json_file: Path | None, output: Path | None) -> None:
    from rich.table import Table
    from rich.text import Text

    from teamslam.central.desk.compare import (
        draw_maps,
        filled_rows,
        largest_move_m,
        same_final_map,
    )
    from teamslam.central.desk.evaluation.evaluation import evaluate
    from teamslam.central.desk.evaluation.figures import to_json
    from teamslam.central.desk.report.run import read_samples
    from teamslam.central.desk.verification.recorded import RerunError
    from teamslam.sim.cli.importing import readable
    from teamslam.sim.recorded.changed_run import Changes, changed_run, check_days
    from teamslam.sim.recorded.world import DataSetRun, log_or_run
    from teamslam.team.recording.reader import Log

    with readable(path) as source:
        log = log_or_run(source)
    if isinstance(log, Log):
        opt.warn_of_holes(log)
    check_days(log, changes)
    plain = isinstance(log, DataSetRun) and changes == Changes()
    original = None if plain else evaluate(log.samples())
    with failing(RerunError, at=path):
        computed = list(log.samples()) if plain else changed_run(log, changes)
        reading = read_samples(computed)
    changed = reading.evaluation
    recorded = original or changed
    before = "unchanged" if isinstance(log, DataSetRun) else "recorded"
    runs = {"computed": changed} if plain else {before: recorded, "recomputed": changed}
    table = Table("", *runs)
    for figure, cells in filled_rows(runs):
        table.add_row(Text(figure), *map(Text, cells))
    print_table(table)
    print_notes(changed.warnings, dict.fromkeys((*recorded.notes, *changed.notes)))
    print_nis(reading.history)
    print_changes(changed)
    if changes.localise:
        print_placements(computed, reading.history.start_ns)
    same, move_m = same_final_map(recorded, changed), largest_move_m(recorded, changed)
    moved = "" if move_m is None else f", landmarks up to {move_m:.3g} m apart"
    verdict = "the same bytes" if same else f"another one{moved}"
    if changes.localise:
        verdict = "the saved one, with poses and paths in its frame"
    if not plain:
        click.echo(f"final map: {verdict}")
    figures = {
        "changes": asdict(changes),
        "same_final_map": same,
        "largest_move_m": move_m,
        "recorded": to_json(recorded),
        "recomputed": to_json(changed),
    }
    opt.write_json(json_file, figures)
    if output is not None:
        _write_run(computed, reading, output)
        if not plain and draw_maps(runs, output / "maps.png"):
            click.echo(f"wrote {output / 'maps.png'}")
    if changed.map is None:
        fail("the changed run ended without a final map")
    if failures := changed.failures:
        fail("; ".join(failures))
    if isinstance(log, Log):
        opt.fail_if_cut(log, "result")


def _write_run(computed: "list[Sample]", reading: "Reading", folder: Path) -> None:
    from teamslam.central.desk.evaluation.figures import to_json
    from teamslam.central.desk.report.page import write_report
    from teamslam.central.desk.report.run import run_figures
    from teamslam.team.recording.provenance import provenance
    from teamslam.team.recording.reader import IN_FOLDER, open_log
    from teamslam.team.recording.recorder import Recorder

    evaluation = reading.evaluation
    assert evaluation.scenario is not None
    log = folder / IN_FOLDER
    if log.exists():
        opt.set_aside(log)
    with Recorder(log, evaluation.scenario.team, provenance()) as recorder:
        recorder.write(computed)
    steps = Steps()
    run = read_run(open_log(log), reading, steps, proves_ledger=False)
    steps.begin("drawing")
    print_written(write_report(run, folder, to_json(evaluation, run_figures(run))))


def _verify(path: Path, json_file: Path | None) -> None:
    from teamslam.central.desk.verification.recorded import RerunError
    from teamslam.central.desk.verification.verification import verify

    log = opt.open_log(path)
    began = time.monotonic()
    with failing(RerunError, at=path):
        result = verify(log, _processes())
    elapsed_s = time.monotonic() - began
    _print_verification(result, elapsed_s)
    figures = asdict(result) | {"elapsed_s": elapsed_s, "equal": result.first is None}
    opt.write_json(json_file, figures)
    if not log.complete:
        click.echo(f"{path} is cut: its last messages may lack their inputs", err=True)
    if not result.messages:
        fail(f"{path} has no message that can be computed again: nothing is verified")
    if result.first is not None:
        what = "the log lacks what is needed" if result.first.lacks else "the first difference"
        fail(f"{what}: {result.first}")


def _processes() -> int:
    """One process where fork is unsafe or absent."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1


def _print_verification(result: "Verification", elapsed_s: float) -> None:
    from teamslam.central.desk.report.tables import Sheet, terminal_table

    counts = (
        (row.channel, row.messages, row.equal, row.close, row.different, row.lacking)
        for row in result.channels
    )
    rows = [(channel, *(f"{n:,}" for n in numbers)) for channel, *numbers in counts]
    headings = ("channel", "messages", "equal", "within tolerance", "different", "inputs lost")
    print_table(terminal_table(Sheet(headings, rows)))
    for row in result.channels:
        if row.first is not None:
            click.echo(f"{row.channel}: {row.first}")
    if result.other_platform:
        from teamslam.central.desk.verification.verification import RELATIVE

        differing = ", ".join(result.other_platform)
        click.echo(
            f"another platform ({differing}): numbers compared within {RELATIVE:g}, not bits"
        )
    if result.unsound:
        click.echo(f"{result.unsound} invalid samples were left out")
    different = sum(row.different for row in result.channels)
    lacking = sum(row.lacking for row in result.channels)
    whole = "all" if not lacking else "all others"
    verdict = f"{whole} equal" if not different else f"{different} different"
    if not different and any(row.close for row in result.channels):
        verdict = f"{whole} equal within the tolerance"
    if lacking:
        verdict += f", {lacking} can not be judged, since the log lacks their inputs"
    click.echo(
        f"{result.messages:,} messages from {result.measurements:,} measurements: {verdict}; "
        f"{elapsed_s:.1f} s for {result.span_s:.0f} s of team time, "
        f"{result.span_s / elapsed_s:.0f} × real time"
    )


@app.declare("teamslam verify-ledger runs/first --list", name="verify-ledger")
def verify_ledger(
    log: opt.LogArgument,
    lists: Annotated[
        bool, option("List each rejected measurement with its reason.", "--list")
    ] = False,
    json_file: opt.JsonFile = None,
) -> None:
    """Prove that each measurement of a log was used once: its disposition, its submap, its maps."""
    from teamslam.central.desk.ledger import ledger
    from teamslam.central.desk.names import in_order
    from teamslam.central.desk.report.tables import (
        disposition_sheet,
        rejection_sheets,
        terminal_table,
    )
    from teamslam.central.desk.verification.recorded import RerunError, index_log

    opened = opt.open_log(log)
    with failing(RerunError, at=log):
        found = ledger(index_log(opened))
    robots = in_order({robot for robot, _ in found.entries})
    sheets = [disposition_sheet({robot: found.totals(robot) for robot in robots})]
    if lists:
        sheets += [sheet for sheet in rejection_sheets(found) if sheet.rows]
    for sheet in sheets:
        print_table(terminal_table(sheet))
    used = sum(1 for maps in found.maps.values() if maps)
    click.echo(f"{len(found.maps)} submaps, {used} of them in a map")
    if not lists and (found.rejected or found.outliers):
        click.echo("--list shows each rejected measurement with its reason")
    if not opened.complete:
        click.echo(f"{log} is cut: measurements after the cut count as lost", err=True)
    opt.write_json(json_file, found.to_json())
    for offender in found.offenders[:OFFENDERS]:
        click.secho(offender, fg="red", err=True)
    if found.offenders:
        fail(f"{len(found.offenders)} violations of the ledger")
    click.echo(found.statement())
