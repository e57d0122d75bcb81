"""The checker of types and shapes that tests/conftest.py puts around every function of ours.

An int is taken where a float is announced, as mypy does. `Self` is not looked at: beartype knows it
in decorated classes only, and the import hook decorates their methods one by one.
"""

from collections.abc import Callable
from typing import Any, Self, TypeVar

from beartype import BeartypeConf, FrozenDict, beartype

F = TypeVar("F", bound=Callable[..., object])

_CONFIGURATION = BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict({Self: Any}))


def checked(function: F) -> F:
    """The function with its arguments and its result checked at every call."""
    return beartype(function, conf=_CONFIGURATION)
