"""Compiles a kernel once where several processes need it for the first time: the others wait.

Machine code is cached in files (`team.estimation.compiled`), but a process that looks there while
another one compiles the same kernel finds nothing and would compile it again, which on a computer
with two cores takes the time of both.
"""

import itertools
import secrets
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core.bytecode import FunctionIdentity
from numba.core.compiler_lock import global_compiler_lock

from team.estimation.parts import undisturbed

if sys.platform != "win32":
    import fcntl

PATIENCE_S = 60.0
"""After this time [s] a process compiles the kernel itself: the other one may have been stopped."""
_POLL_S = 0.02


def compile_once(dispatcher: Any, lock_of: Callable[[], Path]) -> None:
    """Lets `dispatcher` compile only while no other process compiles the same kernel.

    lock_of: returns the file to lock, beside the machine code; called at the first compilation.
        Numba looks into the cache again once the lock is held. Kernels do not call each other in
        cycles, so processes that hold one lock and wait for another can not block each other for
        good; threads take Numba's own lock first.
    """
    compile_here = dispatcher.compile
    compiling = False
    lock: Path | None = None

    def compile_(signature: Any) -> Any:
        nonlocal compiling, lock
        with global_compiler_lock:
            if compiling:  # one of its forms within another
                return compile_here(signature)
            compiling = True
            try:
                lock = lock_of() if lock is None else lock
                with alone(lock, PATIENCE_S):
                    _number_from_anywhere()
                    with undisturbed():
                        return compile_here(signature)
            finally:
                compiling = False

    dispatcher.compile = compile_


def _number_from_anywhere() -> None:
    """Lets Numba number the functions that it compiles from a random number on.

    The number is in the name by which a cached kernel's parts are linked, and Numba counts from
    one in each process. Parts of two processes can then be called alike and be different: one that
    sorts integers, one that orders them (docs/decisions/31).
    """
    FunctionIdentity._unique_ids = itertools.count(secrets.randbits(60))


@contextmanager
def alone(path: Path, patience_s: float) -> Iterator[bool]:
    """Holds the lock in the file `path`; yields False where that took too long or the file can not
    be opened.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    except OSError:
        yield False
        return
    with file:
        yield _locked(file.fileno(), patience_s)


def _locked(descriptor: int, patience_s: float) -> bool:
    """Whether the lock was free in time; it is released when the descriptor is closed."""
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
