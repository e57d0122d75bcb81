"""Whatever a user has → a data set's folder."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from sim.datasets.folder import ONE_ROBOT, SCENARIO, is_folder
from sim.datasets.folder_tables import POSES
from sim.datasets.folder_writer import write_folder
from sim.datasets.kinds import kind_of
from sim.datasets.tables import DatasetError
from sim.importing.bag import imported_bag, proposed_topics
from sim.importing.columns import load_map
from sim.importing.files import imported_files, trajectory
from sim.importing.tables import RobotTables
from sim.recorded.streams import recorded_streams
from sim.scenarios.scenario import Scenario, load, loads, with_options
from sim.scenarios.source import scenario_beside, streams_of, with_present_robots
from sim.scenarios.toml import folder_scenario
from sim.world.streams import WorldStreams
from team.recording.reader import LogError, open_log
from team.ros2.bags import BagError, is_bag
from team.ros2.topics import TopicsError, load_topics
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import opened

LOG_CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS, ch.WORLD_CONFIG)
TEAM_PROFILE = b"teamslam"
HEAD = 64


@dataclass(frozen=True)
class Request:
    """What is asked for. starts: by robot (a pose, then two standard deviations or none);
    "" is the only robot. truth: a trajectory of the only robot.
    """

    sources: Sequence[Path]
    robot: str | None = None
    starts: dict[str, tuple[float, ...]] = field(default_factory=dict)
    columns: Path | None = None
    ros2: Path | None = None
    truth: Path | None = None


@dataclass
class Report:
    """What became of it, in words; messages: read from bags."""

    robots: list[str]
    said: list[str]
    messages: int = 0


def imported(request: Request, folder: Path) -> Report:
    """Write the data set; raises DatasetError, LogError, ScenarioError."""
    source = request.sources[0]
    for path in request.sources:
        if not path.exists():
            raise DatasetError(f"{path}: no such file or folder")
    bags = [path for path in request.sources if is_bag(path) and not is_own_log(path)]
    if bags:
        return _bags(request, folder)
    if source.is_file() and source.suffix in (".csv", ".txt", ".tsv"):
        robot = request.robot or ONE_ROBOT
        columns = load_map(request.columns) if request.columns else None
        tables, said = imported_files(request.sources, columns, robot)
        return _written([tables], said, request, folder)
    if len(request.sources) > 1:
        raise DatasetError(f"{request.sources[1]}: one data set or log at a time")
    streams, scenario = _log(source) if is_own_log(source) else _data_set(source)
    write_folder(streams, folder)
    (folder / SCENARIO).write_text(folder_scenario(scenario), "utf-8")
    said = [*streams.notes, *(f"{s.robot}: {note}" for s in streams.streams for note in s.notes)]
    return Report([stream.robot for stream in streams.streams], said)


def proposal(path: Path) -> str:
    """What is in a bag, and the file of topics for it; nothing of what is no bag."""
    if not is_bag(path) or is_own_log(path):
        return ""
    try:
        return proposed_topics(path)
    except BagError as error:
        raise DatasetError(str(error)) from None


def is_own_log(path: Path) -> bool:
    """Whether it is a log of a team."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with path.open("rb") as file:
        return TEAM_PROFILE in file.read(HEAD)


def _log(path: Path) -> tuple[WorldStreams, Scenario]:
    messages = [opened(sample)[2] for sample in open_log(path).samples(LOG_CHANNELS)]
    configured = [each for each in messages if isinstance(each, m.Configuration)]
    if not configured:
        raise LogError(path, "it has no scenario", "import what it was recorded from")
    scenario = loads(configured[-1].configuration)
    clocks = {robot.id: robot.clock_offset_s for robot in scenario.robots}
    return recorded_streams(messages, path.name, clocks), scenario


def _data_set(path: Path) -> tuple[WorldStreams, Scenario]:
    if not is_folder(path):
        kind_of(path)
    scenario = with_options(load(scenario_beside(path)), dataset=path)
    scenario, _ = with_present_robots(scenario)
    return streams_of(scenario), scenario


def _bags(request: Request, folder: Path) -> Report:
    if len(request.sources) > 1 and request.robot:
        raise DatasetError("--robot names one robot: import bags of several one by one")
    try:
        topics = load_topics(request.ros2) if request.ros2 else None
        found = [imported_bag(path, topics, request.robot) for path in request.sources]
    except (BagError, TopicsError) as error:
        raise DatasetError(str(error)) from None
    tables = [each for one in found for each in one.robots]
    names = [each.robot for each in tables]
    if len(set(names)) < len(names):
        raise DatasetError(
            f"two bags have the robots {', '.join(names)}: name them by [robots.NAME] in a file "
            "of topics, --ros2 FILE"
        )
    said = [note for one in found for note in one.said]
    report = _written(tables, said, request, folder)
    report.messages = sum(one.messages for one in found)
    return report


def _written(
    tables: Sequence[RobotTables], said: list[str], request: Request, folder: Path
) -> Report:
    by_name = {each.robot: each for each in tables}
    for name, (x, y, theta, *sigmas) in request.starts.items():
        robot = name or (tables[0].robot if len(tables) == 1 else "")
        if robot not in by_name:
            raise DatasetError(
                f"--start: which robot's? Give ROBOT:x,y,theta with one of {', '.join(by_name)}"
            )
        by_name[robot].start((x, y, theta), sigmas)
    if request.truth is not None:
        if len(tables) != 1:
            raise DatasetError("--truth is the path of one robot: import the robots one by one")
        tables[0].columns["truth"] = ("t_s", *POSES)
        tables[0].rows["truth"] = list(trajectory(request.truth))
    for each in tables:
        each.write(folder)
    mounted = [each for each in tables if any(each.mount)]
    if mounted and not (folder / SCENARIO).exists():
        robots = [
            {"id": each.robot}
            | ({"sensor": {"mount": list(each.mount)}} if any(each.mount) else {})
            for each in tables
        ]
        document = {"base": "recorded", "world": {"path": "."}, "robots": robots}
        (folder / SCENARIO).write_text(tomli_w.dumps(document), "utf-8")
        said.append(f"{SCENARIO}: the models of `recorded`, with the sensors' places on the robots")
    return Report([each.robot for each in tables], said)
