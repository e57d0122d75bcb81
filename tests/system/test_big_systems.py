import os
import subprocess
import sys

from tests.support import ROOT

DIGESTS = """
import hashlib
import numpy as np
from teamslam.team.core import Cholesky, Pattern

n, root = 700, 600
tied = np.ones((n, n), dtype=bool)
tied[root:, 560:root] = False
columns = [np.append(j, j + 1 + np.flatnonzero(tied[j + 1 :, j])) for j in range(n)]
starts = np.cumsum([0, *(len(rows) for rows in columns)])
pattern = Pattern(np.ones(n, dtype=np.int64), starts, np.concatenate(columns))
values = np.random.default_rng(0).normal(size=len(pattern.rows))
values[starts[:-1]] = 1000.0
cholesky = Cholesky(pattern, values)
assert pattern.has_big_panel
solution = cholesky.solve(np.ones(n))
for found in (solution, cholesky.selected_inverse(), cholesky.inverse_block(np.arange(99))):
    print(hashlib.sha256(found.tobytes()).hexdigest())
"""


def digests() -> list[str]:
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    process = [sys.executable, "-c", DIGESTS]
    said = subprocess.run(
        process, cwd=ROOT, env={**os.environ, **one_thread}, capture_output=True, text=True
    )
    assert said.returncode == 0, said.stderr
    return said.stdout.split()


def test_two_processes_factor_and_invert_a_big_system_to_the_same_bits():
    first, second = digests(), digests()
    assert len(first) == 3
    assert first == second
