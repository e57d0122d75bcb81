"""Compile the kernels once, before many processes need them: later processes read the cache."""

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
from team.estimation.contribution import Contribution, InitialPoseFactor
from team.estimation.gaussian import curved
from team.estimation.geometry import inverse, logarithm, wrapped
from team.estimation.map_joining.conditioning import Followed, followed, pose_now
from team.estimation.map_joining.gauss_newton import JoinSettings
from team.estimation.map_joining.joining import EMPTY_FOLD, Fold, converged, folded, started
from team.estimation.map_joining.marginals import joint_cost, landmark_blocks, landmark_map
from team.estimation.map_joining.whole_map import WholeMap
from team.estimation.submap import LocalMap
from team.wire.bus import Sample
from team.wire.channels import SUBMAP, channel_of

_VERSIONS = (sys.version, numba.__version__, binding.get_host_cpu_name())
_STEPS = 48
"""Number of one-second steps of the small team's run."""
FORMS = 210
"""Number of forms of kernels that a small team compiles with Hybrid-SLAM and joined submaps."""
PLACES = np.array([[10.0, 0.0], [0.0, 10.0], [10.0, 10.0], [20.0, 10.0], [10.0, 20.0]])
"""Positions [m] of the made-up landmarks."""


def warm_up(estimator: str, fusion: str) -> None:
    """Run a small team of two in memory with estimator and rule, unless this program has done so
    before.

    The robots have different motion models, and the centre's loss is robust, so that kernels of
    both kinds are compiled.
    """
    if not is_warm(estimator, fusion):
        run_small_team(estimator, fusion)
        note_warm(estimator, fusion)


def is_warm(estimator: str, fusion: str) -> bool:
    """Whether the kernels of the two have been compiled by this program."""
    stamp = _stamp(estimator, fusion)
    return stamp is None or stamp.exists()


def note_warm(estimator: str, fusion: str) -> None:
    """Note beside the kernels that they are compiled."""
    stamp = _stamp(estimator, fusion)
    with suppress(OSError):  # then the next launch does it again
        if stamp is not None:
            stamp.touch()


def _stamp(estimator: str, fusion: str) -> Path | None:
    cached = getattr(wrapped, "stats", None)  # with NUMBA_DISABLE_JIT nothing is compiled
    return (
        None if cached is None else Path(cached.cache_path) / f"ready-{_program(estimator, fusion)}"
    )


def _program(estimator: str, fusion: str) -> str:
    """Digest of what the kernels of the two depend on: our sources, the compiler and the
    processor.
    """
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

    The robots have different motion models, and the centre's loss is robust, so that kernels of
    both kinds are compiled.
    """
    for _ in _small_team(estimator, fusion):
        pass
    logarithm(inverse(np.zeros(3)))  # the centre asks this of robots without an initial pose


def run_to_the_first_submap(estimator: str, fusion: str) -> None:
    """The same until the centre has its first submap: this needs most kernels of the robots."""
    for sample in _small_team(estimator, fusion):
        if channel_of(sample.key) == (SUBMAP, "r1"):
            return


def fold_made_up_submaps() -> Fold:
    """The fold of six made-up submaps of two robots: this needs the kernels of the centre alone."""
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
    """A robot's map after two made-up submaps, and its pose there: this needs the kernels by which
    robots find themselves in the team's map.
    """
    first, *later = map(_made_up, range(3))
    found = followed(WholeMap(first.ids, first.mean, first.covariance), later)
    curved(pose_now(found.whole, None).pose)
    return found


def _made_up(k: int) -> LocalMap:
    """The submap of a robot that has moved k metres since it began, and moves another one."""
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
