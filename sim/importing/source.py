"""Import a user's files, bag, log or data set."""

import re
import tomllib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import tomli_w

from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.sim.datasets.folder import stream_of
from teamslam.sim.datasets.folder_files import ONE_ROBOT, ROBOT_NAME, SCENARIO, robots_of
from teamslam.sim.datasets.folder_tables import POINTS, POLAR, POSES, check_polar
from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.datasets.graph import is_graph
from teamslam.sim.datasets.kinds import kind_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.bag import import_bag, propose_assignment, propose_topics
from teamslam.sim.importing.files import import_files, map_by_names, read_files, trajectory
from teamslam.sim.importing.proposal import (
    drops_by_robot,
    propose_map,
    split_by_robot,
    write_proposal,
)
from teamslam.sim.importing.tables import MEASURED, ColumnMap, Report, RobotTables, load_map
from teamslam.sim.recorded.streams import measurements_in
from teamslam.sim.scenarios.scenario import Scenario, folder_scenario
from teamslam.sim.scenarios.source import open_data_set
from teamslam.sim.world.streams import StartPose, WorldStreams
from teamslam.team.datum import Datum
from teamslam.team.recording.check import holes
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.ros2.bags import BagError, is_bag
from teamslam.team.ros2.topics import TopicsError, load_topics

TEAM_PROFILE, ROS2_PROFILE = b"teamslam", b"ros2"
HEAD = 64  # bytes that contain an MCAP file's profile


@dataclass(frozen=True)
class Request:
    """Import request.

    starts: pose and zero or two standard deviations by robot, "" for the only one. truth:
    trajectory of the only robot. datum: origin of fixes; None: the first one.
    """

    sources: Sequence[Path]
    robot: str | None = None
    starts: dict[str, tuple[float, ...]] = field(default_factory=dict)
    columns: Path | None = None
    ros2: Path | None = None
    truth: Path | None = None
    datum: Datum | None = None


def import_data(request: Request, folder: Path) -> Report:
    """Write the data set; raises DatasetError, LogError, ScenarioError."""
    source = request.sources[0]
    for path in request.sources:
        if not path.exists():
            raise DatasetError(f"{path}: no such file or folder")
    bags = [path for path in request.sources if is_bag(path) and not is_own_log(path)]
    if bags:
        return _bags(request, folder)
    if (
        source.is_file()
        and source.suffix in (".csv", ".txt", ".tsv", ".tum")
        and not is_graph(source)
    ):
        return _csv({request.robot or "": list(request.sources)}, request, folder)
    if source.is_dir() and (request.columns or len(request.sources) > 1 or _is_foreign(source)):
        return _csv(_files_by_robot(request), request, folder)
    if len(request.sources) > 1:
        raise DatasetError(f"{request.sources[1]}: one data set or log at a time")
    return _own_form(request, folder)


def _own_form(request: Request, folder: Path) -> Report:
    source = request.sources[0]
    given = {"--robot": request.robot, "--columns": request.columns, "--truth": request.truth}
    for option in (name for name, value in given.items() if value is not None):
        raise DatasetError(
            f"{option}: {source} has its robots' names and tables already; it goes with CSV files "
            "of other columns and with bags"
        )
    if is_own_log(source):
        streams, scenario, notes = _log(source)
    else:
        streams, scenario, missing = open_data_set(source)
        notes = [] if missing is None else [missing]
    robots = {stream.robot: stream for stream in streams.streams}
    for name, (x, y, theta, *sigmas) in request.starts.items():
        robot = _robot_of_start(name, robots)
        pose = np.array([x, y, theta])
        variances = [sigmas[0] ** 2, sigmas[0] ** 2, sigmas[1] ** 2] if sigmas else None
        start = StartPose(pose, None if variances is None else np.diag(variances))
        robots[robot] = replace(robots[robot], start=start)
    for name in [each for each, stream in robots.items() if not len(stream.intervals.end_ns)]:
        del robots[name]
        notes.append(f"{name} has no odometry and is left out")
    write_folder(replace(streams, streams=tuple(robots.values())), folder)
    (folder / SCENARIO).write_text(folder_scenario(scenario), "utf-8")
    notes += [*streams.notes, *(f"{s.robot}: {note}" for s in streams.streams for note in s.notes)]
    return Report(list(robots), notes)


def _robot_of_start(name: str, robots: Collection[str]) -> str:
    robot = name or (next(iter(robots)) if len(robots) == 1 else "")
    if robot not in robots:
        raise DatasetError(
            f"--start: which robot's? Give ROBOT:x,y,theta with one of {', '.join(robots)}"
        )
    return robot


def _is_foreign(source: Path) -> bool:
    try:
        kind_of(source)
    except DatasetError:
        return bool([*source.glob("*.csv"), *source.glob("*/*.csv")])
    return False


def _files_by_robot(request: Request) -> dict[str, list[Path]]:
    """CSV files by robot: of a folder ("" if nothing names its robot), its sub-folders, or each
    given folder; files beside robots' folders are every robot's.
    """
    found: dict[str, list[Path]] = {}
    for source in request.sources:
        if not source.is_dir():
            raise DatasetError(f"{source}: give folders, one for each robot, or files of one robot")
        inner = {each.name: sorted(each.glob("*.csv")) for each in sorted(source.iterdir())}
        inner = {name: files for name, files in inner.items() if files}
        common = sorted(source.glob("*.csv"))
        if inner and request.robot:
            raise DatasetError(
                f"--robot {request.robot}: {source} has a folder for each robot, "
                f"{', '.join(inner)}, which names it; rename the folder"
            )
        if inner:
            found |= {name: [*files, *common] for name, files in inner.items()}
        elif len(request.sources) == 1:
            found[request.robot or ""] = common
        else:
            found[source.name] = common
    for name in found:
        if name and not re.fullmatch(ROBOT_NAME, name):
            raise DatasetError(
                f"{name}: no robot's name: a small letter, then small letters, digits and _ (32 at "
                "most); rename the folder"
            )
    return found


def _csv(paths: Mapping[str, Sequence[Path]], request: Request, folder: Path) -> Report:
    is_given = request.columns is not None and request.columns.exists()
    read = {robot: read_files(of, tum=not is_given) for robot, of in paths.items()}
    columns = None
    if is_given:
        assert request.columns is not None
        columns = load_map(request.columns)
        robots = _files_by_map(read, columns, request.columns)
        maps = {robot: columns.tables_of(robot) for robot in robots}
    else:
        robots = {robot or ONE_ROBOT: files for robot, files in read.items()}
        found = {robot: map_by_names(files) for robot, files in robots.items()}
        maps = {robot: own for robot, own in found.items() if own is not None}
        if len(maps) < len(robots) or request.columns is not None:
            raise _question(read.get("", {}), robots, request, folder)
    everyones = {name for files in read.values() for name in files}
    tables, notes = [], list[str]()
    for robot, files in robots.items():
        places = {} if columns is None else columns.places_of(robot, request.columns)
        of, noted = import_files(files, maps[robot], robot, everyones, places)
        tables.append(of)
        notes += noted if len(robots) == 1 else [f"{robot}: {note}" for note in noted]
    used = {name for files in robots.values() for name in files}
    notes += [f"{name}: not used: the map does not name it" for name in sorted(everyones - used)]
    return _written(tables, notes, request, folder)


def _files_by_map(
    read: Mapping[str, Mapping[str, CsvTable]], columns: ColumnMap, path: Path
) -> Mapping[str, Mapping[str, CsvTable]]:
    if "" not in read:
        for robot in columns.robots:
            if robot not in read:
                raise DatasetError(
                    f"{path}: [robots.{robot}]: no files of such a robot; there are "
                    f"{', '.join(read)}"
                )
        return read
    if not columns.robots:
        return {ONE_ROBOT: read[""]}
    endings = {
        robot: tuple(name for table in columns.tables_of(robot).values() for name in table.files)
        for robot in columns.robots
    }
    return {
        robot: {name: table for name, table in read[""].items() if name.endswith(ending)}
        for robot, ending in endings.items()
    }


def _question(
    of_all: Mapping[str, CsvTable],
    robots: Mapping[str, Mapping[str, CsvTable]],
    request: Request,
    folder: Path,
) -> DatasetError:
    split, drops = split_by_robot(of_all), drops_by_robot(of_all)
    by_column = dict.fromkeys(drops, of_all)
    proposed = propose_map(split or by_column or robots, drops={} if split else drops)
    if request.columns is not None:
        return write_proposal(proposed, request.columns)
    name, table = next(
        (name, table)
        for files in robots.values()
        if map_by_names(files) is None
        for name, table in files.items()
        if map_by_names({name: table}) is None
    )
    command = f"teamslam import {' '.join(map(str, request.sources))} -o {folder}"
    command += f" --robot {request.robot}" if request.robot else ""
    return DatasetError(
        f"{name}: its columns are {', '.join(table.columns)}. Which are what? "
        f"Write it into a file, as columns.toml, beginning with this:\n\n{proposed}"
        f"\nand type: {command} --columns columns.toml (where there is no such file, this writes "
        "it)"
    )


def proposal(path: Path) -> str:
    """Describe a bag's topics, with a proposed assignment; empty for other paths."""
    if not is_bag(path) or is_own_log(path):
        return ""
    try:
        return propose_topics(path)
    except BagError as error:
        raise DatasetError(str(error)) from None


def is_own_log(path: Path) -> bool:
    """Whether a file is a team's log."""
    return _is_mcap_of(path, TEAM_PROFILE)


def is_ros2_bag(path: Path) -> bool:
    """Whether a path is a bag, an MCAP file by its profile."""
    return is_bag(path) and (path.suffix != ".mcap" or _is_mcap_of(path, ROS2_PROFILE))


def _is_mcap_of(path: Path, profile: bytes) -> bool:
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with path.open("rb") as file:
        return profile in file.read(HEAD)


def _log(path: Path) -> tuple[WorldStreams, Scenario, list[str]]:
    lacks = [f"{path} is not whole, {finding}" for finding in holes(open_log(path))]
    try:
        return *measurements_in(path), lacks
    except LogError as error:
        raise DatasetError("; ".join([*lacks, str(error)])) from None


def _bags(request: Request, folder: Path) -> Report:
    if len(request.sources) > 1 and request.robot:
        raise DatasetError("--robot names one robot: import bags of several one by one")
    try:
        if request.ros2 is not None and not request.ros2.exists():
            proposed = "\n".join(map(propose_assignment, request.sources))
            raise write_proposal(proposed, request.ros2)
        topics = load_topics(request.ros2) if request.ros2 else None
        found, datum = [], request.datum
        for path in request.sources:
            found.append(import_bag(path, topics, request.robot, datum))
            datum = found[-1].datum or datum
    except (BagError, TopicsError) as error:
        raise DatasetError(str(error)) from None
    names = [name for one in found for name in one.robots]
    if len(set(names)) < len(names):
        raise DatasetError(
            f"two bags have the robots {', '.join(names)}: name them by [robots.NAME] in a file "
            "of topics, --ros2 FILE"
        )
    tables = [each for one in found for each in one.tables]
    notes = [note for one in found for note in one.notes]
    report = _written(tables, notes, request, folder, datum)
    report.messages = sum(one.messages for one in found)
    return report


def _written(
    tables: Sequence[RobotTables],
    notes: list[str],
    request: Request,
    folder: Path,
    datum: Datum | None = None,
) -> Report:
    by_name = {each.robot: each for each in tables}
    _refuse_shared_truth(tables)
    if not any(kind in each.rows for each in tables for kind in MEASURED):
        raise DatasetError(
            f"{request.sources[0]}: neither odometry nor observations in it; give a folder with "
            "them, or with one folder for each robot, or say by --columns (of bags: --ros2) which "
            "are what"
        )
    for name, (x, y, theta, *sigmas) in request.starts.items():
        by_name[_robot_of_start(name, by_name)].start((x, y, theta), sigmas)
    if request.truth is not None:
        if len(tables) != 1:
            raise DatasetError(
                "--truth is the path of one robot; of several, put each robot's into its folder "
                "and name the file as [truth] in the map of columns, --columns FILE (of bags: as "
                "`truth` in the file of topics, --ros2 FILE)"
            )
        tables[0].columns["truth"] = ("t_s", *POSES)
        tables[0].rows["truth"] = list(trajectory(request.truth))
    for each in tables:
        each.write(folder)
    notes += _write_scenario(tables, datum, folder / SCENARIO)
    return Report([each.robot for each in tables], notes, tables=tables)


def _refuse_shared_truth(tables: Sequence[RobotTables]) -> None:
    of: dict[tuple[str, tuple[int, ...]], str] = {}
    for each in tables:
        if (truth := each.sources.get("truth")) is None or not len(truth):
            continue
        other = of.setdefault((truth.name, tuple(truth.lines)), each.robot)
        if other != each.robot:
            raise DatasetError(
                f"{truth.name}: the truth of both {other} and {each.robot}: give it to its robot, "
                f"as [robots.{other}.truth] in the map of columns; where it has the paths of both, "
                "give each robot such a table whose `drop` leaves out the other's rows"
            )


def _write_scenario(tables: Sequence[RobotTables], datum: Datum | None, path: Path) -> list[str]:
    robots = []
    for each in tables:
        own: dict[str, object] = {"id": each.robot}
        if any(each.mount):
            own["sensor"] = {"mount": list(each.mount)}
        if any(each.antenna):
            own["gnss"] = {"antenna": list(each.antenna)}
        robots.append(own)
    if datum is None and all(len(own) == 1 for own in robots):
        return []
    origin = "" if datum is None else f"datum {datum.latitude_deg}, {datum.longitude_deg}"
    if path.exists():
        kept = f"{path.name} exists and is kept: it needs [central.datum], {origin}"
        return [kept] if origin else []
    document: dict[str, object] = {"base": "recorded", "world": {"path": "."}}
    notes = [f"{path.name}: the models of `recorded`, with the sensors' places on the robots"]
    if datum is not None:
        document["central"] = {"datum": msgspec.to_builtins(datum)}
        notes.append(f"fixes are east and north of the {origin}")
    path.write_text(tomli_w.dumps(document) + "".join(map(_robot_entry, robots)), "utf-8")
    return notes


def _robot_entry(robot: Mapping[str, Any]) -> str:
    """TOML text of a robot's name, and the places of sensor and antenna."""
    places = [
        f"{part}.{name} = {place}\n"
        for part in ("sensor", "gnss")
        for name, place in robot.get(part, {}).items()
    ]
    return f'\n[[robots]]\nid = "{robot["id"]}"\n{"".join(places)}'


LANDMARKS = "landmarks.csv"


def takes_robot(folder: Path, robot: str) -> bool:
    """Whether a folder is a data set of sub-folders without this robot."""
    try:
        robots = robots_of(str(folder))
    except DatasetError:
        return False
    return robot not in robots and all((folder / each).is_dir() for each in robots)


def add_robot(request: Request, folder: Path) -> Report:
    """Import one robot into a data set, whose other files and datum stay."""
    assert request.robot is not None
    with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as place:
        added = Path(place)
        datum = _datum_in(folder / SCENARIO)
        report = import_data(replace(request, datum=datum), added)
        if report.robots != [request.robot]:
            raise DatasetError(
                f"--robot {request.robot}: {request.sources[0]} has the robots "
                f"{', '.join(report.robots)}; one robot at a time is added to {folder}"
            )
        own = _datum_in(added / SCENARIO)
        if own not in (None, datum) and (folder / SCENARIO).exists():
            raise DatasetError(
                f"{folder / SCENARIO}: its [central.datum] is not that of {request.robot}'s fixes, "
                f"{own.latitude_deg}, {own.longitude_deg}: state one datum for both, here and as "
                "[datum] in the file of topics"
            )
        scenario = _with_robot(folder, added, request.robot)
        if (added / LANDMARKS).exists():
            if (folder / LANDMARKS).exists():
                report.notes.append(f"{LANDMARKS}: that of {folder} is kept")
            else:
                (added / LANDMARKS).rename(folder / LANDMARKS)
        (added / request.robot).rename(folder / request.robot)
        if scenario:
            (folder / SCENARIO).write_text(scenario, "utf-8")
            report.notes.append(f"{SCENARIO}: {request.robot} is added to its robots")
    return report


def _with_robot(folder: Path, added: Path, robot: str) -> str:
    """Text of the scenario with the added robot; empty if it needs no change."""
    own = _document(added / SCENARIO)
    text = (folder / SCENARIO).read_text("utf-8") if (folder / SCENARIO).exists() else ""
    base = _document(folder / SCENARIO)
    entries = own.get("robots", [{"id": robot}])
    if "robots" not in base:
        if "robots" not in own:
            return ""
        entries = [*({"id": each} for each in robots_of(str(folder))), *entries]
    changed = text or tomli_w.dumps({key: own[key] for key in own if key != "robots"})
    changed += "".join(map(_robot_entry, entries))
    try:
        tomllib.loads(changed)
    except tomllib.TOMLDecodeError:
        raise DatasetError(
            f"{folder / SCENARIO}: its robots are written as an array: add {robot} to it, "
            "after that the files by a folder of its name"
        ) from None
    return changed


def _datum_in(path: Path) -> Datum | None:
    found = _document(path).get("central", {}).get("datum")
    return None if found is None else msgspec.convert(found, Datum)


def _document(path: Path) -> Mapping[str, Any]:
    return tomllib.loads(path.read_text("utf-8")) if path.exists() else {}


def check_sources(robots: Iterable[RobotTables]) -> None:
    """Convert the users' tables as a data set's are: the first fault names file, line and map
    entry.
    """
    for robot in robots:
        tables = {kind: table for kind, table in robot.sources.items() if len(table)}
        if not tables.keys().isdisjoint(("odometry", "observations")):
            sighted = tables.get("sightings")
            mates = () if sighted is None else sighted.columns["teammate"]
            stream_of(robot.robot, tables, tuple(dict.fromkeys([robot.robot, *mates])))
        _check_detections(tables.get("detections"))


def _check_detections(table: CsvTable | None) -> None:
    if table is None:
        return
    if not table.has(*POLAR):
        raise table.lack("measurement", (POLAR, POINTS))
    ranges, bearings = table.numbers(*POLAR).T
    check_polar(table, ranges, bearings)
