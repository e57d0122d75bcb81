import os
import subprocess
import sys

import pytest

from teamslam.sim.scenarios.scenario import load, with_options
from tests.scenarios import with_world
from tests.support import ROOT


def thesis(estimator, fusion, seed=1, steps=30):
    scenario = with_options(load("thesis"), seed=seed, estimator=estimator, fusion=fusion)
    return with_world(scenario, steps=steps)


WORLD = """
seed = 1
[world]
kind = "simulated"
size_m = 30.0
steps = 2
landmark_count = 260             # all seen at once: one panel of the centre is big enough for BLAS
speed_m_s = 1.0
visible_from_m = 0.5
visible_to_m = 60.0
[defaults.motion]
forward = { per_m = 0.05 }
turn = { per_s = 0.01, per_rad = 0.05 }
[defaults.sensor]
range_sigma = 0.1
bearing_sigma = 0.03
[defaults.front_end]
particles = 4
window_s = 1.0
[[robots]]
id = "r1"
[[robots]]
id = "r2"
"""
SCRIPT = """
import hashlib
import os
import sys
import numpy as np  # as NumPy comes, before any of our packages

numpys = len(os.listdir("/proc/self/task"))

from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire import channels as ch

team = load(sys.argv[1])
samples = list(run_team(team, streams_of(team)))
assert len(final_map(samples).ids) == 4 * 260
[final] = [sample.payload for sample in samples if sample.key == ch.FINAL_MAP.key()]
print(numpys, hashlib.sha256(final).hexdigest())
"""
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lists a process's threads")
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="BLAS has one thread on one core")
def test_a_script_that_loads_numpy_as_it_comes_gets_the_map_of_a_process_with_one_thread(tmp_path):
    (tmp_path / "wide.toml").write_text(WORLD)
    bare = {name: value for name, value in os.environ.items() if name not in THREADS}
    entries = [bare, bare | dict.fromkeys(THREADS, "1")]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(tmp_path / "wide.toml")],
            cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for env in entries
    ]  # fmt: skip
    said = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    (many, script), (one, ours) = (out.split() for out, _ in said)
    assert int(many) > 1, "the script had one thread from the start: nothing is compared"
    assert one == "1"
    assert script == ours
