"""Read calibration measurements from a data set or a log."""

from pathlib import Path

from teamslam.sim.recorded.streams import measurements_in
from teamslam.sim.scenarios.scenario import Scenario, builtin_names
from teamslam.sim.scenarios.source import open_data_set, scenario_beside
from teamslam.sim.world.streams import WorldStreams


def measurements_of(path: Path) -> tuple[WorldStreams, Scenario]:
    """Measurements of a log (`.mcap`) or data set, with its scenario.

    From a log the first incarnation of each robot; from a data set all robots with files. Raises
    DatasetError, LogError or ScenarioError.
    """
    return measurements_in(path) if path.suffix == ".mcap" else open_data_set(path)[:2]


def own_scenario(path: Path) -> str | None:
    """Scenario name of a data set; None for a log."""
    own = None if path.suffix == ".mcap" else scenario_beside(path)
    return own if own not in builtin_names() else None
