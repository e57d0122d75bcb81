"""Contents of a run's report, and its figures for JSON."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from teamslam.central.desk.evaluation.errors import TrajectoryErrors, trajectory_errors
from teamslam.central.desk.evaluation.evaluation import add_holes, evaluate_collected
from teamslam.central.desk.evaluation.history import History, HistoryReader
from teamslam.central.desk.evaluation.log import Collected
from teamslam.central.desk.evaluation.results import Evaluation
from teamslam.central.desk.export.take_home import TakenHome
from teamslam.central.desk.ledger import Ledger
from teamslam.central.desk.logged import read_logged
from teamslam.central.desk.paths import SmoothedPath
from teamslam.central.desk.peers_as_centre import PeersAsCentre
from teamslam.central.desk.verification.recorded import INPUTS, Recorded
from teamslam.team.recording.check import Holes
from teamslam.team.recording.reader import Log
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import row_of


class Reading(NamedTuple):
    """Contents of a log that one pass has read; is_whole: without holes."""

    evaluation: Evaluation
    history: History
    recorded: Recorded
    is_whole: bool = True


def read_samples(samples: Iterable[Sample]) -> Reading:
    """Read a run's samples in one pass."""
    collected, history, recorded = Collected(), HistoryReader(), Recorded()
    centre = PeersAsCentre()
    for each, as_centre in read_logged(samples, centre):
        collected.take(each, as_centre)
        history.take(each, as_centre)
        if row_of(each.sample.key) in INPUTS:
            recorded.take(each)
    collected.conclude(centre.agreement)
    return Reading(evaluate_collected(collected), history.history(), recorded)


def read_log(log: Log) -> Reading:
    """Read a log in one pass; its holes are notes of the evaluation. Raises LogError."""
    holes = Holes(log)
    reading = read_samples(holes.through(log.samples()))
    found = holes.findings()
    evaluation = add_holes(reading.evaluation, log, found)
    return reading._replace(evaluation=evaluation, is_whole=not found)


@dataclass(frozen=True)
class Run:
    """A run from its log; ledger: None without inputs (`no_ledger`)."""

    evaluation: Evaluation
    history: History
    provenance: Mapping[str, str]
    ledger: Ledger | None = None
    no_ledger: str = "not asked for; `teamslam verify-ledger LOG` proves it"
    taken_home: TakenHome = field(default_factory=TakenHome)
    command: str = ""

    @property
    def paths(self) -> Mapping[str, SmoothedPath]:
        """Smoothed paths by robot, if requested."""
        return self.taken_home.paths

    def trajectories(self) -> dict[str, dict[str, TrajectoryErrors]]:
        """Errors by robot and kind of path."""
        found: dict[str, dict[str, TrajectoryErrors]] = {}
        for name, robot in self.evaluation.robots.items():
            for kind, path in (("smoothed", robot.smoothed_path), ("online", robot.online_path)):
                errors = trajectory_errors(path, robot.truth)
                if errors is not None:
                    found.setdefault(name, {})[kind] = errors
        return found


def run_figures(run: Run) -> dict[str, Any]:
    """Figures that a report adds to an evaluation."""
    history, ledger = run.history, run.ledger
    span_s = (history.end_ns - history.start_ns) * 1e-9
    unplaced = {"ape_m": None, "ape_rad": None} if run.evaluation.arbitrary_frame else {}
    return {
        "team_start_s": history.start_ns * 1e-9,
        "team_time_s": span_s,
        "nis_per_dof": {robot: of.per_dof for robot, of in history.innovations.items()},
        "nis_dof": {robot: of.total_dof for robot, of in history.innovations.items()},
        "latency_s": {
            robot: {
                "last_measurement": _spread(of.last_s),
                "first_measurement": _spread(of.first_s),
            }
            for robot, of in history.latencies.items()
        },
        "bytes_per_s": {
            key: traffic.bytes / span_s if span_s > 0.0 else None
            for key, traffic in run.evaluation.channels.items()
        },
        "trajectories": {
            robot: {kind: asdict(errors) | unplaced for kind, errors in of.items()}
            for robot, of in run.trajectories().items()
        },
        "events": [
            {"team_time_s": s, "node": event.of, "kind": event.kind, "text": event.text}
            for event in history.events
            for s in ((event.stamp_ns - history.start_ns) * 1e-9,)
        ],
        "ledger": None
        if ledger is None
        else {
            "measurements": ledger.measurements,
            "dispositions": ledger.totals(),
            "offenders": list(ledger.offenders),
        },
        "provenance": dict(run.provenance),
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    median, most, largest = np.quantile(values, (0.5, 0.95, 1.0)).tolist()
    return {"median": median, "p95": most, "max": largest}
