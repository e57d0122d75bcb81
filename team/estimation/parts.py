"""What a kernel calls becomes a part of its machine code, and has none of its own.

Numba optimises every function by itself and writes its machine code, of its own functions as well
as of ours, and does both again in each kernel that contains it. Here a function gets machine code
when its address is asked for, which nobody does of a part: docs/decisions/31.
"""

import copy
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from llvmlite import binding  # type: ignore[import-untyped] # llvmlite ships no types
from numba.core import codegen, cpu, environment, ir


def keep_parts_as_bit_code(generator: Any) -> None:
    """Let this generator of code make libraries of the kind below."""
    if generator._library_class is not Library:
        generator._library_class = Library
        generator.set_env = partial(_set_environment, generator)


@contextmanager
def undisturbed() -> Iterator[None]:
    """While the context lasts, Numba leaves out what it does beside compiling.

    It would time each call of LLVM's for each function that is being compiled, give each of its own
    functions a wrapper for callers in C, and be interrupted some thousand times while Python looks
    for objects that nobody uses. To be entered with Numba's lock of the compiler held.
    """
    thresholds = gc.get_threshold()
    gc.set_threshold(_YOUNG, *thresholds[1:])
    try:
        with (
            _replaced(binding.ffi.lib._lock, "_cblist", []),
            _replaced(cpu.CPUContext, "create_cfunc_wrapper", lambda *_: None),
            _replaced(ir.Inst, "_rec_list_vars", _variables),
        ):
            yield
    finally:
        gc.set_threshold(*thresholds)


_YOUNG = 50_000
"""Number of new objects from which on Python looks for those among them that nobody uses."""


@contextmanager
def _replaced(owner: Any, name: str, value: object) -> Iterator[None]:
    original = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, original)


def _variables(inst: object, value: Any) -> list[Any]:
    """The variables in a part of an instruction, as Numba lists them: most parts are none."""
    kind = type(value)
    if kind is ir.Var:
        return [value]
    if kind in _NO_VARIABLES:
        return []
    if kind is dict:
        value = value.values()
    elif kind is not list and kind is not tuple:
        listed: Any = value
        return listed.list_vars() if isinstance(value, ir.Inst) else []
    return [variable for part in value for variable in _variables(inst, part)]


_NO_VARIABLES = frozenset((str, int, bool, float, type(None), ir.Loc, ir.Const, ir.Global, ir.Arg))


def called_from_python(part: Any) -> Any:
    """A part's form with machine code, and the wrapper by which Python calls it.

    It has constants of its own: the wrapper notes the types of arrays there.
    """
    part.typing_context.refresh()
    part.target_context.refresh()
    target = part.target_context.subtarget(enable_nrt=True)  # arrays own memory; as Numba compiles
    library = target.codegen().create_library(part.library.name)
    library.enable_object_caching()
    library.add_linking_library(part.library)
    description = copy.copy(part.fndesc)
    description.env_name += "-called"
    described: Any = environment.Environment
    constants = described.from_fndesc(description)
    target.create_cpython_wrapper(library, description, constants, None)
    entry = target.get_executable(library, description, constants)
    return part._replace(
        entry_point=entry,
        fndesc=description,
        library=library,
        environment=constants,
        metadata={},
    )


class Library(codegen.JITCodeLibrary):
    """The code of a function, which becomes machine code when its address is asked for."""

    _is_machine_code = False

    def finalize(self) -> None:
        """Links what the function calls."""
        _link(self)

    def get_pointer_to_function(self, name: str) -> Any:
        """The address of a function, optimised; 0 where there is none of this name."""
        if (function := _defined(self, name)) is None:
            return 0
        if not self._is_machine_code:
            self._is_machine_code = True
            function.linkage = "external"
            _make_machine_code(self)
        return super().get_pointer_to_function(name)  # type: ignore[no-untyped-call] # Numba's

    def serialize_using_object_code(self) -> Any:
        """Name, kind, and the pair of machine code and bit code, of which one is empty."""
        if self._is_machine_code:
            return self.name, "object", (self._get_compiled_object(), b"")  # type: ignore[no-untyped-call] # Numba's
        return self.name, "object", (b"", _bit_code(self))

    def _optimize_functions(self, module: Any) -> None:
        """LLVM's passes over single functions: one row of passes for all of a module."""
        module.data_layout = self._codegen._data_layout
        generator: Any = self._codegen
        passes, builder = generator._function_pass_manager()
        for function in module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _get_module_for_linking(self) -> Any:
        """The module itself, its functions marked so that several modules may hold them."""
        self._ensure_finalized()  # type: ignore[no-untyped-call] # Numba's
        if self._shared_module is None:
            for function in self._final_module.functions:
                if not function.is_declaration and function.linkage == binding.Linkage.external:
                    function.linkage = "linkonce_odr"
            self._shared_module = self._final_module
        return self._shared_module


def _link(library: Any) -> None:
    library._raise_if_finalized()
    for part in dict.fromkeys(library._linking_libraries):
        library._reload_init.update(part._reload_init)
        library._final_module.link_in(part._get_module_for_linking(), preserve=True)
    library._finalize_dynamic_globals()
    library._finalized = True


def _defined(library: Any, name: str) -> Any:
    """The function of this name that the library defines, or None."""
    library._ensure_finalized()
    try:
        function = library._final_module.get_function(name)
    except NameError:
        return None
    return None if function.is_declaration else function


def _make_machine_code(library: Any) -> None:
    """Optimises over the whole module, and tells each function in it where its constants are."""
    library._optimize_final_module()
    library._final_module.verify()
    library._finalize_final_module()
    constants_of: Any = environment.lookup_environment
    for each in library._final_module.global_variables:
        if (constants := constants_of(each.name)) is not None:
            library.codegen.set_env(each.name, constants)


def _bit_code(library: Any) -> Any:
    library._ensure_finalized()
    return library._get_module_for_linking().as_bitcode()


def _set_environment(generator: Any, name: str, constants: Any) -> None:
    """Tells a function's machine code where its constants are; a part has no machine code yet."""
    if generator._engine.get_global_value_address(name):
        codegen.JITCPUCodegen.set_env(generator, name, constants)  # type: ignore[no-untyped-call] # Numba's
