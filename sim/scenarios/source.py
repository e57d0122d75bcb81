"""Streams of a scenario's world of any kind."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from teamslam.sim.datasets import folder_files, graph, tables, unlabelled as unlabelled_files
from teamslam.sim.datasets.folder import folder
from teamslam.sim.datasets.folder_files import robots_of, scenario_in
from teamslam.sim.datasets.graph import graph_world
from teamslam.sim.datasets.kinds import UTIAS_MARKER, kind_of
from teamslam.sim.datasets.tables import DatasetError, open_data_set as open_files
from teamslam.sim.datasets.unlabelled import is_car, unlabelled
from teamslam.sim.datasets.utias import ROBOTS, present_robots, utias
from teamslam.sim.scenarios.document import ScenarioError
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.world.config import (
    FolderWorld,
    GraphWorld,
    LiveWorld,
    SimulatedWorld,
    UnlabelledWorld,
    UtiasWorld,
    starts_unknown,
)
from teamslam.sim.world.identities import Hiding, with_hidden_identities
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.pairs import NEEDS_MAP

READERS: Mapping[type, Callable[[Any, Scenario], WorldStreams]] = {
    UtiasWorld: lambda world, scenario: utias(world, scenario.robots),
    FolderWorld: lambda world, scenario: folder(world, scenario.robots, scenario.central.classes),
    UnlabelledWorld: lambda world, scenario: unlabelled(world, len(scenario.robots)),
    GraphWorld: lambda world, scenario: graph_world(world, len(scenario.robots)),
}
"""Reader of each kind of data set."""
EXPECTED: Mapping[type, str] = {
    UtiasWorld: tables.EXPECTED,
    FolderWorld: folder_files.EXPECTED,
    UnlabelledWorld: unlabelled_files.EXPECTED,
    GraphWorld: graph.EXPECTED,
}
"""Description of each kind of data set, for errors."""


def streams_of(scenario: Scenario) -> WorldStreams:
    """Simulate the world or read its data set; raises DatasetError."""
    world = scenario.world
    if isinstance(world, LiveWorld):
        raise ScenarioError(
            f"{scenario.name}: a live team has no world: its robots' drivers publish the "
            "measurements (docs/your_robot.md); for recorded data give --dataset"
        )
    if isinstance(world, SimulatedWorld):
        seed = _noise_seed(scenario)
        streams = simulate(world, scenario.robots, seed)
        tagged = world.tagged if world.identities == "hidden" else 1.0
        hiding = Hiding(tagged, world.missed, world.clutter, world.visible_to_m)
        hides = world.identities == "hidden" or world.missed > 0.0
        return with_hidden_identities(streams, hiding, seed) if hides else streams
    if not world.path:
        expected = EXPECTED[type(world)]
        raise DatasetError(f"no data set given: name it with --dataset or world.path; {expected}")
    streams = READERS[type(world)](world, scenario)
    known = (
        replace(each, start=None) if starts_unknown(world, each.robot) else each
        for each in streams.streams
    )
    streams = replace(streams, streams=tuple(known))
    hides = world.identities == "hidden" and not isinstance(world, UnlabelledWorld)
    return with_hidden_identities(streams, Hiding(), scenario.seed) if hides else streams


def scenario_beside(path: str | Path) -> str:
    """Scenario of a data set, or the built-in one for its kind."""
    kind = kind_of(path)
    if kind == "graph":
        return "graph"
    own = scenario_in(path)
    if own is not None:
        return str(own)
    if kind == "unlabelled":
        return "victoria" if is_car(path) else "dlr"
    return "utias" if kind == "utias" else "recorded"


def open_data_set(path: str | Path) -> tuple[WorldStreams, Scenario, str | None]:
    """Streams of a data set, its scenario, and a note on robots without files.

    Raises DatasetError, ScenarioError.
    """
    own, robots = scenario_beside(path), None
    if own == "utias":
        with open_files(str(path), UTIAS_MARKER) as files:
            robots = max(ROBOTS, *present_robots(files))
    listed = load(own)
    scenario = with_options(listed, robots=robots, dataset=path)
    scenario, missing = with_present_robots(scenario, listed)
    return streams_of(scenario), scenario, missing


def with_present_robots(
    scenario: Scenario, listed: Scenario | None = None
) -> tuple[Scenario, str | None]:
    """Remove robots without files, with a note; all stay if none has files.

    listed: as it was before `with_options`, which chooses from the robots of a folder.
    """
    world = scenario.world
    if not isinstance(world, FolderWorld | UtiasWorld) or not world.path:
        return scenario, None
    if isinstance(world, FolderWorld):
        present = set(robots_of(world.path))
    else:
        with open_files(world.path, UTIAS_MARKER) as files:
            present = {f"r{number}" for number in present_robots(files)}
    remaining = tuple(robot for robot in scenario.robots if robot.id in present)
    missing = [robot.id for robot in scenario.robots if robot.id not in present]
    if isinstance(world, FolderWorld) and listed is not None:
        names = [robot.id for robot in listed.robots]
        missing = [name for name in names if name not in present] if present & {*names} else []
    if not remaining or not missing:
        return scenario, None
    named = (name for name in world.unknown_starts if name.removeprefix("!") not in missing)
    world = msgspec.structs.replace(world, unknown_starts=tuple(named))
    team = ", ".join(robot.id for robot in remaining)
    note = f"{', '.join(missing)}: no files in {Path(world.path).name}; the team is {team}"
    return msgspec.structs.replace(scenario, robots=remaining, world=world), note


def tells_map(scenario: Scenario, streams: WorldStreams) -> bool:
    """Whether robots receive the landmarks; raises ScenarioError if unknown."""
    needed = scenario.estimator in NEEDS_MAP
    if needed and streams.landmarks is None:
        raise ScenarioError(
            f"the estimator {scenario.estimator} needs a map of the landmarks, "
            f"and {streams.source} has none: choose another estimator"
        )
    return needed


def _noise_seed(scenario: Scenario) -> int:
    """Positive 63-bit seed from scenario name and seed."""
    text = f"{scenario.name}/{scenario.seed}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1
