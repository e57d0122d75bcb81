"""A run as a task: a function with JSON parameters, and its program's digest."""

import ast
import hashlib
import importlib
import json
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from platform import python_version
from typing import Any

from teamslam.team import core

_PLACE = re.compile(r"^([a-z_][\w.]*):[A-Za-z_]\w*$")
"""A name in a table of `teamslam.team.registry`."""


def _sources_of(module: str, packages: tuple[str, ...]) -> dict[str, bytes]:
    """Text of a module and of all that it imports of these packages.

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
    """Modules that a source may use: `from a import b` or `a.b:c`."""
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


ROOTS = ("teamslam",)
LIBRARIES = ("numpy", "scipy", "gtsam")  # libraries that results depend on


@dataclass(frozen=True)
class Task:
    """One run. work: `module:function`, from parameters to a JSON object.

    local: arguments without influence on the result. cost: estimated time [s].
    """

    work: str
    parameters: Mapping[str, Any]
    label: str
    cost: float = 1.0
    local: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def name(self) -> str:
        """Digest of function name and parameters."""
        text = json.dumps([self.work, self.parameters], sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def program(self) -> str:
        """Digest of sources and library versions."""
        return program_of(self.work.partition(":")[0])

    def run(self) -> dict[str, Any]:
        """Compute the task in this process."""
        module, _, function = self.work.partition(":")
        work: Callable[..., dict[str, Any]] = getattr(importlib.import_module(module), function)
        return work(**self.parameters, **self.local)


@lru_cache
def program_of(module: str) -> str:
    """Digest of library versions, imported sources, and the native core."""
    digest = hashlib.blake2b(digest_size=8)
    digest.update(f"python {python_version()}\n".encode())
    for library in LIBRARIES:
        digest.update(f"{library} {_version(library)}\n".encode())
    for name, source in sorted(_sources_of(module, ROOTS).items()):
        digest.update(f"{name}\n".encode() + source)
    digest.update(core.digest.encode())
    return digest.hexdigest()


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "none"
