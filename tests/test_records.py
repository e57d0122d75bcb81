"""Records are built by name: a call says which argument is which."""

import ast
import inspect
from collections.abc import Iterator

import msgspec
import pytest

from team.wire import messages as m
from tests.support import ROOT

MOST = 7
"""Positional arguments of a call."""
FOLDERS = ("team", "central", "sim", "tests", "benchmarks", "examples")
COMPILED = (
    "add_sightings", "add_submaps", "agreement", "predictive_of_known", "left_out",
    "normal_equations", "step", "filter_step",
)  # fmt: skip
"""Compiled kernels and the steps of estimators, which share one order: state, motion, sensor, …"""
COMMANDS = ("_ip", "ip")
"""Their arguments are the words of a command line."""


def long_calls(folder: str) -> Iterator[str]:
    """The places in a folder where a call has more positional arguments than `MOST`."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        if path.stem.endswith("_kernel"):
            continue  # compiled: arrays in their order
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and len(node.args) > MOST:
                name = ast.unparse(node.func).rpartition(".")[2]
                if name not in (*COMPILED, *COMMANDS):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}: {name}, {len(node.args)}"


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_call_has_eight_positional_arguments(folder):
    assert list(long_calls(folder)) == []


def test_a_message_is_built_by_name_alone():
    records = [
        each
        for _, each in inspect.getmembers(m, inspect.isclass)
        if issubclass(each, msgspec.Struct) and each.__module__.startswith(m.__name__)
    ]
    assert len(records) > len(m.BY_TAG)
    for each in records:
        kinds = {p.kind for p in inspect.signature(each).parameters.values()}
        assert kinds == {inspect.Parameter.KEYWORD_ONLY}, each.__name__
