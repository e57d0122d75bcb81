"""Which kernels are being compiled: the first run on a machine takes a minute, and says so."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core.dispatcher import Dispatcher
from numba.core.event import Event, Listener, install_listener

from team.estimation.compiled import compiled

OURS = compiled.__module__.partition(".")[0]


class _Counted(Listener):
    """Counts what is compiled; what comes from the cache is not."""

    def __init__(self, told: Callable[[int, int], None], of: int) -> None:
        self._told, self._of, self._done = told, of, 0

    def on_start(self, event: Event) -> None:
        """Nothing is compiled yet."""

    def on_end(self, event: Event) -> None:
        """One more; what Numba compiles of its own is a part of ours."""
        if event.data["dispatcher"].py_func.__module__.startswith(f"{OURS}."):
            self._done += 1
            self._told(self._done, max(self._of, self._done))


@contextmanager
def compilations(told: Callable[[int, int], None]) -> Iterator[None]:
    """Meanwhile `told` is called after each kernel that was compiled: how many, of about how many.

    All kernels count that have been imported; some are for other estimators, some have two forms.
    """
    with install_listener("numba:compile", _Counted(told, _imported())):
        yield


def _imported() -> int:
    """How many kernels the imported modules of ours define."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith(f"{OURS}.")]
    return sum(
        isinstance(value, Dispatcher) and value.__module__ == module.__name__
        for module in modules
        for value in vars(module).values()
    )
