"""The code of one function, or one constant, changed in a process that has imported everything."""

import ast
import gc
import importlib
import inspect
import sys
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

from tests.mutation.mutants import Mutant

PACKAGES = ("team", "central", "sim", "tests")


class NoSuchFunctionError(LookupError):
    """Nothing in this process has the code that is to be changed."""


def changed(path: Path, mutant: Mutant) -> bool:
    """Put the mutant in place; true if kernels run as plain Python for it."""
    source = path.read_bytes()
    module = ".".join(path.relative_to(Path(__file__).parents[2]).with_suffix("").parts)
    code = compile(mutant.applied(source), str(path), "exec", dont_inherit=True)
    if mutant.where.rpartition(".")[2] in _functions(code):
        _replace_function(path, mutant.where, code)
    else:
        _replace_constant(module, mutant.where, source, mutant.applied(source))
    return _as_python(mutant.where.rpartition(".")[2])


def _functions(code: CodeType) -> set[str]:
    return {
        name
        for each in code.co_consts
        if isinstance(each, CodeType)
        for name in ({each.co_name} | _functions(each))
    }


def _code_of(code: CodeType, where: str) -> CodeType:
    for name in where.split("."):
        code = next(
            each for each in code.co_consts if isinstance(each, CodeType) and each.co_name == name
        )
    return code


def _replace_function(path: Path, where: str, module: CodeType) -> None:
    new, found = _code_of(module, where), False
    for each in gc.get_objects():
        if isinstance(each, FunctionType):
            old = each.__code__
            if (old.co_name, old.co_firstlineno) == (new.co_name, new.co_firstlineno) and Path(
                old.co_filename
            ) == path:
                each.__code__ = new
                found = True
    if not found:
        raise NoSuchFunctionError(f"{path.name}: {where}")


def _replace_constant(module: str, name: str, source: bytes, wrong: bytes) -> None:
    """The constant, wherever a module of ours has it under its own name."""
    values = []
    for text in (source, wrong):
        node = next(
            each
            for each in ast.parse(text).body
            if isinstance(each, ast.Assign)
            and isinstance(each.targets[0], ast.Name)
            and each.targets[0].id == name
        )
        values.append(ast.literal_eval(node.value))
    importlib.import_module(module)
    for each in _ours():
        if name in vars(each) and vars(each)[name] == values[0]:
            setattr(each, name, values[1])


def _ours() -> list[Any]:
    return [each for name, each in list(sys.modules.items()) if name.split(".")[0] in PACKAGES]


def _as_python(name: str) -> bool:
    """Kernels of this name, and all that lead to it, run as they are written."""
    kernels = {id(x): x for x in gc.get_objects() if hasattr(type(x), "py_func") or _compiled(x)}
    names = {name}
    while True:
        callers = {
            kernel.py_func.__name__
            for kernel in kernels.values()
            if names & set(kernel.py_func.__code__.co_names)
        }
        if callers <= names:
            break
        names |= callers
    plain = {i: k.py_func for i, k in kernels.items() if k.py_func.__name__ in names}
    for module in _ours():
        for key, value in list(vars(module).items()):
            if id(value) in plain:
                setattr(module, key, plain[id(value)])
    return bool(plain)


def _compiled(value: object) -> bool:
    return type(value).__name__ == "CPUDispatcher" and inspect.isfunction(
        getattr(value, "py_func", None)
    )
