"""Add a robot to a data set of CSV tables."""

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import tomli_w

from teamslam.sim.datasets.folder_files import SCENARIO, robots_of
from teamslam.sim.datasets.tables import DatasetError
from teamslam.sim.importing.source import Report, Request, import_data, robot_entry
from teamslam.team.datum import Datum

LANDMARKS = "landmarks.csv"


def takes_robot(folder: Path, robot: str) -> bool:
    """Whether a folder is a data set of sub-folders, and none for this robot."""
    try:
        robots = robots_of(str(folder))
    except DatasetError:
        return False
    return robot not in robots and all((folder / each).is_dir() for each in robots)


def add_robot(request: Request, folder: Path) -> Report:
    """Import one robot into a data set, whose other files and datum stay; raises DatasetError."""
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
    """Text of the data set's scenario with the added robot; empty if it needs no change.

    Raises DatasetError.
    """
    own = _document(added / SCENARIO)
    text = (folder / SCENARIO).read_text("utf-8") if (folder / SCENARIO).exists() else ""
    base = _document(folder / SCENARIO)
    entries = own.get("robots", [{"id": robot}])
    if "robots" not in base:
        if "robots" not in own:
            return ""
        entries = [*({"id": each} for each in robots_of(str(folder))), *entries]
    changed = text or tomli_w.dumps({key: own[key] for key in own if key != "robots"})
    changed += "".join(map(robot_entry, entries))
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
