"""Write the report: a self-contained page, pictures, figures."""

import base64
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from teamslam.central.desk.export.take_home import (
    write_geojson,
    write_map,
    write_paths,
    write_trajectories,
)
from teamslam.central.desk.names import OUTSIDE, in_order
from teamslam.central.desk.pictures.run import consistency_picture, error_picture, map_picture
from teamslam.central.desk.pictures.style import PAGE, SCREEN, Picture, Style, drawn_in
from teamslam.central.desk.report import tables
from teamslam.central.desk.report.run import Run
from teamslam.team.recording.provenance import version

LISTED_EVENTS = 200  # most events in the page's table; report.json has all
_ORIGIN = ("git.commit", "seed", "version.teamslam", "version.python")


def write_pictures(run: Run, directory: Path, style: Style = SCREEN) -> dict[str, Path]:
    """Draw a run's non-empty pictures."""
    evaluation, history = run.evaluation, run.history
    draw: dict[Picture, Callable[[Path], bool]] = {
        Picture.MAP: lambda path: map_picture(evaluation, path, run.paths),
        Picture.ERRORS: lambda path: error_picture(evaluation, path),
        Picture.CONSISTENCY: lambda path: consistency_picture(evaluation, history, path),
    }
    directory.mkdir(parents=True, exist_ok=True)
    with drawn_in(style):
        paths = {each: directory / style.file_name(each) for each in style.drawn}
        return {str(each): path for each, path in paths.items() if draw[each](path)}


def write_report(run: Run, directory: Path, figures: Mapping[str, Any]) -> list[Path]:
    """Write page, figures, tables, pictures and trajectories; return the files."""
    directory.mkdir(parents=True, exist_ok=True)
    pictures = write_pictures(run, directory, PAGE)
    page, data = directory / "report.html", directory / "report.json"
    data.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    page.write_text(_page(run, pictures, figures.get("processes", {})), encoding="utf-8")
    written = [page, data]
    if run.evaluation.map is not None:
        written += write_map(run.evaluation.map, run.taken_home, directory)
        if (datum := run.taken_home.datum) is not None:
            written.append(write_geojson(run.evaluation.map, run.paths, directory, datum))
    if run.paths:
        write_paths(run.paths, directory / "paths")
        written.append(directory / "paths")
    written += pictures.values()
    trajectories = directory / "trajectories"
    return [*written, trajectories] if write_trajectories(run.evaluation, trajectories) else written


def _page(
    run: Run, pictures: Mapping[str, Path], processes: Mapping[str, Mapping[str, float | None]]
) -> str:
    evaluation = run.evaluation
    title = escape(tables.title_of(evaluation))
    own = _sheet(tables.own_sheet(evaluation)) if tables.is_unfused(evaluation) else ""
    sections = {
        "Map": [_image(pictures, "map", wide=False), own],
        "Robots": [_sheet(tables.robot_sheet(evaluation)), _image(pictures, "errors")],
        "Landmarks": _landmarks(run),
        "Peers": [_sheet(tables.peer_sheet(evaluation))],
        "Consistency": [_sheet(tables.consistency_sheet(run)), _image(pictures, "consistency")],
        "Paths": _paths(run),
        "Measurements": _measurements(run),
        "Events": _events(run),
        "Latency": [_sheet(tables.latency_sheet(run))],
        "Traffic": _traffic(run),
        "Processes": [_sheet(tables.process_sheet(processes))],
        "Origin": _origin(run),
    }
    there = {name: text for name, of in sections.items() if (text := "\n".join(filter(None, of)))}
    links = "".join(f'<a href="#{name.lower()}">{name}</a>' for name in there)
    body = "\n".join(f'<h2 id="{name.lower()}">{name}</h2>\n{text}' for name, text in there.items())
    notes = "\n".join(f"<p>{escape(note)}</p>" for note in evaluation.notes)
    style = files("teamslam.central.desk.report").joinpath("page.css").read_text("utf-8")
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{title}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>\n{style}</style>\n<h1>{title}</h1>\n{_describe_origin(run)}\n<nav>{links}</nav>\n"
        f"{_table((), tables.team_rows(evaluation), words=True)}\n{notes}\n{body}\n</html>\n"
    )


def _describe_origin(run: Run) -> str:
    by = run.provenance.get("version.teamslam")
    at_ns = run.evaluation.recorded_ns
    recorded = "" if at_ns is None else f"Recorded on {_date(at_ns * 1e-9)}"
    recorded += f" by teamslam {by}" if recorded and by else ""
    made = f"report of {_date(datetime.now(UTC).timestamp())}, teamslam {version('teamslam')}"
    parts = [recorded, made, run.command]
    return _note("; ".join(filter(None, parts)))


def _date(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M} UTC"


def _landmarks(run: Run) -> list[str]:
    evaluation = run.evaluation
    parts = [] if evaluation.association is None else [tables.score_sheet(evaluation.association)]
    changes = () if evaluation.map is None else evaluation.map.changes
    parts += tables.change_sheet(changes), tables.decision_sheet(evaluation.decisions)
    return [*map(_sheet, parts)]


def _paths(run: Run) -> list[str]:
    sheet = tables.path_sheet(run.evaluation)
    if all(cell in {"–", OUTSIDE} for row in sheet.rows for cell in row[1:]):
        return []
    return [_sheet(sheet), _sheet(tables.ape_sheet(run))]


def _measurements(run: Run) -> list[str]:
    ledger = run.ledger
    if ledger is None:
        ledgers = {n: robot.consumption.ledger for n, robot in run.evaluation.robots.items()}
        reported = _note(f"As reported by the robots. The ledger: {run.no_ledger}.")
        return [_sheet(tables.disposition_sheet(ledgers)), reported]
    robots = in_order({robot for robot, _ in ledger.entries})
    used = sum(1 for maps in ledger.maps.values() if maps)
    kind, verdict = ("good", ledger.statement())
    if ledger.offenders:
        kind = "bad"
        verdict = f"{len(ledger.offenders)} offenders: {'; '.join(ledger.offenders[:5])}"
    return [
        f'<p class="{kind}">Ledger: {escape(verdict)}.</p>',
        _sheet(tables.disposition_sheet({robot: ledger.totals(robot) for robot in robots})),
        _note(f"{len(ledger.maps)} submaps, {used} of them in a map"),
    ]


def _events(run: Run) -> list[str]:
    events = run.history.events
    if not events:
        return []
    rows = [
        ("before" if s < 0.0 else f"{s:.1f} s", event.of, event.text)
        for event in events[:LISTED_EVENTS]
        for s in ((event.stamp_ns - run.history.start_ns) * 1e-9,)
    ]
    more = len(events) - len(rows)
    left = _note(f"{more} more in report.json") if more else ""
    start_s = run.history.start_ns * 1e-9
    clock = _note(f"Times are from the start, {start_s:,.1f} s of the clock that the texts give.")
    return [_table(("", "node", "event"), rows, words=True), clock if start_s >= 1.0 else "", left]


def _traffic(run: Run) -> list[str]:
    sheet = tables.traffic_sheet(run)
    summary = f"<summary>Every key ({len(sheet.rows)})</summary>"
    return [f"<details>{summary}{_sheet(sheet)}</details>"] if sheet.rows else []


def _origin(run: Run) -> list[str]:
    short = {k: v for k, v in run.provenance.items() if len(v) <= 80}
    first = [(k, short[k]) for k in _ORIGIN if k in short]
    rest = [(k, v) for k, v in sorted(short.items()) if k not in _ORIGIN]
    folded = [
        f"<details><summary>{escape(k)}</summary><pre>{escape(_indented(v))}</pre></details>"
        for k, v in sorted(run.provenance.items())
        if k not in short
    ]
    return [_table((), [*first, *rest], words=True) if short else "", *folded]


def _indented(text: str) -> str:
    try:
        return json.dumps(json.loads(text), indent=2, ensure_ascii=False)
    except (ValueError, RecursionError):
        return text


def _image(pictures: Mapping[str, Path], name: str, *, wide: bool = True) -> str:
    if name not in pictures:
        return ""
    vector = pictures[name].with_suffix(".svg")
    data = base64.b64encode(vector.read_bytes()).decode()
    kind = ' class="wide"' if wide else ""
    return f'<figure><img{kind} alt="{name}" src="data:image/svg+xml;base64,{data}"></figure>'


def _note(text: str) -> str:
    """Paragraph of small text; `backticks` enclose code."""
    shown = re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))
    return f'<p class="note">{shown}</p>'


def _sheet(sheet: tables.Sheet) -> str:
    """Table with its note; nothing without rows."""
    if not sheet.rows:
        return ""
    note = f"\n{_note(sheet.note)}" if sheet.note else ""
    return _table(sheet.headings, sheet.rows) + note


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, words: bool = False) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows
    )
    opening = '<table class="words">' if words else "<table>"
    return f"{opening}\n<tr>{head}</tr>\n{body}</table>" if head else f"{opening}\n{body}</table>"
