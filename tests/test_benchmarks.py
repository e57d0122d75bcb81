"""Baselines of benchmarks are complete, and those that take seconds hold here."""

import shlex
import subprocess
import sys

import pytest

from benchmarks.baseline import Held, baselines, held
from tests.support import ROOT


def test_each_baseline_says_how_it_is_measured_and_what_may_be_worse() -> None:
    known = baselines()
    assert {"growth", "in_memory", "ratios", "recorder", "start"} <= set(known)
    for name, told in known.items():
        program = name.partition("-")[0]  # one program may have a second baseline: growth-large
        assert shlex.split(told["command"])[:3] == ["python", "-m", f"benchmarks.{program}"]
        assert (ROOT / "benchmarks" / f"{program}.py").is_file()
        assert told["measured"]
        for of in told["figures"].values():
            assert set(of) == {"value", "better", "tolerance"}
            assert of["better"] in ("less", "more")


@pytest.mark.parametrize(
    ("better", "found", "expected"),
    [("less", 13.1, True), ("less", 12.9, False), ("more", 6.9, True), ("more", 7.1, False),
     ("less", float("nan"), True)],
)  # fmt: skip
def test_a_figure_is_worse_beyond_its_tolerance(better: str, found: float, expected: bool) -> None:
    baseline = {"figures": {"x": {"value": 10.0, "better": better, "tolerance": 0.3}}}
    (row,) = held({"x": found}, baseline)
    assert isinstance(row, Held)
    assert row.is_worse == expected


def test_the_ratios_of_seconds_hold() -> None:
    """In a process of its own: here every function's shapes are checked at its call."""
    command = [sys.executable, "-m", "benchmarks.ratios", "--rounds", "3"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
