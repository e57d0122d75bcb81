"""Processes that need the same kernel for the first time compile it once: the others wait for it.

Machine code is kept in files (`team.estimation.compiled`), but who looks there while another
process is at work on the same kernel finds nothing and does the same work again. On a computer
with two cores that is all that the second core then does.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core.compiler_lock import global_compiler_lock

if sys.platform != "win32":
    import fcntl

PATIENCE_S = 60.0
"""Whoever has waited so long compiles itself: the other may have been stopped."""
_POLL_S = 0.02


def compile_once(dispatcher: Any, lock_of: Callable[[], Path]) -> None:
    """Let `dispatcher` compile only while no other process compiles the same kernel.

    lock_of: the file to lock, beside its machine code; asked at the first call. Numba looks there
    again once the lock is held. Kernels call each other without cycles, so processes that hold
    one and wait for another do not wait in a circle; threads take Numba's own lock first.
    """
    compile_here = dispatcher.compile
    held = False
    lock: Path | None = None

    def compile_(signature: Any) -> Any:
        nonlocal held, lock
        with global_compiler_lock:
            if held:  # one of its forms within another
                return compile_here(signature)
            held = True
            try:
                lock = lock_of() if lock is None else lock
                with alone(lock, PATIENCE_S):
                    return compile_here(signature)
            finally:
                held = False

    dispatcher.compile = compile_


@contextmanager
def alone(path: Path, patience_s: float) -> Iterator[bool]:
    """Hold the lock in the file `path`; False where that took too long or files are not for us."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    except OSError:
        yield False
        return
    with file:
        yield _locked(file.fileno(), patience_s)


def _locked(descriptor: int, patience_s: float) -> bool:
    """Whether the lock was free in time; it ends with the descriptor."""
    if sys.platform == "win32":
        return False
    until = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                return False
            time.sleep(_POLL_S)
        except OSError:
            return False
        else:
            return True
