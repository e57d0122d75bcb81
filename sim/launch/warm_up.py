"""Compiles the kernels once, before many processes need them: later processes read the cache."""

import msgspec

from sim.in_memory.team import run_team
from sim.scenario.scenario import load, with_options
from sim.scenario.source import streams_of
from sim.world.worlds import SimulatedWorld

_STEPS = 24


def warm_up(estimator: str, fusion: str) -> None:
    """Run a small team of two in memory with this estimator and rule."""
    scenario = with_options(load("thesis"), estimator=estimator, fusion=fusion)
    world = scenario.world
    assert isinstance(world, SimulatedWorld)
    small = msgspec.structs.replace(scenario, world=msgspec.structs.replace(world, steps=_STEPS))
    for _ in run_team(small, streams_of(small)):
        pass
