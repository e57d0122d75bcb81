"""Compile the kernels once into the cache, before many processes need them."""

import hashlib
import sys
from collections.abc import Iterator
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
from team.core import WholeMap
from team.estimation.contribution import Contribution, InitialPoseFactor
from team.estimation.gaussian import curved
from team.estimation.geometry import inverse, logarithm, wrapped
from team.estimation.map_joining.conditioning import Followed, followed, pose_now
from team.estimation.map_joining.gauss_newton import JoinSettings
from team.estimation.map_joining.joining import EMPTY_FOLD, Fold, converged, folded, started
from team.estimation.map_joining.marginals import joint_cost, landmark_blocks, landmark_map
from team.estimation.submap import LocalMap
from team.wire.bus import Sample
from team.wire.channels import SUBMAP, channel_of

_VERSIONS = (sys.version, numba.__version__, binding.get_host_cpu_name())
_STEPS = 48
FORMS = 210
"""Kernel forms that a small team compiles with Hybrid-SLAM and joined submaps."""
PLACES = np.array([[10.0, 0.0], [0.0, 10.0], [10.0, 10.0], [20.0, 10.0], [10.0, 20.0]])
"""Positions [m] of artificial landmarks."""


def warm_up(estimator: str, fusion: str) -> None:
    """Run a small team in memory with estimator and rule, unless this program has done so.

    Different motion models and a robust loss at the centre compile kernels of both kinds.
    """
    if not is_warm(estimator, fusion):
        run_small_team(estimator, fusion)
        note_warm(estimator, fusion)


def is_warm(estimator: str, fusion: str) -> bool:
    """Whether this program has compiled the kernels of the two."""
    stamp = _stamp(estimator, fusion)
    return stamp is None or stamp.exists()


def note_warm(estimator: str, fusion: str) -> None:
    """Mark the kernels as compiled."""
    stamp = _stamp(estimator, fusion)
    with suppress(OSError):  # then the next launch repeats it
        if stamp is not None:
            stamp.touch()


def _stamp(estimator: str, fusion: str) -> Path | None:
    cached = getattr(wrapped, "stats", None)  # nothing is compiled with NUMBA_DISABLE_JIT
    return (
        None if cached is None else Path(cached.cache_path) / f"ready-{_program(estimator, fusion)}"
    )


def _program(estimator: str, fusion: str) -> str:
    """Digest of our sources, compiler and processor, on which the kernels depend."""
    digest = hashlib.blake2b(digest_size=8)
    for text in (*_VERSIONS, estimator, fusion):
        digest.update(f"{text}\n".encode())
    for package in (team, central):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    digest.update(Path(__file__).read_bytes())
    return digest.hexdigest()


def run_small_team(estimator: str, fusion: str) -> None:
    """Run a small team of two in memory to compile or load every kernel of the pair.

    Different motion models and a robust loss at the centre compile kernels of both kinds.
    """
    for _ in _small_team(estimator, fusion):
        pass
    logarithm(inverse(np.zeros(3)))  # used by the centre for robots without initial pose


def run_to_the_first_submap(estimator: str, fusion: str) -> None:
    """Run until the centre's first submap, which needs most robot kernels."""
    for sample in _small_team(estimator, fusion):
        if channel_of(sample.key) == (SUBMAP, "r1"):
            return


def fold_made_up_submaps() -> Fold:
    """Fold six artificial submaps of two robots, which needs the centre's kernels."""
    fold = EMPTY_FOLD
    for robot in ("r1", "r2"):
        fold = started(fold, InitialPoseFactor(robot, 1, np.zeros(3)))
    settings = JoinSettings(robust_c=2.0)
    for k in range(3):
        end_ns = (k + 1) * 10**9
        taken = [Contribution(robot, 1, k, end_ns, _made_up(k)) for robot in ("r1", "r2")]
        fold = folded(fold, taken, settings)
    fold = converged(fold, settings)
    landmark_map(fold)
    landmark_blocks(fold)
    joint_cost(fold)
    return fold


def follow_made_up_submaps() -> Followed:
    """Robot map and pose after two artificial submaps, which needs the kernels of localisation in
    the team's map.
    """
    first, *later = map(_made_up, range(3))
    found = followed(WholeMap(first.ids, first.mean, first.covariance), later)
    curved(pose_now(found.whole, None).pose)
    return found


def _made_up(k: int) -> LocalMap:
    """Submap from metre k to metre k + 1 of a robot's path."""
    mean = np.concatenate([[1.0, 0.0, 0.0], (PLACES - [k, 0.0]).ravel()])
    return LocalMap(np.arange(5, dtype=np.uint32), mean, np.diag(np.full(len(mean), 0.01)))


def _small_team(estimator: str, fusion: str) -> Iterator[Sample]:
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
    yield from run_team(small, streams_of(small))
