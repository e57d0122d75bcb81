"""Command `teamslam compare`."""

from pathlib import Path
from typing import Annotated

import typer

from teamslam.central.desk.pictures.style import Form
from teamslam.sim.cli.help import Command, output_option
from teamslam.sim.cli.options import WRONG_USE, JsonFile, fail, warn_of_holes, write_json

app = typer.Typer()
FEWEST = 2


@app.command(cls=Command, epilog="teamslam compare runs/first runs/second -o both.png")
def compare(
    runs: Annotated[list[Path], typer.Argument(help="Runs' folders, or their logs; two or more.")],
    output: Annotated[Path | None, output_option("Write the picture here (png, svg, pdf).")] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare runs side by side: a column for each in a table, and a picture with -o."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from teamslam.central.desk.compare import compare_figures, compare_picture, compare_rows
    from teamslam.central.desk.evaluation.evaluation import evaluate
    from teamslam.team.recording.reader import open_log

    if len(runs) < FEWEST:
        fail("one run alone is compared with nothing: give two or more", WRONG_USE)
    if output is not None:
        _check_picture(output)
    evaluated = {}
    for path in runs:
        name = path.name if path.is_dir() else path.stem if path.stem != "log" else path.parent.name
        while name in evaluated:
            name += "'"
        opened = open_log(path)
        warn_of_holes(opened)
        evaluated[name] = evaluate(opened.samples())
    table = Table(box=box.SIMPLE)
    table.add_column("", no_wrap=True)
    for name in evaluated:
        table.add_column(Text(name), justify="right")
    for figure, cells in compare_rows(evaluated):
        table.add_row(Text(figure), *(Text(cell) for cell in cells))
    Console().print(table)
    if output is not None and compare_picture(evaluated, output):
        typer.echo(f"wrote {output}")
    write_json(json_file, compare_figures(evaluated))


def _check_picture(path: Path) -> None:
    forms = [form.value for form in Form]
    if path.suffix.removeprefix(".") not in forms:
        names = ", ".join(f".{form}" for form in forms)
        fail(f"-o {path}: a picture's name ends in one of {names}", WRONG_USE)
    if not path.parent.is_dir():
        fail(f"-o {path}: there is no folder {path.parent}; make it first", WRONG_USE)
