"""A calibration as a readable TOML scenario with uncertainties."""

import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from teamslam.central.config import CentralConfig
from teamslam.sim.calibration.calibrate import Calibration
from teamslam.sim.calibration.figures import Figure, nest_figures
from teamslam.sim.scenarios.document import own_document
from teamslam.sim.scenarios.scenario import Scenario, builtin_names
from teamslam.sim.world.config import FolderWorld, LiveWorld
from teamslam.team.config import AssociationSettings, MotionModel, Sensor

Fields = dict[str, Any]


def scenario_text(
    calibration: Calibration, start: Scenario, own: str | None, sources: Sequence[str], output: Path
) -> str:
    """Text of `output`: the user's scenario, or a built-in base, with the figures.

    Common figures replace all robots' values, except their own. All robots are named if one has own
    figures.
    """
    document = _document_of(start, calibration) if own is None else own_document(own)
    world = document.get("world", {})
    if world.get("path"):
        world["path"] = os.path.relpath(world["path"], output.parent)
    robots: list[Fields] = document.get("robots", [])
    comments = []
    for name, figures, declared in _parts(calibration):
        comments += [f"# {name}.{f.name}: {f.value:.5g} {_uncertainty(f)}" for f in figures]
        first, *inner = name.split(".")
        learnt = nest_figures({}, [_round_figure(figure) for figure in figures], declared)
        if not learnt:
            continue
        below = document.setdefault(first, {})
        for key in inner:
            below = below.setdefault(key, {})
        below |= learnt
        if inner:
            robots = [_without(robot, inner, learnt) for robot in robots]
    own_figures = (*calibration.robots, *calibration.clocks)
    named = own_figures if "robots" in document else (*own_figures, *calibration.team)
    if own_figures:
        known = {robot.get("id") for robot in robots}
        robots += [{"id": name} for name in dict.fromkeys(named) if name not in known]
    by_id = {robot.get("id"): robot for robot in robots}
    for name, figures in calibration.robots.items():
        of_robot = [_round_figure(figure) for figure in figures]
        by_id[name]["sensor"] = nest_figures(by_id[name].get("sensor", {}), of_robot, Sensor)
    for name, clock in calibration.clocks.items():
        comments.append(f"# {name} clock_offset_s: {clock.value:.5g} {_uncertainty(clock)}")
        by_id[name]["clock_offset_s"] = _round_figure(clock).value
    if robots:
        document.pop("robot_count", None)
        document["robots"] = robots
    return "\n".join([*_head(calibration, sources), *comments, "", tomli_w.dumps(document)])


def _document_of(scenario: Scenario, calibration: Calibration) -> Fields:
    """Document with a built-in base; it names robots of a live team or with own figures."""
    world = scenario.world
    otherwise = "recorded" if isinstance(world, FolderWorld | LiveWorld) else "utias"
    base = scenario.name if scenario.name in builtin_names() else otherwise
    document: Fields = {"base": base}
    if isinstance(world, LiveWorld):
        document |= {"name": scenario.name, "team": scenario.team}
        document["world"] = {"kind": "live"} | ({"admit": True} if world.admit else {})
    differ = len({msgspec.json.encode(robot.sensor) for robot in scenario.robots}) > 1
    own = calibration.robots or calibration.clocks or (calibration.by_truth and differ)
    if own or isinstance(world, LiveWorld):
        document["robots"] = [{"id": robot.id} for robot in scenario.robots]
    return document


def _round_figure(figure: Figure) -> Figure:
    return replace(figure, value=float(f"{figure.value:.5g}"))


def _without(table: Fields, path: Sequence[str], keys: Collection[str]) -> Fields:
    if not path:
        return {key: value for key, value in table.items() if key not in keys}
    if path[0] not in table:
        return table
    inner = _without(table[path[0]], path[1:], keys)
    rest = {key: value for key, value in table.items() if key != path[0]}
    return rest | ({path[0]: inner} if inner else {})


def _head(calibration: Calibration, sources: Sequence[str]) -> list[str]:
    how = "ground truth" if calibration.by_truth else "the team's own joined map"
    return [
        f"# Learnt from {', '.join(sources)} by `teamslam calibrate`, against {how}.",
        "# ± is one standard deviation, leaving out one robot (or stretch of time) after another.",
        *(f"# {note}" for note in calibration.notes),
    ]


def _parts(
    calibration: Calibration,
) -> tuple[tuple[str, Sequence[Figure], type[msgspec.Struct]], ...]:
    return (
        ("defaults.motion", calibration.motion, MotionModel),
        ("defaults.sensor", calibration.sensor, Sensor),
        ("defaults.front_end.association", calibration.detections, AssociationSettings),
        ("central", calibration.central, CentralConfig),
    )


def _uncertainty(figure: Figure) -> str:
    return f"± {figure.sigma:.2g} {figure.unit}".rstrip()
