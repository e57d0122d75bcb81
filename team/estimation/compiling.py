"""Reports which kernels are being compiled: the first run on a machine takes a minute."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core.dispatcher import Dispatcher
from numba.core.event import Event, Listener, install_listener

from team.estimation.compiled import compiled

OURS = compiled.__module__.partition(".")[0]


class _Counted(Listener):
    """Counts compilations; kernels that come from the cache are not compiled."""

    def __init__(self, report: Callable[[int, int], None], of: int) -> None:
        self._report, self._of, self._done = report, of, 0

    def on_start(self, event: Event) -> None:
        """Does nothing: the compilation begins."""

    def on_end(self, event: Event) -> None:
        """Counts one more kernel; what Numba compiles of its own is a part of ours."""
        if event.data["dispatcher"].py_func.__module__.startswith(f"{OURS}."):
            self._done += 1
            self._report(self._done, max(self._of, self._done))


@contextmanager
def compilations(report: Callable[[int, int], None]) -> Iterator[None]:
    """While the context lasts, calls `report` after each compiled kernel: how many, of about how
    many.

    The total is the number of imported kernels; some of them belong to other estimators, some have
    two forms.
    """
    with install_listener("numba:compile", _Counted(report, _imported())):
        yield


def _imported() -> int:
    """Number of kernels that our imported modules define."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith(f"{OURS}.")]
    return sum(
        isinstance(value, Dispatcher) and value.__module__ == module.__name__
        for module in modules
        for value in vars(module).values()
    )
