"""Teams of which a test reads the final map alone."""

from pathlib import Path

import msgspec

from teamslam.sim.scenarios.scenario import Scenario, load, with_options

NEVER_S = 1e6


def final_only(scenario: Scenario) -> Scenario:
    robots = tuple(msgspec.structs.replace(each, pose_s=NEVER_S) for each in scenario.robots)
    central = msgspec.structs.replace(scenario.central, broadcast_s=NEVER_S)
    return msgspec.structs.replace(scenario, robots=robots, central=central)


def scenario_in(folder: Path) -> Scenario:
    return with_options(load(folder / "scenario.toml"), dataset=folder)
