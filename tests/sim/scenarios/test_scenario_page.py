"""docs/scenario.md has every field with its values and default; examples on pages run."""

import re

import msgspec
import pytest

from teamslam.central.config import CentralConfig, CommonBiasSigmas, SurveyedLandmark
from teamslam.sim.scenarios.scenario import Scenario, load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import (
    FolderWorld,
    LiveWorld,
    SimulatedWorld,
    UnlabelledWorld,
    UtiasWorld,
)
from teamslam.team.config import (
    AssociationSettings,
    BiasSigmas,
    Bounds,
    FrontEnd,
    Lens,
    MotionModel,
    MotionNoise,
    RobotConfig,
    Sensor,
)
from teamslam.team.pairs import ESTIMATORS, RULES
from tests.commands import run
from tests.support import ROOT

PAGE = ROOT / "docs" / "scenario.md"
STRUCTS: tuple[type[msgspec.Struct], ...] = (
    Scenario, SimulatedWorld, UtiasWorld, FolderWorld, UnlabelledWorld, LiveWorld, RobotConfig,
    MotionModel, MotionNoise, Sensor, Lens, FrontEnd, AssociationSettings, CentralConfig,
    BiasSigmas, CommonBiasSigmas, SurveyedLandmark, Bounds,
)  # fmt: skip
AT_THE_TOP = {"estimator", "fusion", "seed"}
"""Fields of a robot and the centre that a scenario sets once, for the whole team."""


def described(cls: type[msgspec.Struct]) -> dict[str, str]:
    """Default of each field as the page writes it; empty without a plain default."""
    left_out = AT_THE_TOP if cls in {RobotConfig, CentralConfig} else set()
    fields = msgspec.structs.fields(cls)
    return {field.name: default_of(field) for field in fields if field.name not in left_out}


def default_of(field: msgspec.structs.FieldInfo) -> str:
    if field.required or field.default == () or isinstance(field.default, msgspec.Struct):
        return ""
    if field.default is None:
        return "absent"
    return f"`{msgspec.json.encode(field.default).decode()}`"


def rows_of(page: str, cls: type[msgspec.Struct]) -> dict[str, list[str]]:
    section = page.partition(f": `{cls.__name__}`\n")[2].partition("\n## ")[0]
    cells = [line.strip("| ").split(" | ") for line in section.splitlines() if "| `" in line[:3]]
    return {name.strip("`"): rest for name, *rest in cells}


@pytest.mark.parametrize("cls", STRUCTS)
def test_the_page_has_every_field_with_its_default_its_values_and_a_meaning(cls):
    rows = rows_of(PAGE.read_text("utf-8"), cls)
    expected = described(cls)
    assert rows.keys() == expected.keys()
    assert [name for name in rows if not rows[name][0].startswith(expected[name])] == []
    assert [name for name, row in rows.items() if len(row) != 2 or not all(row)] == []


def test_the_page_has_every_estimator_and_every_rule():
    section = (
        PAGE.read_text("utf-8").partition("## Estimators and rules\n")[2].partition("\n## ")[0]
    )
    first, second = section.partition("| rule |")[::2]
    for table, names in ((first, ESTIMATORS), (second, RULES)):
        cells = re.findall(r"^\| (`.+?) \|", table, re.MULTILINE)
        assert {name for cell in cells for name in re.findall(r"`([^`]+)`", cell)} == {*names}


@pytest.mark.parametrize("page", ["docs/your_own_world.md", "docs/scenario.md"])
def test_the_scenario_that_a_page_shows_gives_three_robots_their_streams(page, tmp_path):
    shown, *changes = re.findall(r"```toml\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    file = tmp_path / "mine.toml"
    file.write_text(shown, encoding="utf-8")
    streams = streams_of(load(file)).streams
    assert [stream.robot for stream in streams] == ["r1", "r2", "r3"]
    assert all(len(stream.landmark_detections.ids) > 100 for stream in streams)
    for change in changes:
        file.write_text(f'base = "thesis"\n{change}', encoding="utf-8")
        assert load(file) != load("thesis"), "a change of a built-in one"


def test_a_built_in_scenario_that_was_shown_is_the_same_one_as_a_file(tmp_path):
    shown = run("scenarios", "--show", "waypoints")
    file = tmp_path / "waypoints.toml"
    file.write_text(shown.stdout, encoding="utf-8")
    assert load(file) == load("waypoints")
