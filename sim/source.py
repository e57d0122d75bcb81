"""The streams of a scenario's world, whichever kind it is."""

from sim.datasets.utias import utias
from sim.scenario import Scenario
from sim.simulator import simulated
from sim.streams import WorldStreams
from sim.worlds import SimulatedWorld


def streams_of(scenario: Scenario) -> WorldStreams:
    """Simulate the world or read its data set; raises DatasetError."""
    if isinstance(scenario.world, SimulatedWorld):
        return simulated(scenario.world, scenario.robots, scenario.seed)
    return utias(scenario.world, scenario.robots)
