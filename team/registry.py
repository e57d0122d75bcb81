"""Load classes by the names in a table, so that their modules are optional."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any


class NotInstalledError(Exception):
    """The module of a comparison method is not installed."""


def is_installed(place: str) -> bool:
    """Return whether the module of `package.module:name` is installed, without importing it."""
    module = place.partition(":")[0]
    package, _, _ = module.rpartition(".")
    try:
        return find_spec(package) is not None and find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def absence(place: str, what: str) -> str | None:
    """Return the reason why `what` is not available; None: it is installed."""
    if is_installed(place):
        return None
    return f"{what} is not installed: {place.partition(':')[0]} is not here"


def load(place: str, what: str) -> Any:
    """Import `package.module:name`; raises NotInstalledError, which names `what`."""
    module, _, name = place.partition(":")
    absent = absence(place, what)
    if absent is not None:
        raise NotInstalledError(absent)
    return getattr(import_module(module), name)
