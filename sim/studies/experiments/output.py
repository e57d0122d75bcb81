"""Show the progress of runs; write tables, JSON, pictures, and a page."""

import base64
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from math import isfinite
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as Grid
from rich.text import Text

from teamslam.sim.studies.experiments.cases import Done
from teamslam.sim.studies.experiments.experiment import Goal, Table, Task
from teamslam.sim.studies.experiments.runner import Concluded

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto; }
th, td { text-align: right; padding: .25rem .7rem; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; }
.wide { overflow-x: auto; } /* on a phone a picture of several panels is scrolled, not shrunk */
figure { margin: 1.5rem 0; }
figcaption, .note { color: #555; font-size: 90%; }
nav a { margin-right: 1rem; line-height: 2; white-space: nowrap; }
summary { cursor: pointer; }
.kinds td { text-align: left; font-size: 85%; vertical-align: top; }
"""
_WORDS = {True: "passed", False: "MISSED", None: "not computed"}
_COLOURS = {True: "green", False: "red", None: "yellow"}


def render_outcome(concluded: Concluded) -> list[RenderableType]:
    """Render the outcome for a terminal."""
    outcome = concluded.outcome
    parts: list[RenderableType] = [Text(outcome.title, style="bold")]
    parts += [_grid(table) for table in outcome.tables]
    if outcome.goals:
        parts.append(_goals(outcome.goals))
    parts += [Text(remark) for remark in outcome.remarks]
    parts += [Text(f"missing: {text}", style="yellow") for text in outcome.missing]
    parts += [
        Text(f"failed: {label}: {error}", style="red") for label, error in concluded.failed.items()
    ]
    return parts


def to_json(concluded: Concluded, provenance: Mapping[str, str]) -> dict[str, Any]:
    """Figures with their provenance; NaN and infinity become null."""
    options, outcome = concluded.options, concluded.outcome
    content = {
        "experiment": concluded.entry.name,
        "seeds": list(options.seeds),
        "quick": options.quick,
        "datasets": {each.name: each.sha256 for each in options.datasets},
        "runs": concluded.runs,
        "parameters": [
            {"run": label, "count": count, "parameters": parameters}
            for label, count, parameters in concluded.kinds
        ],
        **outcome.figures,
        "goals": [
            {
                "figure": goal.figure,
                "value": goal.value,
                "least": goal.least,
                "most": goal.most,
                "passed": goal.passed,
            }
            for goal in outcome.goals
        ],
        "remarks": list(outcome.remarks),
        "missing": list(outcome.missing),
        "failed": dict(concluded.failed),
        "program": dict(provenance),
    }
    strict: dict[str, Any] = _strict(content)
    return strict


def write(
    all_concluded: Sequence[Concluded], folder: Path, page: str, provenance: Mapping[str, str]
) -> Path:
    """Write JSON, pictures and a common page; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    sections = []
    for concluded in all_concluded:
        name = concluded.entry.name
        content = json.dumps(to_json(concluded, provenance), indent=1, allow_nan=False)
        (folder / f"{name}.json").write_text(content + "\n", encoding="utf-8")
        figures = []
        for picture in concluded.outcome.pictures:
            path = folder / f"{name}-{picture.name}.png"
            picture.draw(path)
            figures.append(_figure(path, picture.caption))
        sections.append(_section(concluded, figures))
    names = [concluded.entry.name for concluded in all_concluded]
    path = folder / f"{page}.html"
    path.write_text(_page(names, sections, provenance), encoding="utf-8")
    return path


def _strict(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _strict(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def _grid(table: Table) -> Grid:
    grid = Grid(
        title=Text(table.title),
        caption=Text(table.note) if table.note else None,
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
    )
    words = " ".join(row[0] for row in table.rows).split()
    widest = max((len(word) for word in words), default=0)
    for k, column in enumerate(table.columns):
        if k:
            grid.add_column(Text(column), justify="right", no_wrap=True)
        else:  # wraps in a narrow terminal, but not within a word
            grid.add_column(Text(column), min_width=widest)
    for row in table.rows:
        grid.add_row(*(Text(cell) for cell in row))
    return grid


def _goals(goals: Sequence[Goal]) -> Grid:
    grid = Grid(title="goals", box=box.SIMPLE_HEAD)
    for k, column in enumerate(("figure", "value", "goal", "")):
        grid.add_column(column, justify="right" if k in (1, 2) else "left")
    for goal in goals:
        word = Text(_WORDS[goal.passed], style=_COLOURS[goal.passed])
        grid.add_row(Text(goal.figure), Text(_value(goal)), Text(_bounds(goal)), word)
    return grid


def _value(goal: Goal) -> str:
    return "–" if goal.value is None else f"{goal.value:.4g}"


def _bounds(goal: Goal) -> str:
    return f"{goal.least:g} … {goal.most:g}" if goal.least > 0.0 else f"≤ {goal.most:g}"


def _page(names: Sequence[str], sections: Sequence[str], provenance: Mapping[str, str]) -> str:
    links = "".join(f'<a href="#{escape(name)}">{escape(name)}</a> ' for name in names)
    origin = "".join(
        f"<tr><td>{escape(key)}</td><td>{escape(value)}</td></tr>"
        for key, value in provenance.items()
    )
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>teamslam: {escape(', '.join(names))}</title>",
            f"<style>{_STYLE}</style>",
            "<h1>teamslam: experiments</h1>",
            f"<nav>{links}</nav>" if len(names) > 1 else "",
            *sections,
            f"<h2>What made it</h2><table>{origin}</table></html>",
        ]
    )


def _section(concluded: Concluded, figures: Sequence[str]) -> str:
    outcome, options = concluded.outcome, concluded.options
    name = escape(concluded.entry.name)
    seeds = f"seeds {options.seeds[0]} … {options.seeds[-1]}" if options.seeds else "no seeds"
    sets = "".join(f", {each.name} (sha256 {each.sha256[:12]}…)" for each in options.datasets)
    goals = Table(
        "Goals",
        ("figure", "value", "goal", ""),
        tuple((g.figure, _value(g), _bounds(g), _WORDS[g.passed]) for g in outcome.goals),
    )
    return "\n".join(
        [
            f'<h2 id="{name}">{name}: {escape(outcome.title)}</h2>',
            f'<p class="note">{escape(concluded.entry.summary)} {concluded.runs} runs, '
            f"{escape(seeds + sets)}.</p>",
            *(f"<p>{escape(remark)}</p>" for remark in outcome.remarks),
            *figures,
            *(_html_table(table) for table in outcome.tables),
            _html_table(goals) if outcome.goals else "",
            _kinds(concluded),
            *(f"<p><b>Missing:</b> {escape(text)}</p>" for text in outcome.missing),
            *(
                f"<p><b>Failed:</b> {escape(label)}: {escape(error)}</p>"
                for label, error in concluded.failed.items()
            ),
        ]
    )


def _kinds(concluded: Concluded) -> str:
    if not concluded.kinds:
        return ""
    rows = "".join(
        f"<tr><td>{escape(label)}</td><td>{count}</td><td>{escape(parameters)}</td></tr>"
        for label, count, parameters in concluded.kinds
    )
    head = "<tr><th>runs</th><th>seeds</th><th>where they differ from the scenario</th></tr>"
    return (
        f"<details><summary>{concluded.runs} runs and their parameters</summary>"
        f'<table class="kinds">{head}{rows}</table></details>'
    )


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows
    )
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return f"<h3>{escape(table.title)}</h3><table><tr>{head}</tr>{rows}</table>{note}"


def _figure(path: Path, caption: str) -> str:
    png = path.read_bytes()
    data = base64.b64encode(png).decode()
    width = int.from_bytes(png[16:20], "big")
    return (
        f'<figure><div class="wide"><img alt="{escape(caption)}" style="min-width: {width // 2}px" '
        f'src="data:image/png;base64,{data}"></div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


LINE_S = 10.0


@contextmanager
def show_progress(tasks: Sequence[Task], found: int) -> Iterator[Callable[[Done], None]]:
    """Yield a function to call with every finished task."""
    console = Console(stderr=True)
    of = f"{len(tasks)} runs" + (f", {found} more are stored" if found else "")
    # The bar advances by expected cost, which differs widely between runs.
    cost = sum(task.cost for task in tasks)
    bar = Progress(
        BarColumn(bar_width=30),
        TextColumn("{task.fields[runs]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not (tasks and console.is_terminal),
    )
    finished, due = 0, time.monotonic()

    def hear(done: Done) -> None:
        nonlocal finished, due
        finished += 1
        bar.update(whole, advance=done.task.cost, runs=f"{finished} of {of}")
        if done.error:
            text = f"failed: {done.task.label}: {done.error}"
            console.print(text, markup=False, highlight=False, soft_wrap=True)
        if bar.disable and (time.monotonic() >= due or finished == len(tasks)):
            due = time.monotonic() + LINE_S
            console.print(f"{finished} of {of}", highlight=False, soft_wrap=True)

    if not tasks:
        console.print(of, highlight=False)
    with bar:
        whole = bar.add_task("", total=cost, runs=of)
        yield hear
