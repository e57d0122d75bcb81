"""A kernel's cached machine code is that of its sources, near and far."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from team.estimation.compiled import compiled, program_of

INNER = """
from team.estimation.compiled import compiled

@compiled
def inner(x: float) -> float:
    return {} * x
"""
OUTER = """
from team.estimation.compiled import compiled
from kernels.inner import inner

@compiled
def outer(x: float) -> float:
    return inner(x) + 1.0

if __name__ == "__main__":
    from kernels.outer import outer as kernel
    print(kernel(10.0), sum(kernel.stats.cache_hits.values()))
"""


def computed(folder: Path) -> tuple[float, int]:
    """What a process of its own computes, and how much of it was in the cache."""
    done = subprocess.run(
        [sys.executable, "-m", "kernels.outer"], cwd=folder, capture_output=True, text=True,
        check=True, env={**os.environ, "PYTHONPATH": f"{folder}:{Path.cwd()}"},
    )  # fmt: skip
    value, hits = done.stdout.split()
    return float(value), int(hits)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "inner.py").write_text(INNER.format("2.0"))
    (folder / "outer.py").write_text(OUTER)
    return folder


def test_a_kernel_is_compiled_once_and_anew_when_what_it_calls_has_changed(package: Path) -> None:
    assert computed(package.parent) == (21.0, 0)
    assert computed(package.parent) == (21.0, 1)
    (package / "inner.py").write_text(INNER.format("3.0"))
    assert computed(package.parent) == (31.0, 0)
    (package / "inner.py").write_text(INNER.format("2.0"))
    assert computed(package.parent) == (21.0, 1), "the old program's code is still its own"


def test_the_program_of_a_kernel_is_what_it_can_reach(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(package.parent)
    before = program_of("kernels.outer")
    program_of.cache_clear()
    assert program_of("kernels.outer") == before
    assert program_of("kernels.inner") != before


def test_without_numba_s_compiler_a_kernel_is_the_function_itself() -> None:
    code = "from team.estimation.geometry import wrapped; print(type(wrapped).__name__, wrapped(7))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )  # fmt: skip
    assert done.stdout.split()[0] == "function"
    assert compiled.__doc__
