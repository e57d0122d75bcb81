"""docs/scenario.md has every field with its values and its default; what pages show does run."""

import re
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import pytest
from msgspec import Meta
from typer.testing import CliRunner

from central.config import BiasSigmas, CentralConfig, CommonBiasSigmas
from sim.cli.main import app
from sim.scenarios.scenario import Scenario, load
from sim.scenarios.source import streams_of
from sim.world.config import (
    FolderWorld,
    LiveWorld,
    Point,
    SimulatedWorld,
    UnlabelledWorld,
    UtiasWorld,
)
from team.config import (
    AssociationSettings,
    Bounds,
    FrontEnd,
    Lens,
    MotionModel,
    MotionNoise,
    RobotConfig,
    Sensor,
)
from tests.support import ROOT

PAGE = ROOT / "docs" / "scenario.md"
STRUCTS: tuple[type[msgspec.Struct], ...] = (
    Scenario, SimulatedWorld, UtiasWorld, FolderWorld, LiveWorld, RobotConfig, MotionModel,
    MotionNoise,
    Sensor,
    Lens, FrontEnd, AssociationSettings, UnlabelledWorld, CentralConfig, BiasSigmas,
    CommonBiasSigmas, Bounds,
)  # fmt: skip


def described(cls: type[msgspec.Struct]) -> dict[str, tuple[str, str]]:
    """What the code says of each field: its values and its default, as the page spells them."""
    fields = msgspec.structs.fields(cls)
    return {field.name: (values_of(field.type), default_of(field)) for field in fields}


def default_of(field: msgspec.structs.FieldInfo) -> str:
    default = field.default
    if field.required:
        return "required"
    if default is None:
        return "absent"
    if isinstance(default, msgspec.Struct):
        return "its defaults"
    if default == ():
        return "`[]`"
    return f"`{msgspec.json.encode(default).decode()}`"


def values_of(declared: Any, bounds: Meta | None = None) -> str:
    """A field's type in the words of TOML, its bounds after it."""
    if get_origin(declared) is Annotated:
        return values_of(declared.__origin__, declared.__metadata__[0])
    if get_origin(declared) is Literal:
        return ", ".join(f'`"{choice}"`' for choice in get_args(declared))
    if get_origin(declared) in {Union, UnionType} and NoneType in get_args(declared):
        (present,) = set(get_args(declared)) - {NoneType}
        return values_of(present)
    if declared == Point:
        return "point"
    if get_origin(declared) is tuple:
        return re.sub(r"^(array|\w+)", r"array of \1s", values_of(get_args(declared)[0]))
    named = {float: "number", int: "integer", str: "text", bool: "boolean"}.get(declared, "table")
    return named + ("" if bounds is None else bounded(bounds))


def bounded(bounds: Meta) -> str:
    limits = {">": bounds.gt, "≥": bounds.ge, "<": bounds.lt, "≤": bounds.le}
    said = [f" {sign} {limit:g}" for sign, limit in limits.items() if limit is not None]
    return ",".join(said).replace("9.22337e+18", "2⁶³ − 1")


def rows_of(page: str, cls: type[msgspec.Struct]) -> dict[str, list[str]]:
    """The cells of the table below the heading that names the class, by field."""
    section = page.partition(f": `{cls.__name__}`\n")[2].partition("\n## ")[0]
    cells = [line.strip("| ").split(" | ") for line in section.splitlines() if "| `" in line[:3]]
    return {name.strip("`"): rest for name, *rest in cells}


@pytest.mark.parametrize("cls", STRUCTS)
def test_the_page_has_every_field_with_its_values_and_its_default(
    cls: type[msgspec.Struct],
) -> None:
    rows = rows_of(PAGE.read_text("utf-8"), cls)
    assert {name: (row[0], row[2]) for name, row in rows.items()} == described(cls)


@pytest.mark.parametrize("cls", STRUCTS)
def test_the_page_gives_each_field_a_unit_and_a_meaning(cls: type[msgspec.Struct]) -> None:
    rows = rows_of(PAGE.read_text("utf-8"), cls)
    assert [name for name, row in rows.items() if len(row) != 4 or not all(row)] == []


@pytest.mark.parametrize("page", ["docs/your_own_world.md", "docs/scenario.md"])
def test_the_scenario_that_a_page_shows_gives_three_robots_their_streams(
    page: str, tmp_path: Path
) -> None:
    shown, *changes = re.findall(r"```toml\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    file = tmp_path / "mine.toml"
    file.write_text(shown, encoding="utf-8")
    streams = streams_of(load(file)).streams
    assert [stream.robot for stream in streams] == ["r1", "r2", "r3"]
    assert all(len(stream.landmark_detections.ids) > 100 for stream in streams)
    for change in changes:
        file.write_text(f'base = "thesis"\n{change}', encoding="utf-8")
        assert load(file) != load("thesis"), "a change of a built-in one"


def test_a_built_in_scenario_that_was_shown_is_the_same_one_as_a_file(tmp_path: Path) -> None:
    shown = CliRunner().invoke(app, ["scenarios", "--show", "waypoints"])
    file = tmp_path / "waypoints.toml"
    file.write_text(shown.stdout, encoding="utf-8")
    assert load(file) == load("waypoints")


def test_a_scenario_that_is_not_built_in_can_not_be_shown() -> None:
    refused = CliRunner().invoke(app, ["scenarios", "--show", "thesis-c"])
    assert refused.exit_code == 2
    assert "thesis, thesis-b, utias" in refused.stderr
