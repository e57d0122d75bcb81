"""Compiles the kernels once, before many processes need them: later processes read the cache."""

import hashlib
import sys
from contextlib import suppress
from pathlib import Path

import msgspec
import numba
import numpy as np
from llvmlite import binding  # type: ignore[import-untyped] # no stubs

import central
import team
from sim.scenarios.scenario import load, with_options
from sim.scenarios.source import streams_of
from sim.world.config import SimulatedWorld
from team.estimation.geometry import inverse, logarithm, wrapped

_VERSIONS = (sys.version, numba.__version__, binding.get_host_cpu_name())
_STEPS = 48
"""So many seconds that robots take maps with submaps of theirs that are not in them."""


def warm_up(estimator: str, fusion: str) -> None:
    """Run a small team of two in memory with estimator and rule, unless this program has before.

    They move by different models, and the centre's loss is robust: kernels of both kinds are ready.
    """
    cached = getattr(wrapped, "stats", None)
    if cached is None:
        return  # with NUMBA_DISABLE_JIT nothing is compiled
    done = Path(cached.cache_path) / f"ready-{_program(estimator, fusion)}"
    if not done.exists():
        run_small_team(estimator, fusion)
        with suppress(OSError):  # then the next launch does it again
            done.touch()


def _program(estimator: str, fusion: str) -> str:
    """Digest of what is compiled for the two: our sources, the compiler and the processor."""
    digest = hashlib.blake2b(digest_size=8)
    for text in (*_VERSIONS, estimator, fusion):
        digest.update(f"{text}\n".encode())
    for package in (team, central):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    digest.update(Path(__file__).read_bytes())
    return digest.hexdigest()


def run_small_team(estimator: str, fusion: str) -> None:
    """Run a small team of two in memory: every kernel that the pair uses is compiled or loaded.

    They move by different models, and the centre's loss is robust: kernels of both kinds are ready.
    """
    from sim.in_memory.team import run_team

    scenario = with_options(load("thesis"), estimator=estimator, fusion=fusion)
    world = scenario.world
    assert isinstance(world, SimulatedWorld)
    first, *others = scenario.robots
    motion = msgspec.structs.replace(first.motion, kind="velocity")
    small = msgspec.structs.replace(
        scenario,
        world=msgspec.structs.replace(world, steps=_STEPS),
        robots=(msgspec.structs.replace(first, motion=motion), *others),
        central=msgspec.structs.replace(scenario.central, robust_c=2.0),
    )
    for _ in run_team(small, streams_of(small)):
        pass
    logarithm(inverse(np.zeros(3)))  # the centre asks this of robots without an initial pose
