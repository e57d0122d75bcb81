"""Loads a kernel's machine code from the cache, without what only compiling needs.

Numba itself would first import all that it could compile, 30 MB and a quarter of a second, and
parse each kernel's bit code, from which kernels that call it are compiled. Here this waits until
something is compiled: docs/decisions/31.
"""

import ctypes
import importlib
import pickle
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import IO, Any

import numba
from llvmlite import binding  # type: ignore[import-untyped] # llvmlite ships no types
from numba.core import codegen, environment


def loads_alone() -> bool:
    """Whether cached code can be loaded without what only compiling needs.

    It is known of these versions of Numba; with another one a kernel is loaded as Numba does it.
    """
    return str(numba.__version__).startswith("0.68.")


def load_alone(files: Any, signature: Any, target: Any) -> Any:
    """Loads one form of a kernel from its cache; returns None where it is not there."""
    generator = target.codegen()
    _name_runtime()
    generator.unserialize_library = partial(_Loaded.read, generator)
    with files._guard_against_spurious_io_errors():
        loaded = files._load_overload(signature, target)
        if loaded is not None:
            _give_back()
        return loaded


def unpickled(file: IO[bytes]) -> Any:
    """The cached code in a file, read without importing Numba's modules that are compiled in."""
    return _Unpickler(file).load()


class _Loaded(codegen.JITCodeLibrary):
    """A form of a kernel; its bit code is parsed when a caller is compiled."""

    _bit_code: bytes | None = None

    @classmethod
    def read(cls, generator: Any, cached: tuple[str, str, tuple[bytes, bytes]]) -> Any:
        """Hands machine code to the linker, as Numba does."""
        name, kind, (code, bit_code) = cached
        assert kind == "object"
        library: Any = cls(generator, name)
        library._bit_code = bit_code
        if code:
            library.enable_object_caching()
            library._set_compiled_object(code)
            library._finalize_final_module()
        library._finalized = True
        return library

    def get_pointer_to_function(self, name: str) -> Any:
        """The address of a function in machine code, which the linker knows; 0 in bit code."""
        if not self._object_caching_enabled:
            return 0
        return self._codegen._engine.get_function_address(name)

    def _get_module_for_linking(self) -> Any:
        if self._bit_code is not None:
            self._shared_module = binding.parse_bitcode(self._bit_code)
            self._bit_code = None
        return super()._get_module_for_linking()  # type: ignore[no-untyped-call] # Numba's


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """The environment of a compiled function, instead of Numba's own, else as ever."""
        if (module, name) == (environment.__name__, "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: Sequence[object], name: str) -> Any:
    """A compiled function's constants; its module's names are for interpreted code only."""
    found = environment.lookup_environment(name)  # type: ignore[no-untyped-call] # Numba's
    if found is None:
        known = sys.modules.get(module)
        names = {"__name__": module} if known is None else vars(known)
        found = environment.Environment._memo[name] = environment.Environment(names)
        found.consts[:] = constants
        found.env_name = name
    return found


@cache
def _name_runtime() -> None:
    """Tells the linker where the functions of Numba's runtime are, which cached code calls."""
    runtime: Any = importlib.import_module("numba.core.runtime._nrt_python")
    for name, address in runtime.c_helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


_MADV_DONTNEED = 4


@cache
def _give_back() -> None:
    """Gives back the pages of the compiler's file that its start has read, on Linux.

    They are 44 MB, of which loading more machine code reads 5 again: docs/decisions/31. Those
    that the start has changed are no longer the file's and stay.
    """
    if sys.platform != "linux":
        return
    system, begin, size, is_compilers = ctypes.CDLL(None), 0, 0, False
    with suppress(OSError):
        for line in Path("/proc/self/smaps").read_text().splitlines():
            name, value, *_ = line.split()
            if not name.endswith(":"):  # a mapping: the lines that follow describe it
                begin, end = (int(address, 16) for address in name.split("-"))
                size, is_compilers = end - begin, line.endswith("/libllvmlite.so")
            elif is_compilers and (name, value) == ("Anonymous:", "0"):
                system.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(size), _MADV_DONTNEED)
