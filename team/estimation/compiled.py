"""The one way a kernel is compiled: ahead of its first call, cached, sums stay in order.

`fastmath` stays off, so LLVM may not re-associate floating point: the same inputs give the same
bits on the same platform fingerprint. There are no parallel sections for the same reason.
"""

import inspect
from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile `function` with Numba: cached on disk, IEEE order of operations.

    A checker's wrapper (the tests put one around every function) is no code to compile: what it
    wraps is.
    """
    kernel = inspect.unwrap(function)
    return cast(F, numba.njit(cache=True, fastmath=False, error_model="numpy")(kernel))
