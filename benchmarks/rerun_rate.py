"""Measure the rate of `rerun --verify` against plain reading of a log.

    python -m benchmarks.rerun_rate LOG … [--json FILE]

Reports measurements per second, the multiple of real time, and the rate at which the mcap library
alone reads (one core each). Exit status 1 if a result differs or five robots are slower than 35 ×
real time.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from teamslam.central.desk.verification.verification import verify
from teamslam.team.recording.reader import LogError, open_log

LEAST = 35.0  # × real time for a team of five


def read_plainly(path: Path) -> tuple[int, float]:
    began = time.process_time()
    with path.open("rb") as file:
        count = sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))
    return count, time.process_time() - began


def figures(path: Path) -> dict[str, Any]:
    """Measure one log, in CPU time of this process."""
    log = open_log(path)
    messages, measurement_s = read_plainly(log.path)
    began = time.process_time()
    result = verify(log)
    rerun_s = time.process_time() - began
    return {
        "log": log.path.name,
        "team_time_s": result.span_s,
        "measurements": result.measurements,
        "verified": result.messages,
        "equal": result.first is None,
        "rerun_cpu_s": rerun_s,
        "times_real_time": result.span_s / rerun_s,
        "measurements_per_s": result.measurements / rerun_s,
        "plain_messages": messages,
        "plain_messages_per_s": messages / measurement_s,
        "share_of_plain": (result.measurements / rerun_s) / (messages / measurement_s),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    try:
        found = [figures(path) for path in told.logs]
    except LogError as error:
        parser.error(str(error))
    print(json.dumps(found, indent=1))
    if told.json:
        told.json.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(not f["equal"] or f["times_real_time"] < LEAST for f in found))


if __name__ == "__main__":
    sys.exit(main())
