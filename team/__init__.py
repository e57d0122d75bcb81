"""What every robot carries (estimation, wire, recording) and the robot itself.

For programs of others `from team import …` gives the names of `team.library`, the estimators on
arrays, and `Driver`, which brings a robot onto a team. They are imported at their first use, so
that a process does not wait for what it does not need; type checkers read them in the stub beside
this file.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

_OF_DRIVER = ("Driver", "DriverError", "DriverWarning", "MeasurementError")
"""What a robot's own program imports: it needs no estimator."""


def __getattr__(name: str) -> Any:
    """A name of the library, at its first use; our modules are left to the import system.

    The library is no import statement here, or every study would count as made from it
    (`team.sources`).
    """
    if not name.startswith("_") and find_spec(f"{__name__}.{name}") is None:
        if name in _OF_DRIVER:
            return getattr(import_module(f"{__name__}.driver.driver"), name)
        library = import_module(f"{__name__}.library")
        if name in library.__all__:
            return getattr(library, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
