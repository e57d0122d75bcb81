"""The report of a run: tables for a terminal, and a folder with pictures, JSON and one page."""

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from math import degrees
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from sim.evaluation import Evaluation, RobotResult
from sim.pictures import error_picture, map_picture

ABSURD_NEES = 1000
"""Beyond this a NEES per dof is over-confident by any measure."""
_COUNT_AGAIN = ("kalman", "kalman-per-axis")
Rows = Sequence[tuple[str, str]]

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto; }
th, td { text-align: right; padding: .25rem .7rem; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; }
"""


def summary_tables(evaluation: Evaluation) -> list[Table]:
    """The team's figures, and a row for each robot; 80 columns wide at the most."""
    team = Table(title=Text(_title(evaluation)), show_header=False)
    for name, value in _team_rows(evaluation):
        team.add_row(Text(name), Text(value))
    robots = Table(caption=_robot_note(evaluation))
    for heading in _ROBOT_HEADINGS:
        robots.add_column(Text(heading), justify="left" if heading == "robot" else "right")
    for name, robot in evaluation.robots.items():
        robots.add_row(*(Text(cell) for cell in _robot_row(name, robot)))
    if all(robot.smoothed is None for robot in evaluation.robots.values()):
        return [team, robots]
    paths = Table(caption=_PATH_NOTE)
    for heading in _PATH_HEADINGS:
        paths.add_column(Text(heading), justify="left" if heading == "robot" else "right")
    for name, robot in evaluation.robots.items():
        paths.add_row(*(Text(cell) for cell in _path_row(name, robot)))
    return [team, robots, paths]


def write_report(
    evaluation: Evaluation,
    directory: Path,
    provenance: Mapping[str, str],
    figures: Mapping[str, Any],
) -> list[Path]:
    """Write map.png, errors.png, report.json and report.html into the folder; what was written.

    provenance: what the log says of its origin. figures: as `to_json` gives them. A picture that
    has nothing to show is left out.
    """
    directory.mkdir(parents=True, exist_ok=True)
    pictures = [
        path
        for draw, path in (
            (map_picture, directory / "map.png"),
            (error_picture, directory / "errors.png"),
        )
        if draw(evaluation, path)
    ]
    data = directory / "report.json"
    data.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    page = directory / "report.html"
    page.write_text(_page(evaluation, pictures, provenance), encoding="utf-8")
    return [page, data, *pictures]


def _page(evaluation: Evaluation, pictures: Sequence[Path], provenance: Mapping[str, str]) -> str:
    title = escape(_title(evaluation))
    notes = [*evaluation.notes, *(() if evaluation.map is None else evaluation.map.reasons)]
    robots = [_robot_row(name, robot) for name, robot in evaluation.robots.items()]
    traffic = [(key, f"{t.messages:,}", f"{t.bytes:,}") for key, t in evaluation.channels.items()]
    parts = [
        f"<h1>{title}</h1>",
        _html_table((), _team_rows(evaluation)),
        *(f"<p>{_image(path)}</p>" for path in pictures),
        "<h2>Robots</h2>",
        _html_table(_ROBOT_HEADINGS, robots),
        f"<p>{_robot_note(evaluation)}</p>",
        "<h2>Paths against the truth</h2>",
        _html_table(_PATH_HEADINGS, [_path_row(n, r) for n, r in evaluation.robots.items()]),
        f"<p>{_PATH_NOTE}</p>",
        "<h2>What became of the readings</h2>",
        _html_table(("robot", "disposition", "readings"), _ledger_rows(evaluation)),
        *(f"<p>{escape(note)}</p>" for note in notes),
        "<h2>Traffic</h2>",
        _html_table(("key", "messages", "bytes"), traffic),
        "<h2>Origin</h2>",
        _html_table((), sorted(provenance.items())),
    ]
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f"<style>{_STYLE}</style>\n{body}\n</html>\n"
    )


def _image(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{escape(path.stem)}" src="data:image/png;base64,{data}">'


def _html_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows
    )
    return f"<table>\n<tr>{head}</tr>\n{body}</table>" if head else f"<table>\n{body}</table>"


def _title(evaluation: Evaluation) -> str:
    scenario = evaluation.scenario
    if scenario is None:
        return "a run whose scenario is not known"
    return f"{scenario.name}, seed {scenario.seed}: {scenario.estimator} + {scenario.fusion}"


def _team_rows(evaluation: Evaluation) -> Rows:
    fused = evaluation.map
    if fused is None:
        return [("final map", "none: the run did not come to its end")]
    errors = fused.errors
    rows = [("landmarks", str(len(fused.ids)))]
    if errors is None:
        rows.append(("landmark errors", "can not be computed: no true landmarks"))
    else:
        low, high = errors.band
        kind = "joint" if fused.joint else "blocks only"
        verdict = "in" if errors.in_band else "outside"
        rows += [
            ("landmark RMSE", f"{errors.rmse_m:.3f} m"),
            ("after rigid alignment", _shown(errors.aligned_rmse_m, ".3f", " m")),
            (
                "map NEES per dof",
                _absurd(evaluation)
                if errors.nees_per_dof > ABSURD_NEES
                else f"{errors.nees_per_dof:.4g}, {verdict} 95 % of {low:.2f}…{high:.2f} ({kind})",
            ),
        ]
        shape = errors.shape
        if shape is not None:
            nees = f"{shape.nees_per_landmark:.2f}, 2 is right; {shape.coverage:.0%} within 95 %"
            rows.append(("shape NEES/landmark", nees))
        rows.append(("landmarks within 95 %", f"{errors.coverage:.0%}, as the map lies"))
    rows.append(("joint cost per dof", _shown(fused.cost_per_dof, ".3f", "")))
    rows.append(("final map, its set", f"{fused.digest}, frame {fused.frame or '–'}"))
    if evaluation.unsound:
        rows.append(("unsound messages", str(evaluation.unsound)))
    return rows


def _absurd(evaluation: Evaluation) -> str:
    """The digits of a NEES of 1e18 say nothing to people; why it is so large does."""
    scenario = evaluation.scenario
    again = scenario is not None and scenario.fusion in _COUNT_AGAIN
    why = " (rule counts readings again)" if again else ""
    return f"> {ABSURD_NEES}: over-confident{why}"


def _robot_note(evaluation: Evaluation) -> str:
    online = [r for r in evaluation.robots.values() if r.smoothed is None and r.online is not None]
    star = ", * of online ones" if online else ""
    return f"a step is one odometry interval; errors of smoothed poses{star}"


_ROBOT_HEADINGS = (
    "robot", "steps", "readings\naccounted\nfor/sent", "sub-\nmaps", "position\nRMSE [m]",
    "heading\nRMSE [°]", "pose\nNEES/dof", "uplink\nB/step",
)  # fmt: skip


def _robot_row(name: str, robot: RobotResult) -> tuple[str, ...]:
    used = robot.consumption
    errors, mark = (robot.online, "*") if robot.smoothed is None else (robot.smoothed, "")
    readings = f"all {used.published}"
    if used.consumed != used.published:
        readings = f"{'–' if used.consumed is None else used.consumed}/{used.published}"
    return (
        name,
        str(used.steps),
        readings,
        str(used.submaps),
        _shown(None if errors is None else errors.position_rmse_m, ".3f", mark),
        _shown(None if errors is None else degrees(errors.heading_rmse_rad), ".2f", mark),
        _shown(None if errors is None else errors.nees_per_dof, ".3g", mark),
        _shown(robot.uplink_bytes_per_step, ".1f", ""),
    )


_PATH_HEADINGS = (
    "robot", "path\n[m]", "moved\n[m]", "NEES\n/dof", "in\n95 %",
    "online\n[m]", "moved\n[m]", "NEES\n/dof", "in\n95 %",
)  # fmt: skip
_PATH_NOTE = "position RMSE of the smoothed path and online; moved: as the map to align it"


def _path_row(name: str, robot: RobotResult) -> tuple[str, ...]:
    """Position errors, NEES and coverage of the smoothed and of the online path."""
    cells = [name]
    for errors, aligned in (
        (robot.smoothed, robot.aligned_rmse_m),
        (robot.online, robot.online_aligned_rmse_m),
    ):
        cells += [
            _shown(None if errors is None else errors.position_rmse_m, ".3f", ""),
            _shown(aligned, ".3f", ""),
            _shown(None if errors is None else errors.nees_per_dof, ".3g", ""),
            _shown(None if errors is None else errors.coverage, ".0%", ""),
        ]
    return tuple(cells)


def _ledger_rows(evaluation: Evaluation) -> list[tuple[str, str, str]]:
    return [
        (name, disposition, f"{readings:,}")
        for name, robot in evaluation.robots.items()
        for disposition, readings in robot.consumption.ledger.items()
    ]


def _shown(value: float | None, form: str, unit: str) -> str:
    return "–" if value is None else f"{value:{form}}{unit}"
