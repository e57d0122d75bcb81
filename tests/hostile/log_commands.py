"""Every command that opens a log, in one process, on hostile logs: its memory.

    python -m tests.hostile.log_commands FOLDER LOG …

Prints a JSON table: log -> command -> [exit status, growth of the peak memory in MiB, last line].
"""

import json
import resource
import sys
from pathlib import Path

from click.testing import CliRunner

from teamslam.sim.cli.main import app
from teamslam.team.recording.reader import LogError
from teamslam.team.recording.recorder import RecorderError

COMMANDS = {
    "info": ["log", "info", "LOG"],
    "check": ["log", "check", "LOG"],
    "repair": ["repair", "LOG", "-o", "OUT/repaired.mcap"],
    "cut": ["log", "cut", "LOG", "--from", "0", "--to", "9", "-o", "OUT/cut.mcap"],
    "merge": ["log", "merge", "LOG", "LOG", "-o", "OUT/merged.mcap"],
    "csv": ["log", "export", "LOG", "-o", "OUT/csv"],
    "parquet": ["log", "export", "LOG", "-o", "OUT/parquet", "--format", "parquet"],
    "tum": ["log", "export", "LOG", "-o", "OUT/tum", "--format", "tum"],
    "utias": ["log", "export", "LOG", "-o", "OUT/utias", "--format", "utias"],
    "view": ["view", "LOG", "--export", "OUT/view.mcap"],
    "report": ["report", "LOG", "-o", "OUT/report"],
    "rerun": ["rerun", "LOG", "--verify"],
    "ledger": ["verify-ledger", "LOG"],
    "replay": ["replay", "LOG", "--speed", "max", "--listen", "tcp/127.0.0.1:0", "--wait", "0"],
}


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main(folder: str, *logs: str) -> None:
    import matplotlib.figure  # noqa: F401 - its memory is not the file's
    import pyarrow.parquet  # noqa: F401

    nothing = Path(folder) / "nothing.mcap"
    nothing.write_bytes(b"")
    for command in COMMANDS.values():
        _run(command, str(nothing), folder)
    found: dict[str, dict[str, list[object]]] = {}
    for log in logs:
        for name, command in COMMANDS.items():
            before = peak_mib()
            status, said = _run(command, log, f"{folder}/{Path(log).stem}")
            growth = round(peak_mib() - before, 1)
            found.setdefault(Path(log).stem, {})[name] = [status, growth, said]
    print(json.dumps(found))


def _run(command: list[str], log: str, folder: str) -> tuple[int, str]:
    Path(folder).mkdir(exist_ok=True)
    given = [each.replace("LOG", log).replace("OUT", folder) for each in command]
    done = CliRunner().invoke(app, given)
    if done.exception is None or isinstance(done.exception, SystemExit):
        return done.exit_code, (done.output.strip().splitlines() or [""])[-1]
    if isinstance(done.exception, LogError | RecorderError):
        return 2, str(done.exception)
    return 99, f"{type(done.exception).__name__}: {done.exception}"


if __name__ == "__main__":
    main(*sys.argv[1:])
