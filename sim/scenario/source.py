"""The streams of a scenario's world, whichever kind it is."""

import hashlib

from sim.datasets.utias import utias
from sim.scenario.checks import ScenarioError
from sim.scenario.scenario import Scenario
from sim.world.simulator import simulated
from sim.world.streams import WorldStreams
from sim.world.worlds import SimulatedWorld
from team.pairs import NEEDS_MAP


def streams_of(scenario: Scenario) -> WorldStreams:
    """Simulate the world or read its data set; raises DatasetError."""
    if isinstance(scenario.world, SimulatedWorld):
        return simulated(scenario.world, scenario.robots, noise_seed(scenario))
    return utias(scenario.world, scenario.robots)


def tells_map(scenario: Scenario, streams: WorldStreams) -> bool:
    """Whether the robots are told the landmarks; raises ScenarioError where nobody knows them."""
    needed = scenario.estimator in NEEDS_MAP
    if needed and streams.landmarks is None:
        raise ScenarioError(
            f"the estimator {scenario.estimator} needs a map of the landmarks, "
            f"and {streams.source} has none: choose another estimator"
        )
    return needed


def noise_seed(scenario: Scenario) -> int:
    """What the world's random numbers are keyed by: the scenario's name and its seed.

    So two scenarios share no noise: what holds over the seeds of one and of the other are two
    findings, not one finding twice. It is a positive integer of 63 bits.
    """
    text = f"{scenario.name}/{scenario.seed}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1
