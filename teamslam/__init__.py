"""Multi-robot SLAM as real processes over Zenoh.

`from teamslam import …` provides the estimators on arrays (`teamslam.team.library`), logs, and
`Driver`, which brings a robot onto a team. A name is imported at its first use, so that a process
loads only what it uses; type checkers read the stub beside this file.

The source tree keeps the parts in folders of their own, `team`, `central` and `sim`; a wheel has
them below this package.
"""

from importlib import import_module
from typing import Any

_DRIVER = "teamslam.team.driver.driver"
_OF_DRIVER = ("Driver", "DriverError", "DriverWarning", "MeasurementError")
_PARTS = ("team", "central", "sim")


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name in _OF_DRIVER:
        return getattr(import_module(_DRIVER), name)
    if not name.startswith("_") and name not in _PARTS:
        library = import_module("teamslam.team.library")
        if name in library.__all__:
            return getattr(library, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names."""
    return sorted([*_OF_DRIVER, *import_module("teamslam.team.library").__all__])
