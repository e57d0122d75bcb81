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
    return _as_python(path, mutant.where)


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


def _as_python(path: Path, name: str) -> bool:
    """The kernel of this name and all kernels that lead to it, or to this constant, as written."""
    kernels = {id(x): x for x in gc.get_objects() if _compiled(x)}
    codes = {i: kernel.py_func.__code__ for i, kernel in kernels.items()}
    names = {name}
    chosen = {i for i, c in codes.items() if c.co_name == name and Path(c.co_filename) == path}
    while True:
        callers = {i for i, code in codes.items() if names & set(code.co_names)} - chosen
        if not callers or (not chosen and not name.isupper()):
            break
        chosen |= callers
        names |= {codes[i].co_name for i in callers}
    for module in _ours():
        for key, value in list(vars(module).items()):
            if id(value) in chosen:
                setattr(module, key, value.py_func)
    return bool(chosen)


def _compiled(value: object) -> bool:
    return type(value).__name__ == "CPUDispatcher" and inspect.isfunction(
        getattr(value, "py_func", None)
    )
