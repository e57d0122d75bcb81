"""Compiled kernels that this process has called."""

import sys

import pytest
from numba.core.dispatcher import Dispatcher

OURS = ("team", "central", "sim")
AT_IMPORT = pytest.StashKey[list[str]]()
"""The kernels that were called before the first test."""


def called() -> list[str]:
    """The names of the kernels that have been compiled or loaded for some arguments."""
    return sorted(
        {
            f"{value.py_func.__module__}.{value.py_func.__qualname__}"
            for name, module in list(sys.modules.items())
            if name.partition(".")[0] in OURS
            for value in vars(module).values()
            if isinstance(value, Dispatcher) and value.signatures
        }
    )
