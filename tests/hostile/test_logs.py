import json
import subprocess
import sys

import pytest

from teamslam.team.recording import records
from teamslam.team.recording.reader import LogError, open_log
from tests.hostile.logs import KINDS, LARGEST_FILE, many_small
from tests.support import ROOT

MOST_MIB = 300
"""Growth of a process beyond what its imports take; the largest message alone has 64 MiB."""


def test_no_command_lets_a_small_file_take_much_memory_or_end_in_a_traceback(tmp_path):
    files = [kind(tmp_path / f"{kind.__name__}.mcap") for kind in KINDS]
    assert max(file.stat().st_size for file in files) <= LARGEST_FILE
    done = subprocess.run(
        [sys.executable, "-m", "tests.hostile.log_commands", str(tmp_path), *map(str, files)],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    found = json.loads(done.stdout.splitlines()[-1])
    assert len(found) == len(files)
    ends = {(log, name): row for log, rows in found.items() for name, row in rows.items()}
    assert {name: row for name, row in ends.items() if row[0] not in (0, 1, 2)} == {}
    growth: dict[str, float] = {
        log: sum(r[1] for r in rows.values()) for log, rows in found.items()
    }
    assert max(growth.values()) < MOST_MIB, growth
    refused = found["expands"]
    assert "which no recorder writes" in refused["check"][2]
    assert all(refused[n][0] == 2 for n in ("report", "rerun", "replay", "csv", "ledger", "view"))


def test_a_chunk_of_millions_of_records_is_refused_before_they_are_objects(tmp_path, monkeypatch):
    log = open_log(many_small(tmp_path / "log.mcap"))
    with pytest.raises(LogError, match="more than 250000 records"):
        list(log.samples())
    monkeypatch.setattr(records, "MOST_RECORDS", 1000)
    with pytest.raises(LogError, match="more than 1000 records"):
        list(log.samples())
