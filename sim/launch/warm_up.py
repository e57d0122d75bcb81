"""Compiles the kernels once, before many processes need them: later processes read the cache."""

import msgspec

from sim.in_memory.team import run_team
from sim.scenarios.scenario import load, with_options
from sim.scenarios.source import streams_of
from sim.world.config import SimulatedWorld

_STEPS = 48
"""So many seconds that robots take maps with submaps of theirs that are not in them."""


def warm_up(estimator: str, fusion: str) -> None:
    """Run a small team of two in memory with estimator and rule.

    They move by different models, and the centre's loss is robust: kernels of both kinds are ready.
    """
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
