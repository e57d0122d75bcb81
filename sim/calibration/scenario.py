"""A calibration as a scenario in TOML that a user can read, with each figure's uncertainty."""

from collections.abc import Sequence

import msgspec

from central.config import CentralConfig
from sim.calibration.calibrate import Calibration
from sim.calibration.figures import Figure, nested
from sim.scenarios.scenario import Scenario, builtin_names
from sim.world.config import FolderWorld, LiveWorld
from team.config import AssociationSettings, MotionModel, Sensor


def scenario_toml(calibration: Calibration, scenario: Scenario, sources: Sequence[str]) -> str:
    """A TOML document whose `base` is the scenario's name if it is built in, else its data
    set's.
    """
    world = scenario.world
    otherwise = "recorded" if isinstance(world, FolderWorld | LiveWorld) else "utias"
    base = scenario.name if scenario.name in builtin_names() else otherwise
    how = "ground truth" if calibration.by_truth else "the team's own joined map"
    lines = [
        f"# Learnt from {', '.join(sources)} by `teamslam calibrate`, against {how}.",
        "# ± is one standard deviation, leaving out one robot (or stretch of time) after another.",
        *(f"# {note}" for note in calibration.notes),
        f'base = "{base}"',
    ]
    if isinstance(world, LiveWorld):
        lines += [f'name = "{scenario.name}"', f'team = "{scenario.team}"']
        lines += ["", "[world]", 'kind = "live"', *(["admit = true"] if world.admit else [])]
    parts = (
        ("defaults.motion", calibration.motion, MotionModel),
        ("defaults.sensor", calibration.sensor, Sensor),
        ("defaults.front_end.association", calibration.detections, AssociationSettings),
        ("central", calibration.central, CentralConfig),
    )
    for name, figures, declared in parts:
        if figures:
            lines += ["", f"[{name}]", *_table(figures, declared)]
    differ = len({msgspec.json.encode(robot.sensor) for robot in scenario.robots}) > 1
    by_robot = calibration.robots or (calibration.by_truth and differ)
    for robot in scenario.robots if by_robot or isinstance(world, LiveWorld) else ():
        fields = nested({}, calibration.robots.get(robot.id, ()), Sensor)
        own = [f"sensor = {_inline(fields)}"] if fields else []
        lines += ["", "[[robots]]", f'id = "{robot.id}"', *own]
    return "\n".join(lines) + "\n"


def _inline(value: object) -> str:
    """A number, or a table of numbers and tables, on one line."""
    if not isinstance(value, dict):
        return f"{value:.5g}"
    return "{ " + ", ".join(f"{key} = {_inline(each)}" for key, each in value.items()) + " }"


def _table(figures: Sequence[Figure], declared: type[msgspec.Struct]) -> list[str]:
    fields = nested({}, figures, declared)
    lines = []
    for figure in figures:
        if figure.name in fields:
            lines.append(f"{figure.name} = {figure.value:.5g}  # {_uncertainty(figure)}")
        elif "." not in figure.name:
            lines.append(f"# {figure.name}: {figure.value:.5g} {_uncertainty(figure)}")
    for name, value in fields.items():
        if isinstance(value, dict):
            inner = ", ".join(f"{key} = {number:.5g}" for key, number in value.items())
            marks = [
                f"{f.name.partition('.')[2]} {_uncertainty(f)}"
                for f in figures
                if f.name.startswith(f"{name}.")
            ]
            lines.append(f"{name} = {{ {inner} }}  # {', '.join(marks)}")
    return lines


def _uncertainty(figure: Figure) -> str:
    return f"± {figure.sigma:.2g} {figure.unit}".rstrip()
