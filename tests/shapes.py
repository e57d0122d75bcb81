"""The checker of types and shapes that tests/conftest.py puts around functions on arrays.

Modules without arrays are left to mypy: to wrap their functions takes a sixth of a worker's start.

An int is taken where a float is announced, as mypy does. `Self` is not looked at: beartype knows it
in decorated classes only, and the import hook decorates their methods one by one.
"""

import inspect
import re
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

from beartype import BeartypeConf, FrozenDict, beartype

F = TypeVar("F", bound=Callable[..., object])

CALLS = 5
"""Number of checked calls of each function in a test; the others run as in a program.

A check takes longer than most functions, and a test that calls one half a million times, with the
same shapes, learns nothing from the others.
"""
_CONFIGURATION = BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict({Self: Any}))
ROOT = Path(__file__).parents[1]
SHAPES = re.compile(r"\bshapes import\b|\bPose\b")
"""How a module names shapes: those of `team/shapes.py`, or the pose's."""
_calls: Counter[tuple[str, str]] = Counter()
_through: list[Any] = []


def modules_with_shapes() -> list[str]:
    """Names of the modules whose functions state shapes of arrays."""
    return [
        ".".join(("teamslam", *path.relative_to(ROOT).with_suffix("").parts))
        for package in ("team", "central", "sim")
        for path in sorted((ROOT / package).rglob("*.py"))
        if SHAPES.search(path.read_text("utf-8"))
    ]


def begin_test() -> None:
    """Every function is checked again."""
    _calls.clear()
    for function in _through:
        del function.__no_type_check__
    _through.clear()


def checked(function: F) -> Callable[..., object]:
    """The function with its arguments and its result checked, as far as CALLS goes.

    jaxtyping calls it twice for a function: for what checks the arguments, and for what checks the
    result with them. The check is made at the first call: no worker calls every function.
    """
    name = (function.__module__, function.__qualname__)
    check: Callable[..., object] | None = None

    def counted(*args: object, **kwargs: object) -> object:
        nonlocal check
        _calls[name] += 1
        if _calls[name] > 2 * CALLS:  # one within a function, which is not let through
            return None
        if _calls[name] == 2 * CALLS:
            _let_through(*name)
        if check is None:
            check = beartype(function, conf=_CONFIGURATION)
        return check(*args, **kwargs)

    return counted


def _let_through(module: str, qualname: str) -> None:
    """Mark a function as one that jaxtyping leaves alone; one within a function is not found."""
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = inspect.getattr_static(found, part, None)
    inner = found
    while inner is not None:
        found = inner
        kinds = ("__wrapped__", "__func__", "fget", "func")
        inner = next((getattr(found, k) for k in kinds if getattr(found, k, None)), None)
    if inspect.isfunction(found):
        found.__no_type_check__ = True
        _through.append(found)
