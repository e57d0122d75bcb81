"""Reports which kernels are being compiled: the first run on a machine takes a minute."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

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
def compilations(report: Callable[[int, int], None], of: int) -> Iterator[None]:
    """While the context lasts, calls `report` after each form of a kernel that is compiled: how
    many, of about `of`.
    """
    with install_listener("numba:compile", _Counted(report, of)):
        yield
