"""The measurements to calibrate by: a data set's, or those of a log."""

from pathlib import Path

import msgspec

from sim.datasets.kinds import UTIAS_MARKER, kind_of
from sim.datasets.tables import opened as opened_set
from sim.datasets.utias_log import present_robots
from sim.recorded.streams import recorded_streams
from sim.scenarios.scenario import Scenario, ScenarioError, load, loads, with_options
from sim.scenarios.source import scenario_beside, streams_of
from sim.world.streams import WorldStreams
from team.recording.reader import open_log
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Sample, opened

CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.WORLD_CONFIG)


def measurements_of(path: Path) -> tuple[WorldStreams, Scenario]:
    """The measurements of a log (`.mcap`) with its scenario, or of a data set with its own.

    Of a log the first incarnation of each robot is taken; of a set, all robots that it has files
    of. Raises DatasetError, LogError or ScenarioError.
    """
    if path.suffix != ".mcap":
        scenario = _with_its_robots(path)
        return streams_of(scenario), scenario
    messages = [opened(sample)[2] for sample in _samples(path)]
    told = [each.configuration for each in messages if isinstance(each, m.Configuration)]
    by_recorder = open_log(path).metadata.get("scenario")  # of a team without a world
    told = told or ([] if by_recorder is None else [by_recorder])
    if not told:
        raise ScenarioError(f"{path}: the log does not say the world's scenario")
    scenario = loads(told[-1])
    clocks = {robot.id: robot.clock_offset_s for robot in scenario.robots}
    return recorded_streams(messages, path.name, clocks), scenario


def _with_its_robots(path: Path) -> Scenario:
    """The data set's own scenario with the robots that it has files of, however many."""
    if kind_of(path) == "folder":
        return with_options(load(scenario_beside(path)), dataset=path)
    with opened_set(str(path), UTIAS_MARKER) as files:
        present = present_robots(files)
    scenario = with_options(load("utias"), robots=max(present, default=None), dataset=path)
    robots = tuple(robot for robot in scenario.robots if int(robot.id[1:]) in present)
    return msgspec.structs.replace(scenario, robots=robots or scenario.robots)


def _samples(path: Path) -> list[Sample]:
    return list(open_log(path).samples(CHANNELS))
