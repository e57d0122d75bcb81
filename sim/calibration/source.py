"""Read the measurements of a calibration: a data set's, or those of a log."""

from pathlib import Path

import msgspec

from sim.datasets.kinds import UTIAS_MARKER
from sim.datasets.tables import open_data_set as opened_set
from sim.datasets.utias_log import present_robots
from sim.recorded.streams import measurements_in
from sim.scenarios.scenario import Scenario, builtin_names, load, with_options
from sim.scenarios.source import scenario_beside, streams_of, with_present_robots
from sim.world.streams import WorldStreams


def measurements_of(path: Path) -> tuple[WorldStreams, Scenario]:
    """The measurements of a log (`.mcap`) with its scenario, or of a data set with its own.

    Of a log the first incarnation of each robot is used; of a data set all robots that have files
    in it. Raises DatasetError, LogError or ScenarioError.
    """
    if path.suffix != ".mcap":
        scenario = _with_its_robots(path)
        return streams_of(scenario), scenario
    return measurements_in(path)


def own_scenario(path: Path) -> str | None:
    """The name of the scenario that a data set brings with it; a log brings none."""
    own = None if path.suffix == ".mcap" else scenario_beside(path)
    return own if own not in builtin_names() else None


def _with_its_robots(path: Path) -> Scenario:
    """The data set's own scenario with the robots that have files in it, however many."""
    own = scenario_beside(path)
    if own != "utias":
        return with_present_robots(with_options(load(own), dataset=path))[0]
    with opened_set(str(path), UTIAS_MARKER) as files:
        present = present_robots(files)
    scenario = with_options(load("utias"), robots=max(present, default=None), dataset=path)
    robots = tuple(robot for robot in scenario.robots if int(robot.id[1:]) in present)
    return msgspec.structs.replace(scenario, robots=robots or scenario.robots)
