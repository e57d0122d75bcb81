"""A run as a task: a function with JSON parameters, and its program's digest."""

import hashlib
import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata
from platform import python_version
from typing import Any

from teamslam.sim.studies.experiments.sources import sources_of
from teamslam.team import core

ROOTS = ("teamslam",)
LIBRARIES = ("numpy", "scipy", "gtsam")
"""Libraries that results depend on."""


@dataclass(frozen=True)
class Task:
    """One run. work: `module:function`, from the parameters to a JSON object.

    local: arguments without influence on the result. cost: estimated run time [s].
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
    for name, source in sorted(sources_of(module, ROOTS).items()):
        digest.update(f"{name}\n".encode() + source)
    digest.update(core.digest.encode())
    return digest.hexdigest()


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "none"
