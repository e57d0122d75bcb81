"""A name that begins with an underscore is its module's own: nobody else reaches for it."""

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.support import ROOT

WINGS = ("team", "central", "sim", "benchmarks", "examples")
OFFICIAL = {"_replace", "_asdict", "_fields", "_exit"}
"""Named so by the language's own library, and meant for all: named tuples, `os._exit`."""
NUMBAS = {
    *("_cache", "_cache_file", "_cache_path", "_impl", "_data_path", "_load_overload", "_memo"),
    *("_guard_against_spurious_io_errors", "_data_name", "_save_data", "_save_index"),
    *("_codegen", "_engine", "_set_compiled_object", "_finalize_final_module"),
    *("_object_caching_enabled", "_raise_if_finalized", "_ensure_finalized", "_final_module"),
    *("_linking_libraries", "_reload_init", "_get_module_for_linking", "_library_class"),
    *("_finalize_dynamic_globals", "_optimize_final_module", "_function_pass_manager"),
    *("_compiler", "_data_layout", "_get_compiled_object", "_lock"),
}
"""What these modules of team/estimation have to ask numba for: it has no public way."""
ASKING = ("compiled.py", "cached_code.py", "parts.py")


def reached(source: str) -> Iterator[tuple[int, str]]:
    """The private attributes that a module uses and does not define, with their lines."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    own = {n.attr for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)}
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    own |= {n.name for n in nodes if isinstance(n, kinds)}
    own |= {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    for node in nodes:
        if isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            if not node.attr.startswith("__") and node.attr not in own | OFFICIAL:
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            names = (each.name for each in node.names)
            yield from ((node.lineno, n) for n in names if n.startswith("_") and n[1] != "_")


def modules() -> Iterator[Path]:
    for wing in WINGS:
        yield from sorted((ROOT / wing).rglob("*.py"))


def test_no_module_reaches_for_what_is_anothers_own() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in modules()
        for line, name in reached(path.read_text("utf-8"))
        if not (path.name in ASKING and name.rpartition(".")[2] in NUMBAS)
    ]
    assert not found, "\n".join(found)


def test_a_subclass_and_a_friend_that_reach_are_found() -> None:
    """The mutants: a subclass of a node that reads its ledger, a friend, and an import."""
    subclass = "class Retold(RobotNode):\n    def took(self):\n        return self._ledger\n"
    friend = "def waiting(node):\n    return node._inbox.waiting\n"
    assert [name for _, name in reached(subclass)] == ["self._ledger"]
    assert [name for _, name in reached(friend)] == ["node._inbox"]
    assert [name for _, name in reached("from a import _b\n")] == ["_b"]
    assert not list(reached("class A:\n    def f(self):\n        self._x = 1\n        a._x\n"))
