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
    print("ready", flush=True)
    input()
    print(kernel(10.0), sum(kernel.stats.cache_hits.values()))
"""


def computed(folder: Path, processes: int = 1) -> list[tuple[float, int]]:
    """What processes of their own compute at once, and how much of it was in the cache."""
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "kernels.outer"], cwd=folder, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": f"{folder}:{Path.cwd()}"},
        )
        for _ in range(processes)
    ]  # fmt: skip
    for process in started:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in started:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    told = [process.communicate()[0].split() for process in started]
    return sorted((float(value), int(hits)) for value, hits in told)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "inner.py").write_text(INNER.format("2.0"))
    (folder / "outer.py").write_text(OUTER)
    return folder


def test_a_kernel_is_compiled_once_and_anew_when_what_it_calls_has_changed(package: Path) -> None:
    both = computed(package.parent, processes=2)
    assert both == [(21.0, 0), (21.0, 1)], "who comes second waits for the first and takes its code"
    (package / "inner.py").write_text(INNER.format("3.0"))
    assert computed(package.parent) == [(31.0, 0)]
    (package / "inner.py").write_text(INNER.format("2.0"))
    assert computed(package.parent) == [(21.0, 1)], "the old program's code is still its own"


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
