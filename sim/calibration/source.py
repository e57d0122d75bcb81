"""Read calibration measurements from a data set or a log."""

from pathlib import Path

from teamslam.sim.datasets.kinds import UTIAS_MARKER
from teamslam.sim.datasets.tables import open_data_set as opened_set
from teamslam.sim.datasets.utias import present_robots
from teamslam.sim.recorded.streams import measurements_in
from teamslam.sim.scenarios.scenario import Scenario, builtin_names, load, with_options
from teamslam.sim.scenarios.source import scenario_beside, streams_of, with_present_robots
from teamslam.sim.world.streams import WorldStreams


def measurements_of(path: Path) -> tuple[WorldStreams, Scenario]:
    """Measurements of a log (`.mcap`) or data set, with its scenario.

    From a log the first incarnation of each robot; from a data set all robots with files. Raises
    DatasetError, LogError or ScenarioError.
    """
    if path.suffix != ".mcap":
        scenario = _read_with_its_robots(path)
        return streams_of(scenario), scenario
    return measurements_in(path)


def own_scenario(path: Path) -> str | None:
    """Scenario name of a data set; None for a log."""
    own = None if path.suffix == ".mcap" else scenario_beside(path)
    return own if own not in builtin_names() else None


def _read_with_its_robots(path: Path) -> Scenario:
    """Data set's scenario with all robots that have files."""
    own, robots = scenario_beside(path), None
    if own == "utias":
        with opened_set(str(path), UTIAS_MARKER) as files:
            robots = max(present_robots(files), default=None)
    return with_present_robots(with_options(load(own), robots=robots, dataset=path))[0]
