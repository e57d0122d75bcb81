"""The wrong changes themselves: which there are, that they are code, that they take effect."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from team.estimation import consistency, geometry
from tests.mutation.change import changed
from tests.mutation.mutants import mutants
from tests.mutation.table import MODULES

ROOT = Path(__file__).parents[2]
SOURCE = b'''"""A text with 1 number."""
LIMIT = 2.5


def f(x: int, \xce\xb8: float = 1.0) -> float:
    """3."""
    if x >= 2 and not x == 4:
        x -= 1
        print("7")
    return min(x,
               -\xce\xb8) + LIMIT
'''


def test_operators_comparisons_numbers_conditions_calls_and_statements_are_changed() -> None:
    found = {(each.where, each.old, each.new) for each in mutants(SOURCE)}
    assert found == {
        ("LIMIT", "2.5", "5.0"),
        ("f", ">=", ">"), ("f", ">=", "<"), ("f", "2", "3"), ("f", "and", "or"),
        ("f", "not ", ""), ("f", "==", "!="), ("f", "4", "5"), ("f", "x >= 2 and not x == 4",
        "not (x >= 2 and not x == 4)"),
        ("f", "x -= 1", "pass"), ("f", "-=", "+="), ("f", "1", "2"), ("f", 'print("7")', "pass"),
        ("f", "min", "max"), ("f", "-", "+"), ("f", "+", "-"),
    }  # fmt: skip


@pytest.mark.parametrize("module", MODULES)
def test_every_mutant_of_the_product_is_code_with_as_many_lines(module: str) -> None:
    count, tests = MODULES[module]
    source = (ROOT / module).read_bytes()
    found = mutants(source)
    assert 0 < count <= len(found)
    assert all((ROOT / "tests" / name).exists() for name in tests)
    for each in found[:: max(1, len(found) // 20)]:
        wrong = each.applied(source)
        assert wrong != source
        assert wrong.count(b"\n") == source.count(b"\n")
        compile(wrong, module, "exec")


def in_a_child(module: str, where: str, old: str, right: bool) -> bool:
    """Whether `right` differs once the mutant is in place there; this process stays as it is."""
    path = ROOT / module
    mutant = next(x for x in mutants(path.read_bytes()) if (x.where, x.old) == (where, old))
    child = os.fork()
    if not child:
        changed(path, mutant)
        os._exit(10 + _right())
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 10 + right


def _right() -> bool:
    error = consistency.state_error(np.array([3.0, 0.0, 7.0]), np.array([1.0, 0.0, 0.0]))
    return bool(np.allclose(error, [2.0, 0.0, 7.0 - 2.0 * np.pi])) and geometry.wrapped(4.0) < 0.0


def take_effect_in_the_child_alone() -> None:
    assert _right()
    assert in_a_child("team/estimation/consistency.py", "state_error", "-", right=False)
    assert in_a_child("team/estimation/geometry.py", "wrapped", "-", right=False)
    assert in_a_child("team/estimation/consistency.py", "coverage", "<=", right=True)
    assert _right()


def test_a_mutant_takes_effect_in_the_child_alone_in_kernels_too() -> None:
    """In a process of its own: a child of one with threads, as xdist's are, may never come back."""
    code = "from tests.mutation.test_mutants import take_effect_in_the_child_alone as do; do()"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
