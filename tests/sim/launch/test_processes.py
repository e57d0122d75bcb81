"""The peak memory of a process."""

import subprocess
import sys

import pytest

from teamslam.sim.launch.processes import Process

BALLAST_BYTES = 200_000_000
WAITS = "print('ready', flush=True); input()"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a share of memory")
def test_the_peak_of_a_process_is_its_own_and_not_that_of_who_started_it() -> None:
    ballast = bytearray(b"x") * BALLAST_BYTES
    started = subprocess.Popen(
        [sys.executable, "-S", "-c", WAITS], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert started.stdin is not None
    assert started.stdout is not None
    with started.stdin, started.stdout:
        process = Process(started)
        assert started.stdout.readline() == b"ready\n"
        process.measure()
        started.stdin.write(b"\n")
    assert process.wait(20.0)
    assert len(ballast) == BALLAST_BYTES
    assert process.used.pss_mb is not None
    assert 1.0 < process.used.pss_mb < process.used.peak_rss_mb < 100.0
