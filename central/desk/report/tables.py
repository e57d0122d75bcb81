"""Tables of a run, for terminal and page."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import degrees
from typing import NamedTuple

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

ABSURD_NEES = 1000
"""NEES per degree of freedom above which words replace it."""
ARBITRARY = "–: no initial pose is known, the frame is arbitrary"
_COUNT_AGAIN = ("kalman", "kalman-per-axis")
LEFT = ("robot", "disposition", "channel", "kind", "landmarks", "reason")
"""Headings of text columns."""
Rows = Sequence[tuple[str, str]]


class Sheet(NamedTuple):
    """Table for terminal and page: headings, cells, note."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


class Column(NamedTuple):
    """Column of figures: heading, path of attributes, format, factor to the shown unit."""

    heading: str
    path: str
    form: str
    factor: float = 1
    unit: str = ""


DEGREES = degrees(1.0)


def format_figure(value: float | str | None, form: str, unit: str = "", factor: float = 1) -> str:
    """Format a number with its unit; a dash for None."""
    if value is None or isinstance(value, str):
        return value or "–"
    return f"{factor * value:{form}}{unit}"


def cells(of: object, columns: Sequence[Column]) -> tuple[str, ...]:
    """Format figures of an object in these columns."""
    return tuple(format_figure(figure(of, c.path), c.form, c.unit, c.factor) for c in columns)


def headings(first: str, columns: Sequence[Column]) -> tuple[str, ...]:
    """Headings of these columns, behind a first one."""
    return (first, *(column.heading for column in columns))


def comparable(evaluation: Evaluation, robot: RobotResult) -> RobotResult:
    """Robot without the errors that are meaningless in an arbitrary frame."""
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


_PEER = (
    Column("set", "submaps", ""),
    Column("at [s]", "complete_at_s", ".1f"),
    Column("sent [B]", "uplink_bytes", ",.0f"),
    Column("received [B]", "downlink_bytes", ",.0f"),
)
PEER_NOTE = (
    "set: submaps of all robots; at: wall time of the final map; sent, received: bytes of "
    "the set's channels; star: those of its own submaps, as a centre would get them; over: members "
    "that came from each teammate, its own and those that it forwarded"
)


def peer_sheet(evaluation: Evaluation) -> Sheet:
    """Each robot's final map, part of the set, and traffic."""
    rows = []
    for name, peer in evaluation.peers.items():
        star = format_figure(figure(evaluation.robots.get(name), "uplink_bytes"), ",.0f")
        over = (
            f"{node.removeprefix('robot/')} {members}"
            for node, members in peer.over.items()
            if node.startswith("robot/") and node != f"robot/{name}"
        )
        sha256 = (peer.final_map_sha256 or "none")[:12]
        rows.append((name, sha256, *cells(peer, _PEER), star, ", ".join(over)))
    first, *rest = headings("robot", _PEER)
    return Sheet((first, "final map", *rest, "star", "over"), rows, PEER_NOTE)


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
    gone = sum(each.state == "gone" and each.landmark in fused.ids for each in fused.changes)
    of_them = f", {gone} of them gone" if gone else ""
    rows = [("landmarks", f"{len(fused.ids)} in the final map{of_them}"), *states]
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
            nees = _absurd(evaluation) if absurd else describe_nees(errors, joint=fused.joint)
            rows.append(("map NEES per dof", nees))
        shape = errors.shape
        if shape is not None:
            nees = f"{shape.nees_per_landmark / 2.0:.2f}; {100 * shape.coverage:.0f} % within 95 %"
            rows.append(("shape NEES per dof", nees))
        if not arbitrary:
            rows.append(
                ("landmarks within 95 %", f"{100 * errors.coverage:.0f} %, as the map lies")
            )
    rows.append(("joint cost per dof", format_figure(fused.cost_per_dof, ".3f")))
    rows.append(("covariance scale", format_figure(fused.covariance_scale, ".2f", ", 1 is right")))
    rows += _association_rows(evaluation)
    rows += [("changes", change_words(fused.changes))] if fused.changes else []
    rows += [("joined", short(words)) for words in fused.joined]
    if evaluation.diagnosis:
        rows += [("cause of misfit", describe(each)) for each in evaluation.diagnosis]
    elif evaluation.scenario is not None and evaluation.scenario.fusion == "join":
        rows.append(("cause of misfit", "none found"))
    rows += [("note", words) for words in fused.reasons if not any(not_joined([words]))]
    rows += [("note", words) for words in evaluation.separate_times]
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
    """State of every robot in the final map."""
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


def change_sheet(changes: Sequence[m.LandmarkChange]) -> Sheet:
    """Landmarks that have changed since the saved maps."""
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


def describe_nees(errors: MapErrors, *, joint: bool) -> str:
    """Describe the map NEES and whether chance explains it; joint: of the joint covariance."""
    kind = "joint" if joint else "blocks only"
    band = f"95 % of {errors.band_text} ({kind})"
    if errors.in_band:
        return f"{errors.nees_per_dof:.4g}, in {band}"
    if errors.nees_per_dof < errors.band[0]:
        return f"{errors.nees_per_dof:.4g}, below {band}: the covariance is too large"
    return (
        f"{errors.nees_per_dof:.4g}, above {band}. WARNING: the errors are larger than the "
        "covariance says; by chance that happens in one run of 40"
    )


def _association_rows(evaluation: Evaluation) -> Rows:
    found, gps_m = evaluation.association, evaluation.gps_median_m
    rows = [] if gps_m is None else [("distance from GPS", f"{gps_m:.2f} m, median of the paths")]
    if found is None:
        return rows
    pairs = found.pairs
    recall, f1 = (format_figure(each, ".3f") for each in (pairs.recall, pairs.f1))
    precision = format_figure(pairs.precision, ".4f")
    wrong = format_figure(pairs.wrong_percent, ".3f", " %")
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
    return (
        words
        + "".join(f"; {each}" for each in left_out[:NOTED])
        + more
        + _describe_gated(evaluation)
    )


def _describe_gated(evaluation: Evaluation) -> str:
    counts = {name: robot.consumption.gated for name, robot in evaluation.robots.items()}
    most = sorted(filter(counts.get, counts), key=lambda name: -counts[name])
    listed = ", ".join(f"{name} {counts[name]:,}" for name in most[:NOTED])
    more = ", …" * (len(most) > NOTED)
    total = sum(counts.values())
    return f"; detections rejected as outliers: {f'{listed}{more}' if total else 'none'}"


NOTED = 5
"""Most robots named below the table."""
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


_PATH = (
    Column("path\n[m]", "smoothed.position_rmse_m", ".3f"),
    Column("aligned\n[m]", "aligned_rmse_m", ".3f"),
    Column("NEES\n/dof", "smoothed.nees_per_dof", ".3g"),
    Column("in\n95 %", "smoothed.coverage", ".0%"),
    Column("online\n[m]", "online.position_rmse_m", ".3f"),
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
    rows = []
    for name, robot in evaluation.robots.items():
        row = [name, *cells(comparable(evaluation, robot), _PATH)]
        row[5] = OUTSIDE if robot.outside else row[5]
        rows.append(row)
    return Sheet(headings("robot", _PATH), rows, PATH_NOTE)


_OWN = (
    Column("land-\nmarks", "own_map.count", ""),
    Column("RMSE\n[m]", "own_map.rmse_m", ".3f"),
    Column("aligned\n[m]", "own_map.aligned_rmse_m", ".3f"),
    Column("NEES\n/dof", "own_map.nees_per_dof", ".4g"),
    Column("95 % of it", "own_map.band_text", ""),
    Column("in\n95 %", "own_map.coverage", ".0%"),
)
OWN_NOTE = "each robot's own last map; aligned: moved rigidly onto the truth"


def is_unfused(evaluation: Evaluation) -> bool:
    """Whether each robot has its own map, without a fused one."""
    empty = evaluation.map is not None and not len(evaluation.map.ids)
    return empty and any(robot.own_map is not None for robot in evaluation.robots.values())


def own_sheet(evaluation: Evaluation) -> Sheet:
    """Errors, NEES and coverage of every robot's own map."""
    rows = [(name, *cells(robot, _OWN)) for name, robot in evaluation.robots.items()]
    return Sheet(headings("robot", _OWN), rows, OWN_NOTE)


def disposition_sheet(ledgers: Mapping[str, Mapping[str, int]]) -> Sheet:
    """Measurements by disposition, one column per robot."""
    rows = []
    for disposition in sorted(set().union(*ledgers.values())):
        counts = [of.get(disposition, 0) for of in ledgers.values()]
        rows.append((disposition, *(f"{count:,}" for count in (*counts, sum(counts)))))
    return Sheet(("disposition", *ledgers, "all"), rows)


def rejected_sheet(ledger: Ledger) -> Sheet:
    """Each rejected measurement of a ledger with its reason."""
    rows = [
        (
            short(named((each.robot, each.incarnation))),
            str(each.number),
            f"{each.stamp_s:.3f}",
            each.kind,
            " ".join((*map(str, each.landmarks), *each.teammates)),
            each.reason,
        )
        for each in ledger.rejected
    ]
    return Sheet(("robot", "number", "stamp [s]", "kind", "landmarks", "reason"), rows)


def outlier_sheet(ledger: Ledger) -> Sheet:
    """Detections that windows rejected as outliers, by submap."""
    rows = [
        (
            short(named((each.robot, each.incarnation))),
            str(each.submap),
            f"{each.start_s:.3f}",
            f"{each.stamp_s:.3f}",
            str(each.detections),
        )
        for each in ledger.outliers
    ]
    return Sheet(("robot", "submap", "from [s]", "to [s]", "outliers"), rows)


NIS_NOTE = (
    "NIS lies below 1 where a robot's sensor is configured with errors that last within a window "
    "(range_white, bearing_white): the particles take every error for a new one."
)
_NIS = (Column("NIS\n/dof", "per_dof", ".3f"), Column("its\ndof", "total_dof", ","))
_ONLINE = (
    Column("online\nNEES/dof", "online.nees_per_dof", ".3g"),
    Column("in\n95 %", "online.coverage", ".0%"),
)


def consistency_sheet(run: Run) -> Sheet:
    """Consistency: NEES and coverage with truth, else NIS and cost."""
    evaluation, innovations = run.evaluation, run.history.innovations
    cost, scale = evaluation.cost_by_robot, evaluation.scale_by_robot
    rows = []
    for name in in_order(evaluation.robots.keys() | innovations.keys() | cost.keys()):
        robot = evaluation.robots.get(name)
        online = [*cells(robot and comparable(evaluation, robot), _ONLINE)]
        online[0] = OUTSIDE if robot is not None and robot.outside else online[0]
        of_map = format_figure(cost.get(name), ".3f"), format_figure(scale.get(name), ".2f")
        rows.append((name, *cells(innovations.get(name), _NIS), *of_map, *online))
    columns = headings("robot", _NIS)
    of_map = "joint cost\n/dof", "covariance\nscale"
    filled = [row for row in rows if any(cell != "–" for cell in row[1:])]
    return Sheet((*columns, *of_map, *(each.heading for each in _ONLINE)), filled, NIS_NOTE)


_APE = (
    Column("poses", "poses", ","),
    Column("APE\n[m]", "ape_m", ".3f"),
    Column("APE by\nitself [m]", "ape_aligned_m", ".3f"),
    Column("APE by\nitself [°]", "ape_aligned_rad", ".2f", DEGREES),
    Column("RPE\n[m]", "rpe_m", ".3f"),
    Column("RPE\n[°]", "rpe_rad", ".2f", DEGREES),
)
APE_NOTE = (
    "RMS with evo's definitions; by itself: after the rigid motion that aligns this path, not the "
    "map; RPE: from pose to pose. The folder trajectories has the paths in TUM format: "
    "`evo_ape tum r1.smoothed.truth.tum r1.smoothed.tum` gives the same."
)


def ape_sheet(run: Run) -> Sheet:
    """Absolute and relative errors of every path."""
    rows = [
        [name, kind, *cells(errors, _APE)]
        for name, of in run.trajectories().items()
        for kind, errors in of.items()
    ]
    for row in rows if run.evaluation.arbitrary_frame else ():
        row[3] = "–"
    return Sheet(("robot", *headings("path", _APE)), rows, APE_NOTE)


LATENCY_NOTE = (
    "Wall time [s] from the publication of a submap's last and first measurement to that of "
    "the first map that used it, by the publishers' clocks."
)


def latency_sheet(run: Run) -> Sheet:
    """Median, 95 % quantile and maximum of each robot's latencies."""
    rows = [
        (
            name,
            f"{len(of.last_s):,}",
            *(f"{np.quantile(v, q):.3g}" for v in (of.last_s, of.first_s) for q in (0.5, 0.95, 1)),
        )
        for name, of in run.history.latencies.items()
    ]
    columns = (f"{of}\n{which}" for of in ("last", "first") for which in ("median", "95 %", "max"))
    return Sheet(("robot", "submaps", *columns), rows, LATENCY_NOTE)


def traffic_sheet(run: Run) -> Sheet:
    """Messages, bytes and mean rate of every key."""
    span_s = (run.history.end_ns - run.history.start_ns) * 1e-9
    rows = [
        (key, f"{t.messages:,}", f"{t.bytes:,}", f"{t.bytes / span_s:,.1f}" if span_s > 0 else "–")
        for key, t in run.evaluation.channels.items()
    ]
    return Sheet(("key", "messages", "bytes", "B/s"), rows)


PSS_NOTE = (
    "RSS: resident memory, shared pages included. PSS at the end of the run: a page that n "
    "processes share counts 1/n in each."
)


def process_sheet(processes: Mapping[str, Mapping[str, float | None]]) -> Sheet:
    """Resources of each launched process."""
    rows = [
        (
            name,
            format_figure(took.get("cpu_s"), ".2f"),
            *(format_figure(took.get(memory), ".0f") for memory in ("peak_rss_mb", "pss_mb")),
        )
        for name, took in processes.items()
    ]
    return Sheet(("process", "CPU\n[s]", "peak RSS\n[MB]", "PSS\n[MB]"), rows, PSS_NOTE)


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
    rows = [
        (name, *cells(of, _SCORE))
        for name, of in (("inside windows", found.inside), ("over all", found.pairs))
    ]
    return Sheet(headings("pairs of detections", _SCORE), rows, note)


_DECISION = (
    Column("at [s]", "stamp_ns", ".1f", 1e-9),
    Column("pairs", "pairs", ""),
    Column("LLR", "llr", ".0f"),
    Column("absent", "absent", ""),
    Column("rival's\npairs", "rival_pairs", ""),
    Column("rival's\nevidence", "rival_llr", ".0f"),
    Column("share", "share", ".2f"),
    Column("sd [m]", "sd", ".2f"),
)
DECISION_NOTE = (
    "LLR: log-likelihood ratio of the pairs; absent: landmarks that one side has where the other "
    "looked and has none, which speak against; share: of the landmarks there, matched ones. A "
    "decision that waits failed the named test; an undone one was reversed by a later one."
)
DECISIONS = 200
"""Most decisions in the table; report.json has all."""


def decision_sheet(decisions: Sequence[m.AssociationDecision]) -> Sheet:
    """Closures and merges: newest first, then pending ones."""
    made = [each for each in decisions if each.kind != "waits"]
    waits = [each for each in decisions if each.kind == "waits"]
    rows = [
        (f"{each.kind}: {each.about}", *cells(each, _DECISION), each.why)
        for each in [*reversed(made), *waits][:DECISIONS]
    ]
    return Sheet((*headings("decision", _DECISION), "why"), rows, DECISION_NOTE)
