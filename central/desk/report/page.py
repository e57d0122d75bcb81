"""Write the report as a folder: a self-contained page, pictures, figures."""

import base64
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from teamslam.central.desk.export.take_home import write_map, write_paths
from teamslam.central.desk.export.tum import write_trajectories
from teamslam.central.desk.names import OUTSIDE, in_order
from teamslam.central.desk.pictures.run import error_picture, map_picture
from teamslam.central.desk.pictures.style import SCREEN, Picture, Style, drawn_in
from teamslam.central.desk.pictures.time import consistency_picture
from teamslam.central.desk.report.identities import decision_sheet, score_sheet
from teamslam.central.desk.report.run import Run
from teamslam.central.desk.report.tables import (
    Sheet,
    change_sheet,
    disposition_sheet,
    format_figure,
    is_unfused,
    own_sheet,
    path_sheet,
    peer_sheet,
    robot_sheet,
    team_rows,
    title_of,
)
from teamslam.team.shapes import Float

LISTED_EVENTS = 200
"""Most events in the page's table; report.json has all."""
NIS_NOTE = (
    "NIS lies below 1 where a robot's sensor is configured with errors that last within a window "
    "(range_white, bearing_white): the particles take every error for a new one."
)
_ORIGIN = ("commit", "seed", "command", "python")

_STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1b1b; max-width: 62rem; margin: 0 auto;
  padding: 1rem; }
h1 { font-size: 1.5rem; line-height: 1.25; } h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; }
nav { font-size: .9rem; } nav a { margin-right: .8rem; white-space: nowrap; display: inline-block; }
a { color: #0b5ea8; }
table { border-collapse: collapse; margin: .5rem 0 1rem; display: block; overflow-x: auto;
  font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .25rem .6rem; border-bottom: 1px solid #ddd;
  vertical-align: top; white-space: pre-line; }
th:first-child, td:first-child, table.words td, table.words th {
  text-align: left; }
table.words td:first-child { white-space: nowrap; }
figure { margin: 1rem 0; overflow-x: auto; }
img { width: 100%; height: auto; } img.wide { min-width: 34rem; }
p.note { color: #555; font-size: .9rem; } .good { color: #1c6e2c; } .bad { color: #b00020; }
details { margin: 1rem 0; } summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; background: #f6f6f6; padding: .6rem; font-size: .85rem; }
@media (max-width: 40rem) {
  body { padding: .6rem; font-size: 15px; } td, th { padding: .2rem .4rem; }
}
"""


PSS_NOTE = (
    "RSS: resident memory, shared pages included. PSS at the end of the run: a page that n "
    "processes share counts 1/n in each."
)


def write_pictures(run: Run, directory: Path, style: Style = SCREEN) -> dict[str, Path]:
    """Draw a run's pictures; returns the non-empty ones by name."""
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
    """Write report.html, report.json, pictures and trajectories; returns the files.

    figures: of the evaluation and the run. Empty pictures are omitted.
    """
    directory.mkdir(parents=True, exist_ok=True)
    evaluation = run.evaluation
    pictures = write_pictures(run, directory)
    data = directory / "report.json"
    data.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    page = directory / "report.html"
    page.write_text(_page(run, pictures, figures.get("processes", {})), encoding="utf-8")
    trajectories = directory / "trajectories"
    paths = write_trajectories(evaluation, trajectories)
    return [
        page,
        data,
        *_taken_home(run, directory),
        *pictures.values(),
        *([trajectories] if paths else []),
    ]


def _taken_home(run: Run, directory: Path) -> list[Path]:
    home, written = run.taken_home, []
    if run.evaluation.map is not None:
        written += write_map(
            run.evaluation.map, {} if home is None else home.measurements, directory
        )
    if run.paths:
        write_paths(run.paths, directory / "paths")
        written.append(directory / "paths")
    return written


def _page(
    run: Run, pictures: Mapping[str, Path], processes: Mapping[str, Mapping[str, float | None]]
) -> str:
    title = escape(title_of(run.evaluation))
    sections = [
        ("Map", [_image(pictures, "map", wide=False), *_own_maps(run)]),
        ("Robots", _robots(run, pictures)),
        ("Landmarks", _identities(run)),
        ("Peers", _peers(run)),
        ("Consistency", _consistency(run, pictures)),
        ("Paths", _paths(run)),
        ("Measurements", _measurements(run)),
        ("Events", _events(run)),
        ("Latency", _latency(run)),
        ("Traffic", _traffic(run)),
        ("Processes", _processes(processes)),
        ("Origin", _origin(run)),
    ]
    there = [(name, "\n".join(filter(None, parts))) for name, parts in sections]
    there = [(name, text) for name, text in there if text]
    links = "".join(f'<a href="#{name.lower()}">{name}</a>' for name, _ in there)
    body = "\n".join(f'<h2 id="{name.lower()}">{name}</h2>\n{text}' for name, text in there)
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{title}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{_STYLE}</style>\n<h1>{title}</h1>\n<nav>{links}</nav>\n"
        f"{_table((), team_rows(run.evaluation), words=True)}\n{_notes(run)}\n{body}\n</html>\n"
    )


def _identities(run: Run) -> list[str]:
    evaluation = run.evaluation
    parts = [] if evaluation.association is None else _sheet(score_sheet(evaluation.association))
    changes = () if evaluation.map is None else evaluation.map.changes
    if any(each.state != "unchanged" for each in changes):
        parts += _sheet(change_sheet(changes))
    return parts + (_sheet(decision_sheet(evaluation.decisions)) if evaluation.decisions else [])


def _peers(run: Run) -> list[str]:
    return _sheet(peer_sheet(run.evaluation)) if run.evaluation.peers else []


def _processes(processes: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """Resources of each launched process, which are not in the log."""
    if not processes:
        return []
    rows = [
        (
            name,
            format_figure(took.get("cpu_s"), ".2f", ""),
            format_figure(took.get("peak_rss_mb"), ".0f", ""),
            format_figure(took.get("pss_mb"), ".0f", ""),
        )
        for name, took in processes.items()
    ]
    return _sheet(Sheet(("process", "CPU\n[s]", "peak RSS\n[MB]", "PSS\n[MB]"), rows, PSS_NOTE))


def _notes(run: Run) -> str:
    return "\n".join(f"<p>{escape(note)}</p>" for note in run.evaluation.notes)


def _own_maps(run: Run) -> list[str]:
    return _sheet(own_sheet(run.evaluation)) if is_unfused(run.evaluation) else []


def _robots(run: Run, pictures: Mapping[str, Path]) -> list[str]:
    if not run.evaluation.robots:
        return []
    return [*_sheet(robot_sheet(run.evaluation)), _image(pictures, "errors")]


def _consistency(run: Run, pictures: Mapping[str, Path]) -> list[str]:
    """Consistency of the covariances: NEES and coverage with truth, otherwise NIS and cost."""
    innovations, cost = run.history.innovations, run.evaluation.cost_by_robot
    scale = run.evaluation.scale_by_robot
    rows = []
    for name in in_order(run.evaluation.robots.keys() | innovations.keys() | cost.keys()):
        robot, of = run.evaluation.robots.get(name), innovations.get(name)
        online = None if robot is None or run.evaluation.arbitrary_frame else robot.online
        rows.append(
            (
                name,
                format_figure(None if of is None else of.per_dof, ".3f", ""),
                "–" if of is None else f"{int(of.dof.sum()):,}",
                format_figure(cost.get(name), ".3f", ""),
                format_figure(scale.get(name), ".2f", ""),
                OUTSIDE
                if robot is not None and robot.outside
                else format_figure(None if online is None else online.nees_per_dof, ".3g", ""),
                format_figure(None if online is None else online.coverage, ".0%", ""),
            )
        )
    filled = [row for row in rows if any(cell != "–" for cell in row[1:])]
    if not filled and "consistency" not in pictures:
        return []
    headings = (
        "robot",
        "NIS\n/dof",
        "its\ndof",
        "joint cost\n/dof",
        "covariance\nscale",
        "online\nNEES/dof",
        "in\n95 %",
    )
    return [*_sheet(Sheet(headings, filled, NIS_NOTE)), _image(pictures, "consistency")]


def _paths(run: Run) -> list[str]:
    arbitrary = run.evaluation.arbitrary_frame
    sheet = path_sheet(run.evaluation)
    if all(cell in {"–", OUTSIDE} for row in sheet.rows for cell in row[1:]):
        return []
    absolute = [
        (
            name, kind, f"{errors.poses:,}",
            format_figure(None if arbitrary else errors.ape_m, ".3f", ""),
            format_figure(errors.ape_aligned_m, ".3f", ""),
            _degrees(errors.ape_aligned_rad), format_figure(errors.rpe_m, ".3f", ""),
            _degrees(errors.rpe_rad),
        )
        for name, of in run.trajectories().items()
        for kind, errors in of.items()
    ]  # fmt: skip
    headings = (
        "robot", "path", "poses", "APE\n[m]", "APE by\nitself [m]", "APE by\nitself [°]",
        "RPE\n[m]",        "RPE\n[°]",
    )  # fmt: skip
    note = (
        "RMS with evo's definitions; by itself: after the rigid motion that aligns this path, "
        "not the map; "
        "RPE: from pose to pose. The folder trajectories has the paths in TUM format: "
        "evo_ape tum r1.smoothed.truth.tum r1.smoothed.tum gives the same."
    )
    return [*_sheet(sheet), *_sheet(Sheet(headings, absolute, note))]


def _measurements(run: Run) -> list[str]:
    ledger = run.ledger
    if ledger is None:
        ledgers = {n: robot.consumption.ledger for n, robot in run.evaluation.robots.items()}
        tables = _sheet(disposition_sheet(ledgers)) if any(ledgers.values()) else []
        return [*tables, _note(f"As reported by the robots. The ledger: {run.no_ledger}.")]
    robots = in_order({robot for robot, _ in ledger.entries})
    used = sum(1 for maps in ledger.maps.values() if maps)
    kind, verdict = ("good", ledger.statement())
    if ledger.offenders:
        kind = "bad"
        verdict = f"{len(ledger.offenders)} offenders: {'; '.join(ledger.offenders[:5])}"
    return [
        f'<p class="{kind}">Ledger: {escape(verdict)}.</p>',
        *_sheet(disposition_sheet({robot: ledger.totals(robot) for robot in robots})),
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
    return [_table(("", "node", "event"), rows, words=True), left]


def _latency(run: Run) -> list[str]:
    latency = run.history.latencies
    if not latency:
        return []
    rows = []
    for name, of in latency.items():
        cells = [
            f"{_quantile(v, q):.3g}" for v in (of.last_s, of.first_s) for q in (0.5, 0.95, 1.0)
        ]
        rows.append((name, f"{len(of.last_s):,}", *cells))
    headings = (
        "robot", "submaps", "last\nmedian", "last\n95 %", "last\nmax", "first\nmedian",
        "first\n95 %", "first\nmax",
    )  # fmt: skip
    note = (
        "Wall time [s] from the publication of a submap's last and first measurement to that of "
        "the first map that used it, by the publishers' clocks."
    )
    return _sheet(Sheet(headings, rows, note))


def _traffic(run: Run) -> list[str]:
    span_s = (run.history.end_ns - run.history.start_ns) * 1e-9
    rows = [
        (key, f"{t.messages:,}", f"{t.bytes:,}", f"{t.bytes / span_s:,.1f}" if span_s > 0 else "–")
        for key, t in run.evaluation.channels.items()
    ]
    if not rows:
        return []
    table = _table(("key", "messages", "bytes", "B/s"), rows)
    summary = f"<summary>Every key ({len(rows)})</summary>"
    return [f"<details>{summary}{table}</details>"]


def _origin(run: Run) -> list[str]:
    """Log metadata; long values are collapsed."""
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
    except ValueError:
        return text


def _image(pictures: Mapping[str, Path], name: str, *, wide: bool = True) -> str:
    if name not in pictures:
        return ""
    data = base64.b64encode(pictures[name].read_bytes()).decode()
    kind = ' class="wide"' if wide else ""
    return f'<figure><img{kind} alt="{name}" src="data:image/png;base64,{data}"></figure>'


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _sheet(sheet: Sheet) -> list[str]:
    return [_table(sheet.headings, sheet.rows), *([_note(sheet.note)] if sheet.note else [])]


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, words: bool = False) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows
    )
    opening = '<table class="words">' if words else "<table>"
    return f"{opening}\n<tr>{head}</tr>\n{body}</table>" if head else f"{opening}\n{body}</table>"


def _quantile(values: Float[np.ndarray, " n"], share: float) -> float:
    return float(np.quantile(values, share))


def _degrees(angle_rad: float | None) -> str:
    return format_figure(None if angle_rad is None else degrees(angle_rad), ".2f", "")
