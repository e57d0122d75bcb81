"""Tables of a run, for terminal and page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from math import degrees
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from teamslam.central.desk.evaluation.association import AssociationResult
from teamslam.central.desk.evaluation.errors import MapErrors
from teamslam.central.desk.evaluation.results import Evaluation, RobotResult, figure
from teamslam.central.desk.ledger import Ledger
from teamslam.central.desk.names import OUTSIDE, in_order, not_joined, short
from teamslam.central.desk.report.run import Run
from teamslam.central.diagnosis import describe
from teamslam.team.config import MAP
from teamslam.team.estimation.contribution import named
from teamslam.team.wire import messages as m

ABSURD_NEES = 1000  # NEES per degree of freedom above which words replace it
ARBITRARY = "–: no initial pose is known, the frame is arbitrary"
DEGREES = degrees(1.0)
LEFT = ("robot", "disposition", "channel", "kind", "landmarks", "reason")
"""Headings of text columns."""
CHANGES = ("moved", "gone", "new", "unchanged")  # states of landmarks against saved maps, as listed
LISTED = 5  # most landmarks of one state in a line of text, and most robots named below a table
DECISIONS = 200  # most decisions in the table; report.json has all
NO_FIGURE = "–"
Rows = Sequence[tuple[str, str]]


class Sheet(NamedTuple):
    """Table for terminal and page: headings, cells, note."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


class Column(NamedTuple):
    """Heading, path of attributes or function, format, factor to the shown unit."""

    heading: str
    of: str | Callable[[Any], float | str | None]
    form: str = ""
    factor: float = 1
    unit: str = ""


def format_figure(value: float | str | None, form: str, unit: str = "", factor: float = 1) -> str:
    """Format a number with its unit; a dash for None."""
    if value is None or isinstance(value, str):
        return NO_FIGURE if value is None else value
    return f"{factor * value:{form}}{unit}"


def cells(of: object, columns: Sequence[Column]) -> tuple[str, ...]:
    """Format figures of an object in these columns."""
    return tuple(
        format_figure(
            figure(of, c.of) if isinstance(c.of, str) else c.of(of), c.form, c.unit, c.factor
        )
        for c in columns
    )


def _sheet(
    first: str, columns: Sequence[Column], rows: Iterable[tuple[str, object]], note: str = ""
) -> Sheet:
    headings = (first, *(column.heading for column in columns))
    return Sheet(headings, [(name, *cells(of, columns)) for name, of in rows], note)


def comparable(evaluation: Evaluation, robot: RobotResult) -> RobotResult:
    """Robot without errors that are meaningless in an arbitrary frame."""
    return replace(robot, smoothed=None, online=None) if evaluation.arbitrary_frame else robot


def summary_tables(evaluation: Evaluation) -> list[Table]:
    """Team figures and one row per robot, at most 80 columns wide."""
    team = Table(title=Text(title_of(evaluation)), show_header=False)
    for name, value in team_rows(evaluation):
        team.add_row(Text(name), Text(value))
    sheets = [robot_sheet(evaluation)]
    if not evaluation.peers and is_unfused(evaluation):
        sheets.append(own_sheet(evaluation))
    elif any(robot.smoothed is not None for robot in evaluation.robots.values()):
        sheets.append(path_sheet(evaluation))
    sheets += [peer_sheet(evaluation)] if evaluation.peers else []
    return [team, *map(terminal_table, sheets)]


def terminal_table(sheet: Sheet) -> Table:
    """Compact table with wrapped cells."""
    table = Table(
        caption=sheet.note or None, caption_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0)
    )
    for heading in sheet.headings:
        side: JustifyMethod = "left" if heading in LEFT else "right"
        table.add_column(Text(heading), justify=side, overflow="fold")
    for row in sheet.rows:
        table.add_row(*map(Text, row))
    return table


# The team's rows.


def title_of(evaluation: Evaluation) -> str:
    """Data set, or scenario and seed; then estimator and rule."""
    return ": ".join(filter(None, (evaluation.title, evaluation.method)))


def team_rows(evaluation: Evaluation) -> Rows:
    """Team figures: name and value."""
    fused = evaluation.map
    if fused is None:
        return [("final map", "none: the run did not finish")]
    if not len(fused.ids) and fused.reasons:
        return [("final map", f"empty: {'; '.join(fused.reasons)}"), *_state_rows(evaluation)]
    gone = sum(each.state == "gone" and each.landmark in fused.ids for each in fused.changes)
    of_them = f", {gone} of them gone" if gone else ""
    rows = [
        ("landmarks", f"{len(fused.ids)} in the final map{of_them}"),
        *_state_rows(evaluation),
        *_error_rows(evaluation, fused.errors),
        ("joint cost per dof", format_figure(fused.cost_per_dof, ".3f")),
        ("covariance scale", format_figure(fused.covariance_scale, ".2f", ", 1 is right")),
    ]
    if evaluation.gps_median_m is not None:
        rows.append(("distance from GPS", f"{evaluation.gps_median_m:.2f} m, median of the paths"))
    rows += [] if evaluation.association is None else _association_rows(evaluation.association)
    rows += [("changes", describe_changes(fused.changes))] if fused.changes else []
    rows += [("joined", short(words)) for words in fused.joined]
    rows += [("cause of misfit", describe(each)) for each in evaluation.diagnosis]
    joins = evaluation.scenario is not None and evaluation.scenario.fusion == "join"
    if joins and not evaluation.diagnosis:
        rows.append(("cause of misfit", "none found"))
    rows += [("note", words) for words in fused.reasons if not any(not_joined([words]))]
    rows += [("note", words) for words in evaluation.separate_times]
    rows += [("verdict", words) for words in evaluation.verdicts]
    meetings = [t.messages for key, t in evaluation.channels.items() if key.endswith("/rendezvous")]
    if meetings:
        rows.append(("rendezvous", f"{sum(meetings)} times a robot sent what it held or was to"))
    rows.append(("final map, its set", f"{fused.digest}, frame {fused.frame or '–'}"))
    return rows + ([("unsound messages", str(evaluation.unsound))] if evaluation.unsound else [])


def _error_rows(evaluation: Evaluation, errors: MapErrors | None) -> Rows:
    assert evaluation.map is not None
    matching, arbitrary = evaluation.map.matching, evaluation.arbitrary_frame
    if errors is None:
        why = "no true landmark can be matched to one of the map's"
        why = why if len(evaluation.true_landmarks) else "no true landmarks"
        why = why if matching is None else str(matching)
        return [("landmark errors", f"can not be computed: {why}")]
    by = "" if matching is None else f", {matching.by}"
    rows = [] if matching is None else [("landmark errors", f"by {matching}")]
    rows += [
        ("landmark RMSE", ARBITRARY if arbitrary else f"{errors.rmse_m:.3f} m{by}"),
        ("after rigid alignment", format_figure(errors.aligned_rmse_m, ".3f", " m")),
    ]
    if not arbitrary:
        rows.append(("map NEES per dof", _describe_nees(evaluation, errors)))
    if (shape := errors.shape) is not None:
        nees = f"{shape.nees_per_landmark / 2.0:.2f}; {100 * shape.coverage:.0f} % within 95 %"
        rows.append(("shape NEES per dof", nees))
    if not arbitrary:
        rows.append(("landmarks within 95 %", f"{100 * errors.coverage:.0f} %, as the map lies"))
    return rows


def _describe_nees(evaluation: Evaluation, errors: MapErrors) -> str:
    if errors.nees_per_dof > ABSURD_NEES:
        again = figure(evaluation, "scenario.fusion") in ("kalman", "kalman-per-axis")
        why = " (measurements counted again)" if again else ""
        return f"> {ABSURD_NEES}: over-confident{why}"
    kind = "joint" if figure(evaluation, "map.joint") else "blocks only"
    nees, band = f"{errors.nees_per_dof:.4g}", f"95 % of {errors.band_text} ({kind})"
    if errors.in_band:
        return f"{nees}, in {band}"
    if errors.nees_per_dof < errors.band[0]:
        return f"{nees}, below {band}: the covariance is too large"
    return (
        f"{nees}, above {band}. WARNING: the errors are larger than the covariance says; by chance "
        "that happens in one run of 40"
    )


def _state_rows(evaluation: Evaluation) -> Rows:
    states = evaluation.states
    joined = [n for n, of in states.items() if of.state == "joined" and not n.startswith(MAP)]
    rows = [("robots in the map", ", ".join(joined) or "none")] if states else []
    if any(of.state == "alone" for of in states.values()):
        rows = [("robots, each by itself", ", ".join(states))]
    apart = ((n, of) for n, of in states.items() if of.state not in {"joined", "alone"})
    return rows + [(of.state, f"{name}: {of.why}") for name, of in apart]


def describe_changes(changes: Sequence[m.LandmarkChange]) -> str:
    """Summarise changes since the saved maps, such as `1 moved (7: +0.50, -0.25 ± 0.02 m)`."""
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


def _association_rows(found: AssociationResult) -> Rows:
    precision, recall, f1, wrong = cells(found.pairs, _SCORE_IN_WORDS)
    rows = [
        (
            "association",
            f"precision {precision}, recall {recall}, F1 {f1}; {wrong} of the detections are in a "
            "wrong landmark",
        ),
        (
            "duplicates",
            f"{found.duplicates} of the {found.landmarks} landmarks that all submaps have, with "
            f"those left out of the map; {found.duplicates_confirmed} are of two submaps or more, "
            f"and the map shows {found.duplicates_shown}",
        ),
    ]
    if found.merges_right + found.merges_wrong + found.merges_refused:
        merges = (
            f"{found.merges_right} right, {found.merges_wrong} wrong; {found.merges_refused} "
            "attempts wait"
        )
        rows.append(("pairs of robots merged", merges))
    return rows


_SCORE_IN_WORDS = (
    Column("", "precision", ".4f"),
    Column("", "recall", ".3f"),
    Column("", "f1", ".3f"),
    Column("", "wrong_percent", ".3f", unit=" %"),
)

# The robots' sheets.


def _describe_relays(of: SimpleNamespace) -> str:
    own = f"robot/{of.name}"
    relays = ((n, k) for n, k in of.peer.over.items() if n.startswith("robot/") and n != own)
    return ", ".join(f"{node.removeprefix('robot/')} {members}" for node, members in relays)


_PEER = (
    Column("final map", lambda of: (of.peer.final_map_sha256 or "none")[:12]),
    Column("set", "peer.submaps"),
    Column("at [s]", "peer.complete_at_s", ".1f"),
    Column("sent [B]", "peer.uplink_bytes", ",.0f"),
    Column("received [B]", "peer.downlink_bytes", ",.0f"),
    Column("star", "robot.uplink_bytes", ",.0f"),
    Column("over", _describe_relays),
)
PEER_NOTE = (
    "set: submaps of all robots; at: wall time of the final map; sent, received: bytes of "
    "the set's channels; star: those of its own submaps, as a centre would get them; over: members "
    "that came from each teammate, its own and those that it forwarded"
)


def peer_sheet(evaluation: Evaluation) -> Sheet:
    """Each robot's final map, part of the set, and traffic."""
    robots = evaluation.robots
    rows = (
        (name, SimpleNamespace(name=name, peer=peer, robot=robots.get(name)))
        for name, peer in evaluation.peers.items()
    )
    return _sheet("robot", _PEER, rows, PEER_NOTE)


ROBOT_HEADINGS = (
    "robot", "steps", "measure-\nments\nused", "sub-\nmaps", "position\nRMSE [m]",
    "heading\nRMSE [°]", "pose\nNEES/dof", "uplink\nB/step",
)  # fmt: skip


def robot_sheet(evaluation: Evaluation) -> Sheet:
    """Measurements and errors of each robot."""
    rows = []
    for name, robot in evaluation.robots.items():
        used, shown = robot.consumption, comparable(evaluation, robot)
        errors, mark = (shown.online, "*") if robot.smoothed is None else (shown.smoothed, "")
        mark = "" if evaluation.arbitrary_frame else mark
        position = figure(errors, "position_rmse_m")
        position = robot.aligned_rmse_m if evaluation.arbitrary_frame else position
        outside = robot.outside and not robot.smoothed_path.stamps_ns.size
        rows.append((
            name,
            str(used.steps),
            f"{'–' if used.used is None else used.used} of {used.published}",
            str(used.submaps),
            OUTSIDE if outside else format_figure(position, ".3f", mark),
            format_figure(figure(errors, "heading_rmse_rad"), ".2f", mark, DEGREES),
            format_figure(figure(errors, "nees_per_dof"), ".3g", mark),
            format_figure(robot.uplink_bytes_per_step, ".1f"),
        ))  # fmt: skip
    return Sheet(ROBOT_HEADINGS, rows, _robot_note(evaluation))


def _robot_note(evaluation: Evaluation) -> str:
    robots = evaluation.robots
    online = any(r.smoothed is None and r.online is not None for r in robots.values())
    left_out = [
        f"{n}: {r.consumption.not_used}" for n, r in robots.items() if r.consumption.not_used
    ]
    gated = {name: robot.consumption.gated for name, robot in robots.items()}
    most = sorted(filter(gated.get, gated), key=lambda name: -gated[name])
    listed = ", ".join(f"{name} {gated[name]:,}" for name in most[:LISTED])
    listed += ", …" * (len(most) > LISTED)
    parts = [
        "a step is one odometry interval; measurements are odometry intervals, scans and "
        "inter-robot measurements",
        f"errors of smoothed poses{', * of online ones' if online else ''}",
        *["positions as aligned with the map"] * evaluation.arbitrary_frame,
        *left_out[:LISTED],
        *[f"… and {len(left_out) - LISTED} robots more"] * (len(left_out) > LISTED),
        f"detections rejected as outliers: {listed or 'none'}",
    ]
    return "; ".join(parts)


_PATH = (
    Column("path\n[m]", "smoothed.position_rmse_m", ".3f"),
    Column("aligned\n[m]", "aligned_rmse_m", ".3f"),
    Column("NEES\n/dof", "smoothed.nees_per_dof", ".3g"),
    Column("in\n95 %", "smoothed.coverage", ".0%"),
    Column(
        "online\n[m]",
        lambda r: OUTSIDE if r.outside else figure(r, "online.position_rmse_m"),
        ".3f",
    ),
    Column("aligned\n[m]", "online_aligned_rmse_m", ".3f"),
    Column("NEES\n/dof", "online.nees_per_dof", ".3g"),
    Column("in\n95 %", "online.coverage", ".0%"),
)
PATH_NOTE = (
    "position RMSE, smoothed and online; aligned: after the rigid motion that aligns the map with "
    "the true landmarks, or all paths with the true ones where no true landmark is known"
)


def path_sheet(evaluation: Evaluation) -> Sheet:
    """Errors, NEES and coverage of paths."""
    rows = ((name, comparable(evaluation, robot)) for name, robot in evaluation.robots.items())
    return _sheet("robot", _PATH, rows, PATH_NOTE)


_OWN = (
    Column("land-\nmarks", "own_map.count"),
    Column("RMSE\n[m]", "own_map.rmse_m", ".3f"),
    Column("aligned\n[m]", "own_map.aligned_rmse_m", ".3f"),
    Column("NEES\n/dof", "own_map.nees_per_dof", ".4g"),
    Column("95 % of it", "own_map.band_text"),
    Column("in\n95 %", "own_map.coverage", ".0%"),
)


def is_unfused(evaluation: Evaluation) -> bool:
    """Whether each robot has its own map alone."""
    empty = evaluation.map is not None and not len(evaluation.map.ids)
    return empty and any(robot.own_map is not None for robot in evaluation.robots.values())


def own_sheet(evaluation: Evaluation) -> Sheet:
    """Errors, NEES and coverage of own maps."""
    note = "each robot's own last map; aligned: moved rigidly onto the truth"
    return _sheet("robot", _OWN, evaluation.robots.items(), note)


_CONSISTENCY = (
    Column("NIS\n/dof", "innovations.per_dof", ".3f"),
    Column("its\ndof", "innovations.total_dof", ","),
    Column("joint cost\n/dof", "cost", ".3f"),
    Column("covariance\nscale", "scale", ".2f"),
    Column(
        "online\nNEES/dof",
        lambda of: (
            OUTSIDE if figure(of, "robot.outside") else figure(of, "robot.online.nees_per_dof")
        ),
        ".3g",
    ),
    Column("in\n95 %", "robot.online.coverage", ".0%"),
)
NIS_NOTE = (
    "NIS lies below 1 where a robot's sensor is configured with errors that last within a window "
    "(range_white, bearing_white): the particles take every error for a new one."
)


def consistency_sheet(run: Run) -> Sheet:
    """NEES and coverage with truth, NIS and cost."""
    of, innovations = run.evaluation, run.history.innovations
    rows = []
    for name in in_order(of.robots.keys() | innovations.keys() | of.cost_by_robot.keys()):
        robot = of.robots.get(name)
        row = SimpleNamespace(
            innovations=innovations.get(name),
            cost=of.cost_by_robot.get(name),
            scale=of.scale_by_robot.get(name),
            robot=robot and comparable(of, robot),
        )
        rows.append((name, row))
    whole = _sheet("robot", _CONSISTENCY, rows, NIS_NOTE)
    return whole._replace(rows=[row for row in whole.rows if {*row[1:]} != {"–"}])


_APE = (
    Column("path", "kind"),
    Column("poses", "of.poses", ","),
    Column("APE\n[m]", "of.ape_m", ".3f"),
    Column("APE by\nitself [m]", "of.ape_aligned_m", ".3f"),
    Column("APE by\nitself [°]", "of.ape_aligned_rad", ".2f", DEGREES),
    Column("RPE\n[m]", "of.rpe_m", ".3f"),
    Column("RPE\n[°]", "of.rpe_rad", ".2f", DEGREES),
)
APE_NOTE = (
    "RMS with evo's definitions; by itself: after the rigid motion that aligns this path, not the "
    "map; RPE: from pose to pose. The folder trajectories has the paths in TUM format: "
    "`evo_ape tum r1.smoothed.truth.tum r1.smoothed.tum` gives the same."
)


def ape_sheet(run: Run) -> Sheet:
    """Absolute and relative errors of every path."""
    unplaced: dict[str, Any] = {"ape_m": None} if run.evaluation.arbitrary_frame else {}
    rows = (
        (name, SimpleNamespace(kind=kind, of=replace(errors, **unplaced)))
        for name, of in run.trajectories().items()
        for kind, errors in of.items()
    )
    return _sheet("robot", _APE, rows, APE_NOTE)


def _quantile_of(name: str, q: float) -> Callable[[Any], float]:
    return lambda of: float(np.quantile(getattr(of, name), q))


_LATENCY = (
    Column("submaps", lambda of: len(of.last_s), ","),
    *(
        Column(f"{which}\n{name}", _quantile_of(f"{which}_s", q), ".3g")
        for which in ("last", "first")
        for name, q in (("median", 0.5), ("95 %", 0.95), ("max", 1.0))
    ),
)
LATENCY_NOTE = (
    "Wall time [s] from the publication of a submap's last and first measurement to that of "
    "the first map that used it, by the publishers' clocks."
)


def latency_sheet(run: Run) -> Sheet:
    """Quantiles of each robot's latencies."""
    return _sheet("robot", _LATENCY, run.history.latencies.items(), LATENCY_NOTE)


# Measurements, landmarks, traffic, processes.


def disposition_sheet(ledgers: Mapping[str, Mapping[str, int]]) -> Sheet:
    """Measurements by disposition, one column per robot."""
    rows = []
    for disposition in sorted(set().union(*ledgers.values())):
        counts = [of.get(disposition, 0) for of in ledgers.values()]
        rows.append((disposition, *(f"{count:,}" for count in (*counts, sum(counts)))))
    return Sheet(("disposition", *ledgers, "all"), rows)


_REJECTED = (
    Column("number", "number"),
    Column("stamp [s]", "stamp_s", ".3f"),
    Column("kind", "kind"),
    Column("landmarks", lambda each: " ".join((*map(str, each.landmarks), *each.teammates))),
    Column("reason", "reason"),
)
_OUTLIERS = (
    Column("submap", "submap"),
    Column("from [s]", "start_s", ".3f"),
    Column("to [s]", "stamp_s", ".3f"),
    Column("outliers", "detections"),
)


def rejection_sheets(ledger: Ledger) -> tuple[Sheet, Sheet]:
    """Rejected measurements, and detections rejected as outliers."""
    rejected, outliers = (
        ((short(named((each.robot, each.incarnation))), each) for each in of)
        for of in (ledger.rejected, ledger.outliers)
    )
    return _sheet("robot", _REJECTED, rejected), _sheet("robot", _OUTLIERS, outliers)


def _only_if(state: str, name: str) -> Callable[[Any], float | str]:
    return lambda change: getattr(change, name) if change.state == state else ""


_CHANGE = (
    Column("state", "state"),
    Column("dx [m]", _only_if("moved", "dx"), "+.3f"),
    Column("dy [m]", _only_if("moved", "dy"), "+.3f"),
    Column("σ [m]", _only_if("moved", "sigma"), ".3f"),
    Column("χ²", _only_if("moved", "chi2"), ".1f"),
    Column("expected sightings", _only_if("gone", "expected"), ".1f"),
)
CHANGE_NOTE = (
    "moved: a landmark that has not moved is listed with a probability of 0.001 (χ² of two "
    "degrees of freedom). gone: it would have been missed by chance with less than that."
)


def change_sheet(changes: Sequence[m.LandmarkChange]) -> Sheet:
    """Landmarks that have changed since the saved maps."""
    of = ((str(e.landmark), e) for state in CHANGES[:-1] for e in changes if e.state == state)
    return _sheet("landmark", _CHANGE, of, CHANGE_NOTE)


def traffic_sheet(run: Run) -> Sheet:
    """Messages, bytes and mean rate of every key."""
    span_s = (run.history.end_ns - run.history.start_ns) * 1e-9
    columns = (
        Column("messages", "messages", ","),
        Column("bytes", "bytes", ","),
        Column("B/s", lambda of: of.bytes / span_s if span_s > 0 else None, ",.1f"),
    )
    return _sheet("key", columns, run.evaluation.channels.items())


_PROCESS = (
    Column("CPU\n[s]", lambda took: took.get("cpu_s"), ".2f"),
    Column("peak RSS\n[MB]", lambda took: took.get("peak_rss_mb"), ".0f"),
    Column("PSS\n[MB]", lambda took: took.get("pss_mb"), ".0f"),
)
PSS_NOTE = (
    "RSS: resident memory, shared pages included. PSS at the end of the run: a page that n "
    "processes share counts 1/n in each."
)


def process_sheet(processes: Mapping[str, Mapping[str, float | None]]) -> Sheet:
    """Resources of each launched process."""
    return _sheet("process", _PROCESS, processes.items(), PSS_NOTE)


_SCORE = (
    Column("precision", "precision", ".5f"),
    Column("recall", "recall", ".4f"),
    Column("F1", "f1", ".4f"),
    Column("wrong\ndetections", "wrong_percent", ".3f", unit=" %"),
)


def score_sheet(found: AssociationResult) -> Sheet:
    """Scores of the association inside windows and over all."""
    note = (
        f"{found.landmarks} landmarks without names in all submaps, with those that the final map "
        "leaves out, that were given up, and that are of robots that are not joined; "
        f"{found.duplicates} of them are duplicates, "
        f"{found.duplicates_confirmed} among those of two submaps or more; pairs of robots that "
        f"share landmarks: {found.merges_right} rightly, {found.merges_wrong} wrongly; "
        f"{found.merges_refused} attempts wait. Scored by labels that no node receives."
    )
    rows = (("inside windows", found.inside), ("over all", found.pairs))
    return _sheet("pairs of detections", _SCORE, rows, note)


_DECISION = (
    Column("at [s]", "stamp_ns", ".1f", 1e-9),
    Column("pairs", "pairs"),
    Column("LLR", "llr", ".0f"),
    Column("absent", "absent"),
    Column("rival's\npairs", "rival_pairs"),
    Column("rival's\nevidence", "rival_llr", ".0f"),
    Column("share", "share", ".2f"),
    Column("sd [m]", "sd", ".2f"),
    Column("why", "why"),
)
DECISION_NOTE = (
    "LLR: log-likelihood ratio of the pairs; absent: landmarks that one side has where the other "
    "looked and has none, which speak against; share: of the landmarks there, matched ones. A "
    "decision that waits failed the named test; an undone one was reversed by a later one."
)


def decision_sheet(decisions: Sequence[m.AssociationDecision]) -> Sheet:
    """Closures and merges: newest first, then pending ones."""
    made = [each for each in decisions if each.kind != "waits"]
    waits = [each for each in decisions if each.kind == "waits"]
    shown = [*reversed(made), *waits][:DECISIONS]
    rows = ((f"{each.kind}: {each.about}", each) for each in shown)
    return _sheet("decision", _DECISION, rows, DECISION_NOTE)
