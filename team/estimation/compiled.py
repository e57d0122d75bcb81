"""Compiles a numerical kernel at its first call, caches the machine code, keeps the order of sums.

`fastmath` is off, so that LLVM can not re-associate floating point: the same inputs give the same
bits on the same platform fingerprint. There are no parallel sections for the same reason.

A kernel's machine code contains that of the kernels that it calls. Numba itself considers cached
code valid while the kernel's own file is unchanged, so that after a change of a called kernel it
would run the old code; and it writes its index before the code, so that another process could load
the code of an older program under the same name. Here the files of the cache are therefore named by
a digest of the kernel's byte code, of the constants that it names and of the kernels that it calls:
docs/decisions/31.
"""

import dis
import hashlib
import inspect
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from functools import cache, lru_cache, partial
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.caching import IndexDataCacheFile

from team.estimation.cached_code import load_alone, loads_alone, unpickled
from team.estimation.compiled_once import compile_once
from team.estimation.parts import called_from_python, keep_parts_as_bit_code
from team.sources import sources_of

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compiles `function` with Numba: cached on disk, IEEE order of operations.

    Where `function` is a type checker's wrapper (the tests put one around every function), the
    wrapped function is compiled.
    """
    kernel = inspect.unwrap(function)
    dispatcher = _compiler_of(kernel)
    if dispatcher is not kernel and loads_alone():
        part = cache(partial(_compiler_of, kernel, no_cpython_wrapper=True))
        dispatcher.get_call_template = lambda *types: part().get_call_template(*types)
        dispatcher.get_overload = lambda form: part().get_overload(form)
        dispatcher._compiler.compile = lambda types, _: called_from_python(_form(part(), types))
    return cast(F, dispatcher)


def _form(part: Any, types: Sequence[Any]) -> Any:
    """A kernel compiled as a part of others, for these types of arguments."""
    part.compile(tuple(types))
    return part.overloads[tuple(types)]


def _compiler_of(kernel: Callable[..., object], **options: bool) -> Any:
    """Compiles a kernel at its first call: for Python, or as a part of others, which has no entry
    from Python. The first is made of the second (`team.estimation.parts`).
    """
    compile_: Any = numba.njit
    dispatcher = compile_(
        kernel,
        cache=True,
        fastmath=False,
        error_model="numpy",
        forceinline=kernel in _INLINED,
        no_cfunc_wrapper=True,  # no C program calls it
        **options,
    )
    if dispatcher is not kernel:  # with NUMBA_DISABLE_JIT it is the function itself
        kind = "-part" if options else ""
        compile_once(dispatcher, lambda: _cache_of_its_own(dispatcher, kind))
    return dispatcher


def inlined(function: F) -> F:
    """`compiled`, and a part of each kernel that calls it: so a loop of calls can be vectorised."""
    _INLINED.add(inspect.unwrap(function))
    return compiled(function)


_INLINED: set[Callable[..., object]] = set()


def _cache_of_its_own(dispatcher: Any, kind: str) -> Path:
    """Names the files of a kernel's cache by its program; returns the file that locks them.

    To be called at the kernel's first call, when all names that it uses are defined. The kernel's
    line number is left out of the name.
    """
    cached, program = dispatcher._cache, program_of(dispatcher.py_func)
    line = f"-{dispatcher.py_func.__code__.co_firstlineno}."
    name = f"{cached._impl.filename_base.replace(line, '.', 1)}-{program}{kind}"
    files: Any = _CacheFile
    cached._cache_file = files(cached._cache_path, name, program)
    if loads_alone():
        keep_parts_as_bit_code(dispatcher.targetctx.codegen())
        cached.load_overload = partial(load_alone, cached)
    return Path(cached._cache_path) / f"{name}.lock"


class _CacheFile(IndexDataCacheFile):
    """The files of one kernel's cache.

    They name the classes of the kernel's arguments, records included, which are no part of its
    program: code whose classes have other names now is compiled anew, as what is not there.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            return dict(super()._load_index())  # type: ignore[no-untyped-call] # Numba's
        except (AttributeError, ImportError):
            return {}

    def save(self, key: Any, data: Any) -> None:
        """Stores the code of one form; `key` alone names its file.

        Numba numbers them in the order of their coming, so that two processes could give one file
        to two forms.
        """
        form = hashlib.blake2b(repr(key).encode(), digest_size=8).digest()
        name = self._data_name(int.from_bytes(form))  # type: ignore[no-untyped-call] # Numba's
        self._save_data(name, data)  # type: ignore[no-untyped-call] # Numba's
        self._save_index({**self._load_index(), key: name})  # type: ignore[no-untyped-call]

    def _load_data(self, name: str) -> Any:
        """The code of one form. What can not be read counts as not there: it raises OSError."""
        try:
            if not loads_alone():
                return super()._load_data(name)  # type: ignore[no-untyped-call] # Numba's
            path = self._data_path(name)  # type: ignore[no-untyped-call] # Numba's
            with open(path, "rb") as file:
                return unpickled(file)
        except Exception as error:  # a damaged pickle raises what its bytes happen to mean
            raise OSError(f"{name} is damaged, or names what has another name now") from error


_NAMES = b"parts numbered at random, without machine code"
"""How the parts of a kernel are named: code whose parts have other names is not linked with it."""
_CALLERS: ContextVar[tuple[Callable[..., object], ...]] = ContextVar("callers", default=())
"""The kernels whose digests are being computed, each one called by the one before it."""


class CircularKernelsError(TypeError):
    """A kernel calls itself, or several each other: the program of one would contain itself."""

    def __init__(self, circle: Sequence[Callable[..., object]]) -> None:
        self.circle = tuple(circle)
        names = " -> ".join(f"{each.__module__}.{each.__qualname__}" for each in circle)
        super().__init__(
            f"kernels call each other in a circle: {names}; make them one kernel with a loop"
        )


@cache
def program_of(kernel: Callable[..., object]) -> str:
    """Digest of a kernel's byte code and of all that its names refer to: kernels and constants.

    Of a named tuple only its fields matter. A name of anything else, such as a class, adds all
    sources that the kernel's module imports.
    Raises CircularKernelsError where kernels call each other in a circle, or one calls itself: code
    of it that is loaded from the cache ends the process.
    """
    callers = _CALLERS.get()
    if kernel in callers:
        raise CircularKernelsError([*callers[callers.index(kernel) :], kernel])
    within = _CALLERS.set((*callers, kernel))
    try:
        return _digest_of(kernel)
    finally:
        _CALLERS.reset(within)


def _digest_of(kernel: Callable[..., object]) -> str:
    digest = hashlib.blake2b(_NAMES, digest_size=8)
    _add_code(digest, kernel.__code__, kernel.__doc__)
    digest.update(repr((kernel.__defaults__, kernel.__kwdefaults__, kernel in _INLINED)).encode())
    for chain in sorted(_globals(kernel.__code__)):
        _add_meant(digest, kernel, chain)
    if kernel.__closure__:
        digest.update(_sources(kernel.__module__))
    return digest.hexdigest()


def _add_code(digest: hashlib.blake2b, code: CodeType, doc: str | None) -> None:
    digest.update(repr((code.co_varnames, code.co_names, code.co_freevars)).encode())
    digest.update(code.co_code)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            _add_code(digest, constant, None)
        elif isinstance(constant, frozenset):  # its order is not defined
            digest.update(repr(sorted(map(repr, constant))).encode())
        elif constant is not doc:
            digest.update(repr(constant).encode())


def _globals(code: CodeType) -> set[tuple[str, ...]]:
    """The global names that a function loads, each with the chain of attributes that it reads."""
    chains: list[tuple[str, ...]] = []
    at_global = False
    for step in dis.get_instructions(code):
        if step.opname == "LOAD_GLOBAL":
            chains.append((step.argval,))
            at_global = True
        elif at_global and step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            chains[-1] = (*chains[-1], step.argval)
        elif step.opname != "CACHE":
            at_global = False
    inside = [_globals(each) for each in code.co_consts if isinstance(each, CodeType)]
    return set(chains).union(*inside)


def _add_meant(
    digest: hashlib.blake2b, kernel: Callable[..., object], chain: tuple[str, ...]
) -> None:
    """Adds the value that a name of a kernel refers to."""
    name, *attributes = chain
    if name not in kernel.__globals__:  # a builtin
        return
    value = kernel.__globals__[name]
    for attribute in attributes:
        if isinstance(value, ModuleType) and _is_ours(value.__name__):
            value = getattr(value, attribute)
    digest.update(".".join(chain).encode())
    function = getattr(value, "py_func", None)
    if function is not None:
        digest.update(program_of(function).encode())
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif _is_plain(value):
        digest.update(repr(value).encode())
    elif isinstance(value, type) and "_field_defaults" in vars(value):
        fields = vars(value)["_fields"], vars(value)["_field_defaults"]
        digest.update(repr(fields).encode())
    elif _is_ours(str(getattr(value, "__module__", None) or getattr(value, "__name__", ""))):
        digest.update(_sources(kernel.__module__))


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, bool | int | float | complex | str | bytes)


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] not in _OTHERS


_OTHERS = frozenset(("numpy", "math", "builtins", "numba", "typing", "jaxtyping"))


@lru_cache
def _sources(module: str) -> bytes:
    """Digest of a module and of all modules of ours that it imports, directly or not."""
    digest = hashlib.blake2b(digest_size=8)
    package = (module.partition(".")[0],)
    for name, source in sorted(sources_of(module, package, places=False).items()):
        digest.update(f"{name}\n".encode() + source)
    return digest.digest()
