"""Finds classes by the name that a table gives them, so that modules can be left out of an
installation.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any


class NotInstalledError(Exception):
    """A method's module is missing: this installation goes without the methods for comparison."""


def is_installed(place: str) -> bool:
    """Whether the module of `package.module:name` is installed; nothing is imported."""
    module = place.partition(":")[0]
    package, _, _ = module.rpartition(".")
    try:
        return find_spec(package) is not None and find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def absence(place: str, what: str) -> str | None:
    """Why `what` is not available, in words; None if it is installed."""
    if is_installed(place):
        return None
    return f"{what} is not installed: {place.partition(':')[0]} is not here"


def loaded(place: str, what: str) -> Any:
    """The `name` of `package.module:name`. Raises NotInstalledError, whose text names
    `what`.
    """
    module, _, name = place.partition(":")
    absent = absence(place, what)
    if absent is not None:
        raise NotInstalledError(absent)
    return getattr(import_module(module), name)
