"""The recipes of docs/architecture.md, walked: one file and one row, nothing else."""

import subprocess
import sys
from pathlib import Path

from tests.support import ROOT


def test_a_rule_and_an_estimator_are_a_file_and_a_row_each_and_their_runs_verify(
    tmp_path: Path,
) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "tests.recipes.walk", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    assert said.returncode == 0, said.stderr[-2000:]
    first, second = said.stdout.splitlines()
    assert first.startswith("first-submaps"), first
    assert "'submap'" in first
    assert "'final_map': (1, 1)" in first
    assert second.startswith("alone 0 True"), second
    assert "'own_pose'" in second
