"""Sources that a module of ours depends on."""

import ast
import re
import sys
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

_PLACE = re.compile(r"^([a-z_][\w.]*):[A-Za-z_]\w*$")
"""A name in a table of `teamslam.team.registry`."""


def sources_of(module: str, packages: tuple[str, ...]) -> dict[str, bytes]:
    """Text of a module and of all that it imports of these packages, transitively.

    Names in tables (`teamslam.team.registry`) count as imports.
    """
    found: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] not in packages:
            continue
        path = _path(name)
        if path is None:
            continue
        found[name] = path.read_bytes()
        waiting.append(name.rpartition(".")[0])
        waiting += _imported(found[name])
    return found


@lru_cache
def _imported(source: bytes) -> tuple[str, ...]:
    """Modules that a source may use: `from a import b` or a text `a.b:c`."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names += _PLACE.findall(node.value)
    return tuple(names)


@lru_cache
def _path(module: str) -> Path | None:
    if not module:
        return None
    loaded = sys.modules.get(module)
    try:
        spec = find_spec(module) if loaded is None else loaded.__spec__
    except ModuleNotFoundError:
        return None
    if spec is None or not spec.has_location or not str(spec.origin).endswith(".py"):
        return None
    return Path(str(spec.origin))
