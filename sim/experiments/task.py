"""A run as a task: a function by name with JSON parameters, and what its result depends on."""

import ast
import hashlib
import importlib
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from platform import python_version
from typing import Any

ROOTS = ("team", "central", "sim")
LIBRARIES = ("numpy", "scipy", "numba", "gtsam")
"""Beside our sources, results depend on these."""


@dataclass(frozen=True)
class Task:
    """One run. work: `module:function`; the function takes the parameters, gives a JSON object.

    local: further keyword arguments that the result does not depend on, such as the path of a data
    set whose checksum is among the parameters. cost: about how many seconds it takes.
    """

    work: str
    parameters: Mapping[str, Any]
    label: str
    cost: float = 1.0
    local: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def name(self) -> str:
        """A digest of the function's name and the parameters."""
        text = json.dumps([self.work, self.parameters], sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def run(self) -> dict[str, Any]:
        """Compute it, here and now."""
        module, _, function = self.work.partition(":")
        work: Callable[..., dict[str, Any]] = getattr(importlib.import_module(module), function)
        return work(**self.parameters, **self.local)


@lru_cache
def program_of(module: str) -> str:
    """Digest of the versions and of every source of ours that a module imports, near or far.

    The sources are found by their import statements, those inside functions too.
    """
    digest = hashlib.blake2b(digest_size=8)
    digest.update(f"python {python_version()}\n".encode())
    for library in LIBRARIES:
        digest.update(f"{library} {_version(library)}\n".encode())
    for name, source in sorted(sources_of(module).items()):
        digest.update(f"{name}\n".encode() + source)
    return digest.hexdigest()


def sources_of(module: str) -> dict[str, bytes]:
    """The text of every module of ours that this one imports, near or far, and its own."""
    found: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] not in ROOTS:
            continue
        path = _path(name)
        if path is None:
            continue
        found[name] = path.read_bytes()
        waiting.append(name.rpartition(".")[0])
        waiting += _imported(found[name])
    return found


def _imported(source: bytes) -> list[str]:
    """Modules that a source may import: `from a import b` may mean a.b."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return names


def _path(module: str) -> Path | None:
    """The source of a module; None if the name is no module's."""
    if not module:
        return None
    loaded = sys.modules.get(module)
    try:
        spec = find_spec(module) if loaded is None else loaded.__spec__
    except ModuleNotFoundError:
        return None
    return None if spec is None or not spec.has_location else Path(str(spec.origin))


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "none"
