"""Scenario files beside written data sets."""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import tomli_w

from teamslam.central.config import CentralConfig
from teamslam.sim.scenarios.checks import TOP_LEVEL
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.world.config import UtiasWorld, starts_unknown
from teamslam.team.config import RobotConfig


def data_set_scenario(scenario: Scenario) -> str:
    """Same robots and centre, for the UTIAS set in this text's folder; robots are r1, r2, …"""
    ids = [f"r{i}" for i in range(1, len(scenario.robots) + 1)]
    return _text(scenario, ids, {"kind": "utias"} | _chosen(UtiasWorld(path="."), UtiasWorld, ()))


def folder_scenario(scenario: Scenario) -> str:
    """Same robots and centre, for the tables in this text's folder."""
    ids = [robot.id for robot in scenario.robots]
    unknown = [robot for robot in ids if starts_unknown(scenario.world, robot)]
    world: dict[str, Any] = {"kind": "folder", "path": "."}
    return _text(scenario, ids, world | ({"unknown_starts": unknown} if unknown else {}))


def _text(scenario: Scenario, ids: Sequence[str], world: Mapping[str, Any]) -> str:
    head = {name: getattr(scenario, name) for name in ("name", *TOP_LEVEL, "exchange")}
    robots = [
        {"id": name} | _chosen(robot, RobotConfig, ("id", *TOP_LEVEL))
        for name, robot in zip(ids, scenario.robots, strict=True)
    ]
    central = _chosen(scenario.central, CentralConfig, TOP_LEVEL)
    document = head | {"world": world} | ({"central": central} if central else {})
    return tomli_w.dumps(document | {"robots": robots})


def _chosen(
    value: msgspec.Struct, declared: type[msgspec.Struct], without: tuple[str, ...]
) -> dict[str, Any]:
    """Non-default fields."""
    chosen: dict[str, Any] = {}
    for field in msgspec.structs.fields(declared):
        part = getattr(value, field.name)
        if field.name in without or part is None or part == field.default:
            continue
        table = isinstance(part, msgspec.Struct)
        chosen[field.name] = _chosen(part, type(part), ()) if table else part
    return chosen
