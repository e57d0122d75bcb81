"""What a kernel calls becomes a part of its machine code, and has none of its own.

Numba optimises every function by itself and writes its machine code, of its own functions as well
as of ours, and does both again in each kernel that contains it. Here a function gets machine code
when its address is asked for, which nobody does of a part: docs/decisions/0136.
"""

from functools import partial
from typing import Any

from numba.core import codegen, environment


def keep_parts_as_bit_code(generator: Any) -> None:
    """Let this generator of code make libraries of the kind below."""
    if generator._library_class is not Library:
        generator._library_class = Library
        generator.set_env = partial(_set_environment, generator)


class Library(codegen.JITCodeLibrary):
    """The code of a function, which becomes machine code when its address is asked for."""

    _is_machine_code = False

    def finalize(self) -> None:
        """Links what the function calls."""
        _link(self)

    def get_pointer_to_function(self, name: str) -> Any:
        """The address of a function, optimised; 0 where there is none of this name."""
        if not _defines(self, name):
            return 0
        if not self._is_machine_code:
            self._is_machine_code = True
            _make_machine_code(self)
        return super().get_pointer_to_function(name)  # type: ignore[no-untyped-call] # Numba's

    def serialize_using_object_code(self) -> Any:
        """Name, kind, and the pair of machine code, which is empty for a part, and bit code."""
        if self._is_machine_code:
            return super().serialize_using_object_code()  # type: ignore[no-untyped-call] # Numba's
        return self.name, "object", (b"", _bit_code(self))


def _link(library: Any) -> None:
    library._raise_if_finalized()
    for part in dict.fromkeys(library._linking_libraries):
        library._reload_init.update(part._reload_init)
        library._final_module.link_in(part._get_module_for_linking(), preserve=True)
    library._finalize_dynamic_globals()
    library._finalized = True


def _defines(library: Any, name: str) -> bool:
    library._ensure_finalized()
    functions = library._final_module.functions
    return any(each.name == name and not each.is_declaration for each in functions)


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
