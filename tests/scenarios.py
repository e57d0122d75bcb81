import dataclasses
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.world.streams import Detections

NEVER_S = 1e6


def with_world(scenario: Scenario, **fields: object) -> Scenario:
    return replace(scenario, world=replace(scenario.world, **fields))


def with_robots(scenario: Scenario, **fields: object) -> Scenario:
    robots = tuple(replace(robot, **fields) for robot in scenario.robots)
    return replace(scenario, robots=robots)


def with_front_ends(scenario: Scenario, **fields: object) -> Scenario:
    robots = scenario.robots
    changed = (replace(each, front_end=replace(each.front_end, **fields)) for each in robots)
    return replace(scenario, robots=tuple(changed))


def final_only(scenario: Scenario) -> Scenario:
    central = replace(scenario.central, broadcast_s=NEVER_S)
    return replace(with_robots(scenario, pose_s=NEVER_S), central=central)


def scenario_in(folder: Path) -> Scenario:
    return with_options(load(folder / "scenario.toml"), dataset=folder)


def selected(seen: Detections, chosen: np.ndarray) -> Detections:
    """The chosen detections, in the same scans."""
    scan = np.repeat(np.arange(len(seen.stamps_ns)), np.diff(seen.offsets))
    counts = np.bincount(scan[chosen], minlength=len(seen.stamps_ns))
    offsets = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    names = ("ids", "ranges", "bearings")
    return dataclasses.replace(
        seen, offsets=offsets, **{name: getattr(seen, name)[chosen] for name in names}
    )
