"""Measure the latency from a submap's arrival to the maps and priors that contain it.

`python -m benchmarks.fresh [LOG…] [--json FILE]`, of logs of `launch`, or of a run of its own at
ten times real time. Wall time from each submap, without the last second's, to the first map and the
first prior of another robot. Limit: three times the round trip (median from a submap to the
centre's credit) plus the reported solution time.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baseline import conclude, parser_of
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import opened

CHANNELS = (ch.SUBMAP, ch.FUSED_MAP, ch.PRIOR, ch.CENTRAL_PROGRESS, ch.STATUS)
Submap = tuple[str, int, int]


def measure_latency(log: Path) -> dict[str, Any]:
    """Measure the seconds until the map and until a teammate's prior, round trip and
    solution time.
    """
    arrived: dict[Submap, float] = {}
    mapped: dict[Submap, float] = {}
    told: dict[Submap, float] = {}
    credit: dict[Submap, float] = {}
    solve_s: list[float] = []
    for sample in open_log(log).samples(CHANNELS):
        channel, name, message = opened(sample)
        at = sample.wall_ns * 1e-9
        match message:
            case m.Submap():
                arrived[message.robot, message.incarnation, message.sequence] = at
            case m.FusedMap():
                _first(mapped, arrived, message.members, at)
            case m.Prior():
                others = [each for each in message.members if each.robot != name]
                _first(told, arrived, others, at)
            case m.Progress() if channel is ch.CENTRAL_PROGRESS:
                key = message.robot, message.incarnation, message.submaps - 1
                credit.setdefault(key, at)
            case m.Status() if message.node == "central":
                solve_s += [v for k, v in message.figures.items() if k == "fresh_s"]
            case _:
                pass
    last = max(arrived.values(), default=0.0) - 1.0
    judged = [key for key, at in arrived.items() if at <= last and key in mapped]
    trips = [credit[key] - arrived[key] for key in judged if key in credit]
    trip_s = float(np.median(trips)) if trips else 0.0
    solving_s = float(np.median(solve_s)) if solve_s else 0.0
    waits = np.array([mapped[key] - arrived[key] for key in judged])
    priors = np.array([told[key] - arrived[key] for key in judged if key in told])
    bound_s = 3.0 * (trip_s + solving_s)
    return {
        "submaps": len(judged),
        "map_s": np.quantile(waits, (0.5, 0.95)).tolist(),
        "prior_s": np.quantile(priors, (0.5, 0.95)).tolist() if len(priors) else [],
        "round_trip_s": trip_s,
        "solve_s": solving_s,
        "within": float((waits <= bound_s).mean()) if bound_s else None,
        "ratio": float(np.median(waits) / (trip_s + solving_s)) if trip_s + solving_s else None,
    }


def _first(
    found: dict[Submap, float], arrived: dict[Submap, float], members: Any, at: float
) -> None:
    for each in members:
        sequence = each.sequence
        while sequence >= 0:
            key = each.robot, each.incarnation, sequence
            if key in found or key not in arrived:
                break
            found[key] = at
            sequence -= 1


def launch_run(folder: Path) -> Path:
    words = ["launch", "waypoints", "--speed", "10", "--no-report", "--no-views"]
    subprocess.run(
        [sys.executable, "-P", "-m", "teamslam", *words, "--output", str(folder)],
        check=True,
        stdout=sys.stderr,
    )
    return folder / "log.mcap"


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("logs", nargs="*", type=Path)
    told = parser.parse_args()
    if told.logs:
        return conclude({str(log): measure_latency(log) for log in told.logs}, None, told.json)
    with tempfile.TemporaryDirectory() as made:
        figures = measure_latency(launch_run(Path(made) / "run"))
    return conclude({name: figures[name] for name in ("ratio", "within")}, "fresh", told.json)


if __name__ == "__main__":
    sys.exit(main())
