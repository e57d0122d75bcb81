"""A kernel's cached machine code is that of its sources, near and far."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from team.estimation.cached_code import unpickled
from team.estimation.compiled import (
    CircularKernelsError,
    _CacheFile,
    _sources,
    compiled,
    program_of,
)

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
    """Run processes concurrently; return each result with its number of cache hits."""
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "kernels.outer"], cwd=folder, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={
                **os.environ, "PYTHONPATH": f"{folder}:{Path.cwd()}",
                "NUMBA_CACHE_DIR": str(folder / "cached"),
            },
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


SORTING = """
import sys
import numpy as np
from team.estimation.compiled import compiled

@compiled
def ascending(row):
    return np.sort(row)

@compiled
def places(row):
    return np.argsort(row)

@compiled
def _first(n):
    return n

@compiled
def _second(n):
    return n

@compiled
def _third(n):
    return n

if sys.argv[1:] == ["places"]:
    _first(1), _second(1), _third(1)
for kernel in sys.argv[1:]:
    print(*globals()[kernel](np.array([7, 5, 9, 6])), sep="", end=" ")
"""


def test_kernels_that_two_processes_compiled_do_not_share_parts_that_are_called_alike(
    tmp_path: Path,
) -> None:
    """Numba numbers the functions that it compiles within a process: of two numbered alike, one
    that sorts and one that orders, the linker took the first for both.
    """
    (tmp_path / "sorting.py").write_text(SORTING)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{Path.cwd()}"}
    said = [
        subprocess.run(
            [sys.executable, "-m", "sorting", *kernels], env=environment, cwd=tmp_path,
            capture_output=True, text=True, check=True,
        ).stdout.split()
        for kernels in (["ascending"], ["places"], ["ascending", "places"])
    ]  # fmt: skip
    assert said == [["5679"], ["1302"], ["5679", "1302"]]


def machine_code(file: Path) -> bool:
    """Test whether a cache file holds machine code rather than bit code."""
    with file.open("rb") as opened:
        (_, _, (code, bit_code)), *_ = unpickled(opened)
    assert bool(code) != bool(bit_code)
    return bool(code)


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
    forms = [
        (each.name.split(".")[1], machine_code(each)) for each in package.parent.rglob("*.nbc")
    ]
    assert sorted(forms) == [("inner", False), ("outer", False), ("outer", True)]
    (package / "inner.py").write_text(INNER.format("3.0"))
    assert computed(package.parent) == [(31.0, 0)]
    (package / "inner.py").write_text(INNER.format("2.0"))
    assert computed(package.parent) == [(21.0, 1)], "the old program's code is still its own"


FAR = """
from typing import NamedTuple
LIMIT = 1.0
class Pair(NamedTuple):
    a: int
    b: int
class Kind:
    pass
"""
REACHES = '''
import math
from team.estimation.compiled import compiled
from kernels import inner as module
from kernels.far import LIMIT, Kind, Pair
from kernels.inner import inner
from kernels.tables import UNUSED

@compiled
def through_a_name(x):
    return inner(x) + math.sin(x)

@compiled
def through_a_module(x):
    return module.inner(x)

@compiled
def constant(x):
    """What it does."""
    return x < LIMIT

@compiled
def of_a_record(x):
    return Pair(x, x)[0]

@compiled
def of_a_class(x):
    return Kind is None

@compiled
def alone(x):
    return [y * y for y in range(x)]
'''


def test_the_program_of_a_kernel_is_what_it_can_reach(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    sources = {
        "inner": INNER.format("2.0"),
        "far": FAR,
        "tables": "UNUSED = 1\n",
        "reaches": REACHES,
    }
    kernels = (
        "through_a_name",
        "through_a_module",
        "constant",
        "of_a_record",
        "of_a_class",
        "alone",
    )

    def programs(**changed: str) -> dict[str, str]:
        for name, text in {**sources, **changed}.items():
            (package / f"{name}.py").write_text(text)
        for name in [name for name in sys.modules if name.partition(".")[0] == "kernels"]:
            del sys.modules[name]
        program_of.cache_clear()
        _sources.cache_clear()
        importlib.invalidate_caches()
        module = importlib.import_module("kernels.reaches")
        return {name: program_of(getattr(module, name).py_func) for name in kernels}

    def moved(**changed: str) -> set[str]:
        now = programs(**changed)
        return {name for name in kernels if now[name] != before[name]}

    before = programs()
    assert moved() == set()
    called = {"through_a_name", "through_a_module", "of_a_class"}
    assert moved(inner=INNER.format("3.0")) == called
    assert moved(far=FAR.replace("1.0", "2.0")) == {"constant", "of_a_class"}
    assert moved(far=FAR.replace("    b: int", "    c: int")) == {"of_a_record", "of_a_class"}
    assert moved(tables="UNUSED = 2\n") == {"of_a_class"}
    assert moved(reaches=REACHES.replace("y * y", "y + y")) == {"alone", "of_a_class"}
    described_otherwise = "# a line more\n" + REACHES.replace("What it does", "What it is for")
    assert moved(reaches=described_otherwise) == {"of_a_class"}


def test_without_numba_s_compiler_a_kernel_is_the_function_itself() -> None:
    code = "from team.estimation.geometry import wrapped; print(type(wrapped).__name__, wrapped(7))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )  # fmt: skip
    assert done.stdout.split()[0] == "function"
    assert compiled.__doc__


CALLS = """
from team.estimation.compiled import compiled

@compiled
def factorial(n: int) -> int:
    return 1 if n < 2 else n * factorial(n - 1)

@compiled
def even(n: int) -> bool:
    return n == 0 or odd(n - 1)

@compiled
def odd(n: int) -> bool:
    return n != 0 and even(n - 1)
"""


def test_a_kernel_that_calls_itself_and_a_circle_of_kernels_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "calling_kernels.py").write_text(CALLS)
    module = importlib.import_module("calling_kernels")
    with pytest.raises(CircularKernelsError, match=r"kernels\.factorial -> .*factorial; make them"):
        program_of(module.factorial.py_func)
    with pytest.raises(CircularKernelsError, match=r"kernels\.even -> .*odd -> .*even; make them"):
        program_of(module.even.py_func)


def test_code_that_can_not_be_read_counts_as_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of machine code that was cut off, or that names a class that is gone: every call of
    the kernel failed until somebody removed the file.
    """
    module = ModuleType("names_in_kernels")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec("class Record: pass", vars(module))
    files = _CacheFile(str(tmp_path), "kernel", "program")
    files.save("form", module.Record)
    assert files.load("form") is module.Record
    (code,) = tmp_path.glob("*.nbc")
    whole = code.read_bytes()
    for damaged in (b"", whole[:-3], b"\0" * len(whole)):
        code.write_bytes(damaged)
        assert files.load("form") is None
    code.write_bytes(whole)
    del module.Record
    assert files.load("form") is None
