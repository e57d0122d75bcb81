"""Run-time checks of types and shapes, which tests/conftest.py puts around functions on arrays.

Modules without arrays are left to mypy, which saves a sixth of a worker's start. An int passes for
a float, as in mypy. `Self` is not checked: beartype resolves it in decorated classes only.
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
    return [
        ".".join(("teamslam", *path.relative_to(ROOT).with_suffix("").parts))
        for package in ("team", "central", "sim")
        for path in sorted((ROOT / package).rglob("*.py"))
        if SHAPES.search(path.read_text("utf-8"))
    ]


def begin_test() -> None:
    _calls.clear()
    for function in _through:
        del function.__no_type_check__
    _through.clear()


def checked(function: F) -> Callable[..., object]:
    """Check a function's arguments and result, as often as CALLS allows.

    jaxtyping calls it twice for a function: for the arguments, and for the result with them. The
    check is built at the first call.
    """
    name = (function.__module__, function.__qualname__)
    check: Callable[..., object] | None = None

    def counted(*args: object, **kwargs: object) -> object:
        nonlocal check
        _calls[name] += 1
        if _calls[name] > 2 * CALLS:  # a nested function, which is not exempted
            return None
        if _calls[name] == 2 * CALLS:
            _let_through(*name)
        if check is None:
            check = beartype(function, conf=_CONFIGURATION)
        return check(*args, **kwargs)

    return counted


def _let_through(module: str, qualname: str) -> None:
    """Exempt a function from jaxtyping; a nested one is not found."""
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
