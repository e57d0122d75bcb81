"""The one way a kernel is compiled: at its first call, cached, sums stay in order.

`fastmath` stays off, so LLVM may not re-associate floating point: the same inputs give the same
bits on the same platform fingerprint. There are no parallel sections for the same reason.

A kernel's machine code holds that of the kernels that it calls. Numba takes a cached one for fresh
while the kernel's own file is unchanged, so after a change elsewhere it would go on with the old
code; and it writes its index before the code, so another process could load what an older program
left under the same name. Here the files of the cache are named by all sources that a kernel may
call: docs/decisions/0029.
"""

import hashlib
import inspect
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from team.estimation.compiled_once import compile_once
from team.sources import sources_of

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile `function` with Numba: cached on disk, IEEE order of operations.

    A checker's wrapper (the tests put one around every function) is no code to compile: what it
    wraps is.
    """
    kernel = inspect.unwrap(function)
    dispatcher: Any = numba.njit(cache=True, fastmath=False, error_model="numpy")(kernel)
    if dispatcher is not kernel:  # with NUMBA_DISABLE_JIT it is the function itself
        cache, program = dispatcher._cache, program_of(kernel.__module__)
        _name_cache(cache, program)
        name = f"{cache._impl.filename_base}-{program}.lock"
        compile_once(dispatcher, Path(cache._cache_path) / name)
    return cast(F, dispatcher)


@lru_cache
def program_of(module: str) -> str:
    """Digest of a module and of every module of ours that it imports, near or far."""
    digest = hashlib.blake2b(digest_size=8)
    package = (module.partition(".")[0],)
    for name, source in sorted(sources_of(module, package, places=False).items()):
        digest.update(f"{name}\n".encode() + source)
    return digest.hexdigest()


def _name_cache(cache: Any, program: str) -> None:
    """Let a kernel's cached code be that of this program only."""
    name = f"{cache._impl.filename_base}-{program}"
    cache._cache_file = type(cache._cache_file)(cache._cache_path, name, program)
