"""Determine the kind of data set at a path."""

import zipfile
from pathlib import Path
from typing import Literal

from teamslam.sim.datasets import folder_files, graph, tables, unlabelled
from teamslam.sim.datasets.tables import DatasetError

Kind = Literal["utias", "folder", "unlabelled", "graph"]
UTIAS_MARKER = "Barcodes.dat"
FORMATS = (
    "expected a folder with a sub-folder for each robot, with odometry.csv and observations.csv, "
    "or a zip of it (docs/your_data.md); a folder with odometry.csv and detections.csv; a ROS 2 "
    "bag; a landmark graph of isam, g2o or pyfg; or the folder or zip of a UTIAS set"
)


def kind_of(path: str | Path) -> Kind:
    """Kind of a data set; raises DatasetError."""
    if not Path(path).exists():
        raise DatasetError(f"{path}: no such file or folder; {FORMATS}")
    if graph.is_graph(path):
        return "graph"
    if unlabelled.is_unlabelled(path):
        return "unlabelled"
    if Path(path).is_file() and not zipfile.is_zipfile(path):
        raise DatasetError(f"{path}: not a zip, or a damaged one, and no landmark graph; {FORMATS}")
    if folder_files.has_tables(path):
        return "folder"
    if (Path(path) / unlabelled.FILES[1]).is_file():
        return "unlabelled"  # its reader reports the missing file
    try:
        with tables.open_data_set(str(path), UTIAS_MARKER):
            return "utias"
    except tables.MarkerError:
        inner = _find_tables_within(Path(path))
        if inner is not None:
            raise DatasetError(
                f"{path}: the data set is in its folder {inner}: give that"
            ) from None
        strays = _other_tables(Path(path))
        if strays:
            shown = f"{', '.join(strays[:4])}{', …' if len(strays) > 4 else ''}"
            raise DatasetError(
                f"{path}: its CSV tables have names of their own ({shown}): `teamslam import "
                f"{path} -o my_set --columns columns.toml` writes a proposal of which are what; "
                "the same command again makes a data set of them"
            ) from None
        raise DatasetError(f"{path}: no data set in it; {FORMATS}") from None


def _other_tables(place: Path) -> list[str]:
    if not place.is_dir():
        return []
    found = [*sorted(place.glob("*.csv")), *sorted(place.glob("*/*.csv"))]
    return [each.relative_to(place).as_posix() for each in found]


def _find_tables_within(place: Path) -> Path | None:
    if not place.is_dir():
        return None
    inner = (each for each in sorted(place.iterdir()) if each.is_dir())
    return next((each for each in inner if folder_files.has_tables(each)), None)
