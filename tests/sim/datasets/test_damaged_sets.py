"""Data sets with one fault each: the team ends with a sound map, and the fault is named.

The faults are those of sets that people have: files that are missing, foreign barcodes, rows out
of order, gaps. Measurements and repairs themselves are tested in test_utias.
"""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import Evaluation, evaluate
from teamslam.sim.datasets.utias_writer import write_utias
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, dumps, load, loads, with_options
from teamslam.sim.scenarios.source import streams_of, with_present_robots
from teamslam.sim.world.config import SimulatedWorld, UtiasWorld
from teamslam.sim.world.streams import WorldStreams

STEPS = 25


@pytest.fixture(scope="module")
def simulated() -> WorldStreams:
    scenario = with_options(load("waypoints"), robots=2)
    assert isinstance(scenario.world, SimulatedWorld)
    world = msgspec.structs.replace(scenario.world, steps=STEPS, size_m=30.0, landmark_count=12)
    return streams_of(msgspec.structs.replace(scenario, world=world))


def utias(path: Path) -> Scenario:
    """The profile with few particles and the simulated robots' sensors and wheels and clock."""
    scenario = with_options(load("utias"), robots=2, dataset=path)
    assert isinstance(scenario.world, UtiasWorld)
    robots = tuple(
        msgspec.structs.replace(
            robot,
            front_end=msgspec.structs.replace(robot.front_end, particles=20),
            sensor=of.sensor,
            motion=of.motion,
        )
        for robot, of in zip(scenario.robots, load("waypoints").robots, strict=False)
    )
    world = msgspec.structs.replace(scenario.world, odometry_delay_s=0.0)
    return msgspec.structs.replace(scenario, robots=robots, world=world)


def edited(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the rows of a file, its two comment lines apart."""
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:2] + change(lines[2:])) + "\n")


def removed(*names: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            (folder / f"{name}.dat").unlink()

    return change


def changed(kind: str, change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    return lambda folder: edited(folder / f"Robot2_{kind}.dat", change)


def zipped(folder: Path) -> None:
    """The folder becomes a zip of the same name that holds it as MRSLAM_Dataset4."""
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    with zipfile.ZipFile(folder, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"MRSLAM_Dataset4/{name}", content)


@dataclass(frozen=True)
class Fault:
    """Damage to a data set and the notes expected; framed: the map is in the truth's frame."""

    damage: Callable[[Path], None]
    said: tuple[str, ...]
    framed: bool = True
    surveyed: bool = True


NO_START = "no ground truth at its first measurement: its start pose is not known"
FAULTS = {
    "none, in a zip of another name": Fault(zipped, ()),
    "no truth at all": Fault(
        removed("Robot1_Groundtruth", "Robot2_Groundtruth", "Landmark_Groundtruth"),
        (
            "no landmark ground truth: the map's error can not be computed",
            f"r1: {NO_START}",
            f"r2: {NO_START}",
        ),
        framed=False,
        surveyed=False,
    ),
    "no odometry of one robot": Fault(
        removed("Robot2_Odometry"), ("r2: no odometry: only its observations are used",)
    ),
    "gaps": Fault(
        changed("Odometry", lambda rows: rows[:10] + rows[15:]),
        ("r2: odometry has a gap of 6.0 s: its last velocities hold over it",),
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_set_with_a_fault_gives_a_sound_map_and_says_what_is_wrong(
    name: str, simulated: WorldStreams, tmp_path: Path
) -> None:
    fault = FAULTS[name]
    write_utias(simulated, tmp_path / "set")
    fault.damage(tmp_path / "set")
    scenario = utias(tmp_path / "set")
    found = evaluate(run_team(scenario, streams_of(scenario)))
    assert set(fault.said) <= set(found.notes)
    assert bool(found.notes) == bool(fault.said)
    assert_sound(found, fault)


def test_a_set_without_the_files_of_a_robot_is_run_by_the_others(
    simulated: WorldStreams, tmp_path: Path
) -> None:
    write_utias(simulated, tmp_path / "set")
    for path in (tmp_path / "set").glob("Robot1_*"):
        path.unlink()
    asked = utias(tmp_path / "set")
    assert isinstance(asked.world, UtiasWorld)
    world = msgspec.structs.replace(asked.world, unknown_starts=("*", "!r1"))
    scenario, said = with_present_robots(msgspec.structs.replace(asked, world=world))
    assert said == "r1: no files in set; the team is r2"
    found = evaluate(run_team(loads(dumps(scenario)), streams_of(scenario)))
    assert list(found.robots) == ["r2"]
    assert found.map is not None
    assert len(found.map.ids) > 0
    assert found.map.frame == "r2/1"


@pytest.mark.parametrize("gone", [(), ("1", "2")], ids=["none is missing", "all are missing"])
def test_of_a_whole_set_and_of_one_without_robots_nobody_is_left_out(
    simulated: WorldStreams, tmp_path: Path, gone: tuple[str, ...]
) -> None:
    write_utias(simulated, tmp_path / "set")
    for number in gone:
        for path in (tmp_path / "set").glob(f"Robot{number}_*"):
            path.unlink()
    scenario = utias(tmp_path / "set")
    assert with_present_robots(scenario) == (scenario, None)


def assert_sound(found: Evaluation, fault: Fault) -> None:
    assert found.map is not None
    assert found.unsound == 0
    assert len(found.map.ids) >= 4
    assert np.isfinite(found.map.means).all()
    assert np.all(np.linalg.eigvalsh(found.map.covariance) > 0.0)
    assert (found.map.errors is not None) == fault.surveyed
    if fault.framed and found.map.errors is not None:
        assert found.map.errors.rmse_m < 1.5
