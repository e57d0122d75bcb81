"""Calibrated figures with jackknife uncertainty."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import TypeVar

import msgspec
import numpy as np
from scipy.optimize import least_squares

from teamslam.sim.calibration.data import Reference
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.team.shapes import Float

GROUPS = 5  # least number of parts left out in turn

HUBER = 2.0

M = TypeVar("M", bound=msgspec.Struct)
T = TypeVar("T")
Fit = Callable[[Sequence[T]], Mapping[str, float]]


class CalibrationError(ValueError):
    """The data do not determine a figure."""


@dataclass(frozen=True)
class Figure:
    """Calibrated number, named by its place in a scenario."""

    name: str
    value: float
    sigma: float
    unit: str


def huber(
    residual: Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " n"]],
    sigma: Float[np.ndarray, " n"],
    start: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """Minimise Huber's loss of residual/sigma, linear beyond HUBER."""

    def weighted(p: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        return np.asarray(residual(p) / sigma)

    found = least_squares(weighted, start, loss="huber", f_scale=HUBER, x_scale=0.1)
    return np.asarray(found.x)


def groups_of(data: Sequence[Reference]) -> list[list[Reference]]:
    """Robots of each data set; stretches of each if few."""
    pieces = -(-GROUPS // len(data))
    if pieces == 1:
        return [[each] for each in data]
    groups = []
    for each in data:
        first, last = int(each.intervals.end_ns[0]), int(each.intervals.end_ns[-1]) + 1
        edges = np.linspace(first, last, pieces + 1).astype(np.int64)
        groups += [[each.between(int(a), int(b))] for a, b in pairwise(edges)]
    return groups


def jackknife(
    fit: Fit[Reference], data: Sequence[Reference], units: Mapping[str, str]
) -> tuple[Figure, ...]:
    """Fit all data, with uncertainty over `groups_of`."""
    return leave_out_groups(fit, groups_of(data), units)


def leave_out_groups(
    fit: Fit[T], groups: Sequence[Sequence[T]], units: Mapping[str, str]
) -> tuple[Figure, ...]:
    """Fit all groups, with σ² = (G − 1)/G Σ (fit without a group − their mean)² (Efron, Stein
    1981).
    """
    values = fit([part for group in groups for part in group])
    rest = [
        fit([part for j, group in enumerate(groups) if j != i for part in group])
        for i in range(len(groups))
    ]
    figures = []
    for name, value in values.items():
        if not all(name in each for each in rest):
            continue
        without = np.array([each[name] for each in rest])
        spread = float(np.sum((without - without.mean()) ** 2))
        sigma = float(np.sqrt((len(groups) - 1) / len(groups) * spread))
        figures.append(Figure(name, float(value), sigma, units[name]))
    return tuple(figures)


def with_figures(
    scenario: Scenario,
    of_motion: Sequence[Figure],
    of_sensor: Sequence[Figure] = (),
    of_robots: Mapping[str, Sequence[Figure]] = MappingProxyType({}),
) -> Scenario:
    """Scenario with these figures; a robot's own take precedence."""

    def changed(model: M, figures: Sequence[Figure]) -> M:
        kind = type(model)
        return msgspec.convert(nest_figures(msgspec.to_builtins(model), figures, kind), kind)

    robots = tuple(
        msgspec.structs.replace(
            robot,
            motion=changed(robot.motion, of_motion),
            sensor=changed(robot.sensor, (*of_sensor, *of_robots.get(robot.id, ()))),
        )
        for robot in scenario.robots
    )
    return msgspec.structs.replace(scenario, robots=robots)


def nest_figures(
    below: Mapping[str, object], figures: Sequence[Figure], declared: type[msgspec.Struct]
) -> dict[str, object]:
    """Overlay a model's fields: `forward.per_m` is a field of `forward`, and replaces all of it."""
    names = {field.name for field in msgspec.structs.fields(declared)}
    fields = dict(below)
    noises: dict[str, dict[str, float]] = {}
    for figure in figures:
        name, _, part = figure.name.partition(".")
        if part:
            noises.setdefault(name, {})[part] = figure.value
        elif name in names:
            fields[name] = figure.value
    return fields | noises
