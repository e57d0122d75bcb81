"""Tables of a report, for terminal and page."""

from collections.abc import Mapping, Sequence
from math import degrees
from typing import NamedTuple

from rich import box
from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from teamslam.central.desk.evaluation.errors import MapErrors
from teamslam.central.desk.evaluation.evaluation import Evaluation, RobotResult
from teamslam.central.desk.names import OUTSIDE, not_joined, short
from teamslam.central.diagnosis import describe
from teamslam.team.config import MAP
from teamslam.team.wire import messages as m

ABSURD_NEES = 1000
"""NEES per degree of freedom above which words replace it."""
ARBITRARY = "–: no initial pose is known, the frame is arbitrary"
_COUNT_AGAIN = ("kalman", "kalman-per-axis")
LEFT = ("robot", "disposition")
"""Headings of text columns."""
Rows = Sequence[tuple[str, str]]


class Sheet(NamedTuple):
    """Table for terminal and page: headings, cells, note."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def summary_tables(evaluation: Evaluation) -> list[Table]:
    """Team figures and one row per robot, at most 80 columns wide."""
    team = Table(title=Text(title_of(evaluation)), show_header=False)
    for name, value in team_rows(evaluation):
        team.add_row(Text(name), Text(value))
    sheets = [robot_sheet(evaluation)]
    if not evaluation.peers and is_unfused(evaluation):
        sheets.append(own_sheet(evaluation))
    else:
        if any(robot.smoothed is not None for robot in evaluation.robots.values()):
            sheets.append(path_sheet(evaluation))
        if evaluation.peers:
            sheets.append(peer_sheet(evaluation))
    return [team, *map(terminal_table, sheets)]


def terminal_table(sheet: Sheet) -> Table:
    """Compact table; long cells wrap, since a truncated number is wrong."""
    table = Table(caption=sheet.note or None, box=box.SIMPLE, padding=(0, 1, 0, 0))
    for heading in sheet.headings:
        side: JustifyMethod = "left" if heading in LEFT else "right"
        table.add_column(Text(heading), justify=side, overflow="fold")
    for row in sheet.rows:
        table.add_row(*map(Text, row))
    return table


PEER_HEADINGS = ("robot", "final map", "set", "at [s]", "sent [B]", "received [B]", "star", "over")
PEER_NOTE = (
    "set: submaps of all robots; at: wall time of the final map; sent, received: bytes of "
    "the set's channels; star: those of its own submaps, as a centre would get them; over: members "
    "that came from each teammate, its own and those that it forwarded"
)


def peer_sheet(evaluation: Evaluation) -> Sheet:
    """SHA-256 of each robot's final map, its part of the set, and traffic."""
    rows: list[tuple[str, ...]] = []
    for name, peer in evaluation.peers.items():
        robot = evaluation.robots.get(name)
        star = None if robot is None else robot.uplink_bytes
        over = (
            f"{node.removeprefix('robot/')} {members}"
            for node, members in peer.over.items()
            if node.startswith("robot/") and node != f"robot/{name}"
        )
        sha256 = peer.final_map_sha256
        rows.append(
            (
                name,
                "none" if sha256 is None else sha256[:12],
                f"{peer.submaps}",
                format_figure(peer.complete_at_s, ".1f", ""),
                format_figure(peer.uplink, ",.0f", ""),
                format_figure(peer.downlink, ",.0f", ""),
                format_figure(star, ",.0f", ""),
                ", ".join(over),
            )
        )
    return Sheet(PEER_HEADINGS, rows, PEER_NOTE)


def title_of(evaluation: Evaluation) -> str:
    """Data set, or scenario and seed; then estimator and rule."""
    return ": ".join(filter(None, (evaluation.title, evaluation.method)))


def team_rows(evaluation: Evaluation) -> Rows:
    """Team figures: name and value."""
    fused = evaluation.map
    if fused is None:
        return [("final map", "none: the run did not finish")]
    errors, arbitrary = fused.errors, evaluation.arbitrary_frame
    states = state_rows(evaluation)
    if not len(fused.ids) and fused.reasons:
        return [("final map", f"empty: {'; '.join(fused.reasons)}"), *states]
    rows = [("landmarks", f"{len(fused.ids)} in the final map"), *states]
    if errors is None:
        rows.append(("landmark errors", f"can not be computed: {_without_truth(evaluation)}"))
    else:
        by = "" if fused.matching is None else f", {fused.matching.by}"
        rows += [] if fused.matching is None else [("landmark errors", f"by {fused.matching}")]
        rows += [
            ("landmark RMSE", ARBITRARY if arbitrary else f"{errors.rmse_m:.3f} m{by}"),
            ("after rigid alignment", format_figure(errors.aligned_rmse_m, ".3f", " m")),
        ]
        if not arbitrary:
            absurd = errors.nees_per_dof > ABSURD_NEES
            nees = _absurd(evaluation) if absurd else in_words(errors, joint=fused.joint)
            rows.append(("map NEES per dof", nees))
        shape = errors.shape
        if shape is not None:
            nees = f"{shape.nees_per_landmark / 2.0:.2f}; {shape.coverage:.0%} within 95 %"
            rows.append(("shape NEES per dof", nees))
        if not arbitrary:
            rows.append(("landmarks within 95 %", f"{errors.coverage:.0%}, as the map lies"))
    rows.append(("joint cost per dof", format_figure(fused.cost_per_dof, ".3f", "")))
    rows.append(("covariance scale", format_figure(fused.covariance_scale, ".2f", ", 1 is right")))
    rows += _association_rows(evaluation)
    rows += [("changes", change_words(fused.changes))] if fused.changes else []
    rows += [("joined", short(words)) for words in fused.joined]
    rows += [("cause of misfit", describe(each)) for each in fused.diagnosis]
    rows += [("note", words) for words in fused.reasons if not any(not_joined([words]))]
    rows += [("note", words) for words in evaluation.clocks]
    rows += [("verdict", words) for words in evaluation.verdicts]
    meetings = [t.messages for key, t in evaluation.channels.items() if key.endswith("/rendezvous")]
    if meetings:
        rows.append(("rendezvous", f"{sum(meetings)} times a robot sent what it held or was to"))
    rows.append(("final map, its set", f"{fused.digest}, frame {fused.frame or '–'}"))
    if evaluation.unsound:
        rows.append(("unsound messages", str(evaluation.unsound)))
    return rows


def _without_truth(evaluation: Evaluation) -> str:
    if evaluation.map is not None and evaluation.map.matching is not None:
        return str(evaluation.map.matching)
    if not len(evaluation.true_landmarks):
        return "no true landmarks"
    return "no true landmark can be matched to one of the map's"


def state_rows(evaluation: Evaluation) -> Rows:
    """State of every robot in the final map; joined robots share a row."""
    states = evaluation.states
    joined = [
        name for name, of in states.items() if of.state == "joined" and not name.startswith(MAP)
    ]
    rows = [("robots in the map", ", ".join(joined) or "none")] if states else []
    if any(of.state == "alone" for of in states.values()):
        rows = [("robots, each by itself", ", ".join(states))]
    return rows + [
        (of.state, f"{name}: {of.why}")
        for name, of in states.items()
        if of.state not in {"joined", "alone"}
    ]


CHANGES = ("moved", "gone", "new", "unchanged")
"""The states of landmarks against saved maps, as listed."""
LISTED = 5
"""Most landmarks of one state in a line of text."""


def change_words(changes: Sequence[m.LandmarkChange]) -> str:
    """Summarise what has changed since the saved maps: `1 moved (7: +0.50, -0.25 ± 0.02 m)`."""
    parts = []
    for state in CHANGES:
        found = [each for each in changes if each.state == state]
        if not found:
            continue
        words = [
            f"{each.landmark}: {each.dx:+.3f}, {each.dy:+.3f} ± {each.sigma:.3f} m"
            if state == "moved"
            else str(each.landmark)
            for each in found[:LISTED]
        ]
        more = ", …" * (len(found) > LISTED)
        listed = "" if state == "unchanged" else f" ({'; '.join(words)}{more})"
        parts.append(f"{len(found)} {state}{listed}")
    return ", ".join(parts)


def change_sheet(changes: Sequence[m.LandmarkChange]) -> Sheet:
    """Table of the landmarks that have changed since the saved maps."""
    rows = [
        (str(each.landmark), each.state)
        + (
            (f"{each.dx:+.3f}", f"{each.dy:+.3f}", f"{each.sigma:.3f}", f"{each.chi2:.1f}", "")
            if each.state == "moved"
            else ("", "", "", "", f"{each.expected:.1f}" if each.state == "gone" else "")
        )
        for state in CHANGES[:-1]
        for each in changes
        if each.state == state
    ]
    note = (
        "moved: a landmark that has not moved is listed with a probability of 0.001 (χ² of two "
        "degrees of freedom). gone: it would have been missed by chance with less than that."
    )
    headings = ("landmark", "state", "dx [m]", "dy [m]", "σ [m]", "χ²", "expected sightings")
    return Sheet(headings, rows, note)


def in_words(errors: MapErrors, *, joint: bool) -> str:
    """Map NEES and whether chance explains it; `joint`: of the joint covariance."""
    low, high = errors.band
    kind = "joint" if joint else "blocks only"
    band = f"95 % of {low:.2f}…{high:.2f} ({kind})"
    if errors.in_band:
        return f"{errors.nees_per_dof:.4g}, in {band}"
    if errors.nees_per_dof < low:
        return f"{errors.nees_per_dof:.4g}, below {band}: the covariance is too large"
    return (
        f"{errors.nees_per_dof:.4g}, above {band}. WARNING: the errors are larger than the "
        "covariance says; by chance that happens in one run of 40"
    )


def _association_rows(evaluation: Evaluation) -> Rows:
    """Association scores of a run with unnamed landmarks, given labels or GPS."""
    found, gps_m = evaluation.association, evaluation.gps_median_m
    rows = [] if gps_m is None else [("distance from GPS", f"{gps_m:.2f} m, median of the paths")]
    if found is None:
        return rows
    pairs = found.pairs
    precision, recall, f1, wrong = (
        format_figure(value, form, unit)
        for value, form, unit in (
            (pairs.precision, ".4f", ""),
            (pairs.recall, ".3f", ""),
            (pairs.f1, ".3f", ""),
            (pairs.wrong_percent, ".3f", " %"),
        )
    )
    scores = (
        f"precision {precision}, recall {recall}, F1 {f1}; {wrong} of the detections are in a "
        "wrong landmark"
    )
    many = found.merges_right + found.merges_wrong + found.merges_refused > 0
    merges = (
        f"{found.merges_right} right, {found.merges_wrong} wrong; {found.merges_refused} attempts "
        "wait"
    )
    return [
        *rows,
        ("association", scores),
        (
            "duplicates",
            f"{found.duplicates} of the {found.landmarks} landmarks that all submaps have, with "
            f"those left out of the map; {found.duplicates_confirmed} are of two submaps or more, "
            f"and the map shows {found.duplicates_shown}",
        ),
        *([("pairs of robots merged", merges)] if many else []),
    ]


def _absurd(evaluation: Evaluation) -> str:
    """Text that replaces a very large NEES, with the probable cause."""
    scenario = evaluation.scenario
    again = scenario is not None and scenario.fusion in _COUNT_AGAIN
    why = " (measurements counted again)" if again else ""
    return f"> {ABSURD_NEES}: over-confident{why}"


def _robot_note(evaluation: Evaluation) -> str:
    online = [r for r in evaluation.robots.values() if r.smoothed is None and r.online is not None]
    star = ", * of online ones" if online else ""
    frame = "; positions as aligned with the map" if evaluation.arbitrary_frame else ""
    words = (
        "a step is one odometry interval; measurements are odometry intervals, scans and "
        f"inter-robot measurements; errors of smoothed poses{star}{frame}"
    )
    left_out = [
        f"{name}: {robot.consumption.not_used}"
        for name, robot in evaluation.robots.items()
        if robot.consumption.not_used
    ]
    more = f"; … and {len(left_out) - NOTED} robots more" if len(left_out) > NOTED else ""
    return words + "".join(f"; {each}" for each in left_out[:NOTED]) + more


NOTED = 5
"""Most robots whose unused measurements are named below the table."""
ROBOT_HEADINGS = (
    "robot", "steps", "measure-\nments\nused", "sub-\nmaps", "position\nRMSE [m]",
    "heading\nRMSE [°]", "pose\nNEES/dof", "uplink\nB/step",
)  # fmt: skip


def robot_sheet(evaluation: Evaluation) -> Sheet:
    """Measurements and errors of each robot; in an arbitrary frame, aligned errors only."""
    arbitrary = evaluation.arbitrary_frame
    rows = [_robot_row(n, robot, arbitrary=arbitrary) for n, robot in evaluation.robots.items()]
    return Sheet(ROBOT_HEADINGS, rows, _robot_note(evaluation))


def _robot_row(name: str, robot: RobotResult, *, arbitrary: bool) -> tuple[str, ...]:
    used = robot.consumption
    errors, mark = (robot.online, "*") if robot.smoothed is None else (robot.smoothed, "")
    position = None if errors is None else errors.position_rmse_m
    if arbitrary:
        errors, mark, position = None, "", robot.aligned_rmse_m
    outside = robot.outside and not robot.smoothed_path.stamps_ns.size
    return (
        name,
        str(used.steps),
        f"{'–' if used.used is None else used.used} of {used.published}",
        str(used.submaps),
        OUTSIDE if outside else format_figure(position, ".3f", mark),
        format_figure(None if errors is None else degrees(errors.heading_rmse_rad), ".2f", mark),
        format_figure(None if errors is None else errors.nees_per_dof, ".3g", mark),
        format_figure(robot.uplink_bytes_per_step, ".1f", ""),
    )


PATH_HEADINGS = (
    "robot", "path\n[m]", "aligned\n[m]", "NEES\n/dof", "in\n95 %",
    "online\n[m]", "aligned\n[m]", "NEES\n/dof", "in\n95 %",
)  # fmt: skip
PATH_NOTE = (
    "position RMSE, smoothed and online; aligned: moved as the map is, or as all paths together "
    "where no true landmark is known"
)


def path_sheet(evaluation: Evaluation) -> Sheet:
    """Position errors, NEES and coverage of smoothed and online paths; in an arbitrary frame,
    aligned errors only.
    """
    arbitrary = evaluation.arbitrary_frame
    rows = [_path_row(n, robot, arbitrary=arbitrary) for n, robot in evaluation.robots.items()]
    return Sheet(PATH_HEADINGS, rows, PATH_NOTE)


def _path_row(name: str, robot: RobotResult, *, arbitrary: bool) -> tuple[str, ...]:
    cells = [name]
    for of, aligned, outside in (
        (robot.smoothed, robot.aligned_rmse_m, False),
        (robot.online, robot.online_aligned_rmse_m, robot.outside),
    ):
        errors = None if arbitrary else of
        cells += [
            OUTSIDE
            if outside
            else format_figure(None if errors is None else errors.position_rmse_m, ".3f", ""),
            format_figure(aligned, ".3f", ""),
            format_figure(None if errors is None else errors.nees_per_dof, ".3g", ""),
            format_figure(None if errors is None else errors.coverage, ".0%", ""),
        ]
    return tuple(cells)


OWN_HEADINGS = (
    "robot", "land-\nmarks", "RMSE\n[m]", "aligned\n[m]", "NEES\n/dof", "95 % of it", "in\n95 %",
)  # fmt: skip
OWN_NOTE = "each robot's own last map; aligned: moved rigidly onto the truth"


def is_unfused(evaluation: Evaluation) -> bool:
    """Whether each robot has its own map, without a fused one."""
    empty = evaluation.map is not None and not len(evaluation.map.ids)
    return empty and any(robot.own_map is not None for robot in evaluation.robots.values())


def own_sheet(evaluation: Evaluation) -> Sheet:
    """Errors, NEES with band, and coverage of every robot's own map."""
    rows = []
    for name, robot in evaluation.robots.items():
        own = robot.own_map
        if own is None:
            rows.append((name, *["–"] * (len(OWN_HEADINGS) - 1)))
            continue
        low, high = own.band
        rows.append(
            (
                name,
                str(own.count),
                f"{own.rmse_m:.3f}",
                format_figure(own.aligned_rmse_m, ".3f", ""),
                f"{own.nees_per_dof:.4g}",
                f"{low:.2f}…{high:.2f}",
                f"{own.coverage:.0%}",
            )
        )
    return Sheet(OWN_HEADINGS, rows, OWN_NOTE)


def disposition_sheet(ledgers: Mapping[str, Mapping[str, int]]) -> Sheet:
    """Measurements by disposition, one column per robot."""
    rows = []
    for disposition in sorted(set().union(*ledgers.values())):
        counts = [of.get(disposition, 0) for of in ledgers.values()]
        rows.append((disposition, *(f"{count:,}" for count in (*counts, sum(counts)))))
    return Sheet(("disposition", *ledgers, "all"), rows)


def format_figure(value: float | None, form: str, unit: str) -> str:
    """Format a number with its unit, or a dash."""
    return "–" if value is None else f"{value:{form}}{unit}"
