"""Commands on recorded runs: replay, report, repair, compare."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from teamslam.central.desk.pictures.style import Form, Look, Picture, Style, parsed_width
from teamslam.sim.cli import options as opt
from teamslam.sim.cli.commands import (
    Group,
    argument,
    fail,
    network,
    option,
    output_option,
    rare,
    refuse,
)
from teamslam.sim.cli.results import (
    Steps,
    print_evaluation,
    print_nis,
    print_table,
    print_written,
    read_run,
)

PICTURES = "Pictures for a paper or a talk"
app = Group()


@app.declare("teamslam replay runs/first --speed 20")
def replay(
    log: opt.LogArgument,
    speed: opt.SpeedText = "1",
    connect: Annotated[
        str | None, network("The router to publish at; default: one of our own.", "ENDPOINT")
    ] = None,
    listen: Annotated[
        str, network("Where our own router listens; port 0: any free one.", "ENDPOINT")
    ] = opt.LOOPBACK,
    keys: opt.Keys = None,
    insecure: Annotated[
        bool, network("Without keys, admit every process that reaches our own router.")
    ] = False,
    wait: Annotated[
        float, rare("Seconds between the router's start and the first message.", "S")
    ] = 1.0,
) -> None:
    """Publish a log's traffic again, with equal bytes, order and spacing in team time."""
    from contextlib import nullcontext

    from teamslam.team.recording.shell import replay as replay_samples
    from teamslam.team.shell import process
    from teamslam.team.wire.zenoh.router import router

    pace = opt.parse_speed(speed)
    if connect is None:
        if keys is not None:
            refuse("--keys is for a router that is there: give --connect")
        opt.refuse_open_door(listen, keys=False, insecure=insecure)
    opened = opt.open_log(log)
    hub = router(listen) if connect is None else nullcontext(connect)
    with (
        process("replay") as stop,
        hub as endpoint,
        opt.connect_bus(opened.team, endpoint, keys, "replay", stop) as bus,
    ):
        if connect is None:
            click.echo(f"listening at {endpoint}", err=True)
            stop.wait(wait)
        count = replay_samples(bus, opened.samples(), pace, stop)
    click.echo(f"replayed {count} messages of {log}")
    if not opened.complete:
        remedy = f"`teamslam repair {opened.path} -o FIXED.mcap` completes it"
        click.echo(f"{opened.path} is cut: {remedy}", err=True)


@app.declare(
    "teamslam report runs/first\n"
    "teamslam report runs/first --picture map --style paper --format pdf"
)
def report(
    log: opt.LogArgument,
    output: Annotated[
        Path | None,
        output_option(
            "Folder for the report; default: the run's, or one named like the log beside it.", "DIR"
        ),
    ] = None,
    ledger: Annotated[
        bool, option("Prove the ledger: the robots consume the recorded measurements again.")
    ] = True,
    picture: Annotated[
        Picture | None, option("This picture alone, and no page.", section=PICTURES)
    ] = None,
    look: Annotated[
        Look | None,
        option("Pictures in this style, beside the page's.", "--style", section=PICTURES),
    ] = None,
    form: Annotated[
        Form | None,
        option("Pictures in this format, beside the page's.", "--format", section=PICTURES),
    ] = None,
    width: Annotated[
        str | None,
        option(
            "Width of pictures for a paper, as 89mm; default: 3.5in, of panels 7.16in.",
            "WIDTH",
            section=PICTURES,
        ),
    ] = None,
    json_file: opt.JsonFile = None,
) -> None:
    """Write page, pictures, tables and figures of a run from its log.

    Exit status 1 if the log is cut: its figures are of the part before the cut.
    """
    from teamslam.central.desk.evaluation.figures import to_json
    from teamslam.central.desk.report.page import write_pictures, write_report
    from teamslam.central.desk.report.run import read_log, run_figures
    from teamslam.team.recording.reader import open_log

    output = output or _folder_of(log)
    width_in = _width(width, look)
    steps = Steps()
    opened = replace(open_log(log), reading=steps.share)
    opt.check_folder(output)
    steps.begin("scoring the run")
    run = read_run(opened, read_log(opened), steps, proves_ledger=ledger)
    steps.begin("drawing")
    if look or form or picture:
        style = Style(
            look or Look.SCREEN, form or (Form.PDF if look else Form.PNG), picture, width_in
        )
        drawn = write_pictures(run, output, style)
        if picture is not None and not drawn:
            fail(f"{log} has nothing to draw in the picture {picture}")
        if drawn:
            print_written(drawn.values())
        if picture is not None:
            return
    figures = to_json(
        run.evaluation, {**run_figures(run), "log": str(log), "complete": opened.complete}
    )
    print_evaluation(run.evaluation)
    print_nis(run.history)
    if (found := run.ledger) is not None:
        verdict = f"{len(found.offenders)} offenders" if found.offenders else found.statement()
        click.echo(f"ledger: {verdict}")
    try:
        print_written(write_report(run, output, figures))
    except OSError as error:
        fail(f"-o {output}: can not write: {error.strerror}; give another folder")
    opt.write_json(json_file, figures)
    opt.fail_if_cut(opened, "report")


def _folder_of(log: Path) -> Path:
    from teamslam.team.recording.reader import IN_FOLDER

    if log.is_dir():
        return log
    return log.parent if log.name == IN_FOLDER else log.with_suffix("")


def _width(text: str | None, look: Look | None) -> float | None:
    if text is None:
        return None
    if look is not Look.PAPER:
        refuse("--width is of pictures for a paper: give --style paper, too")
    try:
        return parsed_width(text)
    except ValueError as error:
        refuse(f"--width {error}")


@app.declare("teamslam repair team.mcap -o whole.mcap")
def repair(
    log: opt.LogArgument, output: Annotated[Path, output_option("The new, complete log.", "FILE")]
) -> None:
    """Complete a log or a ROS 2 bag (.mcap) whose recorder was killed: all up to its last flush."""
    from teamslam.sim.importing.source import is_own_log
    from teamslam.team.recording.editing import repair_bag, repair_log
    from teamslam.team.recording.reader import log_file

    opt.refuse_existing(output)
    log = log_file(log)
    is_bag = log.suffix == ".mcap" and log.is_file() and not is_own_log(log)
    result = repair_bag(log, output) if is_bag else repair_log(log, output)
    until = "" if result.until_ns is None else f" up to team time {result.until_ns * 1e-9:.3f} s"
    click.echo(f"{output}: {opt.count_noun(result.messages, 'message')}{until}")
    for damage in result.damaged:
        click.echo(f"lost: {damage}", err=True)


FEWEST = 2


@app.declare("teamslam compare runs/first runs/second -o both.png")
def compare(
    runs: Annotated[list[Path], argument("Runs' folders, or their logs; two or more.")],
    output: Annotated[Path | None, output_option("Write the picture here (png, svg, pdf).")] = None,
    json_file: opt.JsonFile = None,
) -> None:
    """Compare runs side by side: a column for each in a table, and a picture with -o."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from teamslam.central.desk.compare import compare_figures, compare_picture, filled_rows
    from teamslam.central.desk.evaluation.evaluation import evaluate

    if len(runs) < FEWEST:
        refuse("one run alone is compared with nothing: give two or more")
    if output is not None:
        _check_picture(output)
    evaluated = {}
    for path in runs:
        name = path.name if path.is_dir() else path.stem if path.stem != "log" else path.parent.name
        while name in evaluated:
            name += "'"
        evaluated[name] = evaluate(opt.open_log(path).samples())
    table = Table(box=box.SIMPLE)
    table.add_column("", no_wrap=True)
    for name in evaluated:
        table.add_column(Text(name), justify="right")
    for figure, cells in filled_rows(evaluated):
        table.add_row(Text(figure), *(Text(cell) for cell in cells))
    print_table(table)
    if output is not None and compare_picture(evaluated, output):
        click.echo(f"wrote {output}")
    opt.write_json(json_file, compare_figures(evaluated))


def _check_picture(path: Path) -> None:
    forms = [form.value for form in Form]
    if path.suffix.removeprefix(".") not in forms:
        names = ", ".join(f".{form}" for form in forms)
        refuse(f"-o {path}: a picture's name ends in one of {names}")
    if not path.parent.is_dir():
        refuse(f"-o {path}: there is no folder {path.parent}; make it first")
