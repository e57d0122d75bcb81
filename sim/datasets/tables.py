"""Text tables in a folder or zip, with exact errors, and measurements by row."""

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from teamslam.sim.world.streams import Detections, grouped, rows_of
from teamslam.team.shapes import Bool, Float, Int64, UInt32

LARGEST = 4e9  # largest number of a data set: the time of the year 2096

File = Path | zipfile.Path


class DatasetError(ValueError):
    """Unreadable data set; the text names file, place and remedy."""


class MarkerError(DatasetError):
    """No folder has the marker file."""


@contextmanager
def open_place(
    path: str, expected: str, damaged: type[DatasetError] = DatasetError
) -> Iterator[File]:
    """Open a folder, or the content of a zip; damaged: error of a file that is none."""
    place = Path(path)
    if not place.exists():
        raise DatasetError(f"{path}: no such file or folder; {expected}")
    if place.is_dir():
        yield place
        return
    try:
        with zipfile.ZipFile(place) as archive:
            yield zipfile.Path(archive)
    except zipfile.BadZipFile as error:
        raise damaged(f"{path}: not a zip, or a damaged one ({error}); {expected}") from None


@contextmanager
def open_data_set(path: str, marker: str) -> Iterator[Mapping[str, File]]:
    """Files by name in the one folder, within `path`, that holds `marker`."""
    with open_place(path, EXPECTED) as root:
        yield _files_beside(root, marker, path)


EXPECTED = (
    "expected the folder or zip of one UTIAS MRCLAM set as it is distributed (Barcodes.dat, "
    "Landmark_Groundtruth.dat, RobotN_Odometry.dat, …). It is not shipped with this program"
)


def table(file: File, columns: tuple[str, ...]) -> Float[np.ndarray, "rows columns"]:
    """Numbers of a white-space table with `#` comments; raises DatasetError."""
    lines = file.read_bytes().decode("utf-8", errors="replace").splitlines()
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        return np.zeros((0, len(columns)))
    try:
        numbers = np.loadtxt(rows, dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise _damage(file.name, lines, columns, str(error)) from None
    within = np.abs(numbers) <= LARGEST
    if numbers.shape[1] != len(columns) or not within.all():
        raise _damage(file.name, lines, columns, "not a table of finite numbers")
    return numbers


def optional_table(
    files: Mapping[str, File], name: str, columns: tuple[str, ...]
) -> Float[np.ndarray, "rows columns"]:
    """Numbers of a table, no rows if missing."""
    return table(files[name], columns) if name in files else np.zeros((0, len(columns)))


def _damage(name: str, lines: list[str], columns: tuple[str, ...], otherwise: str) -> DatasetError:
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        problem = _problem(words, columns) if words else None
        if problem:
            shown = line.strip()[:80]
            return DatasetError(f"{name}, line {number}: {problem}: `{shown}`")
    return DatasetError(f"{name}: {otherwise}")


def _problem(words: list[str], columns: tuple[str, ...]) -> str | None:
    if len(words) != len(columns):
        return f"{len(words)} columns, {len(columns)} expected ({', '.join(columns)})"
    for word, column in zip(words, columns, strict=True):
        try:
            value = float(word)
        except ValueError:
            return f"{column}: {word!r} is not a number"
        if not np.isfinite(value):
            return f"{column}: {word!r} is not finite"
        if abs(value) > LARGEST:
            return f"{column}: {word} is out of bounds"
    return None


def _files_beside(root: File, marker: str, path: str) -> Mapping[str, File]:
    found = [folder for folder in _folders(root, depth=3) if (folder / marker).is_file()]
    if not found:
        raise MarkerError(f"{path}: no {marker} in it; {EXPECTED}")
    if len(found) > 1:
        names = ", ".join(sorted(folder.name for folder in found))
        raise DatasetError(f"{path}: more than one data set in it ({names}); give one of them")
    return {entry.name: entry for entry in found[0].iterdir() if entry.is_file()}


def _folders(folder: File, depth: int) -> Iterator[File]:
    yield folder
    if depth:
        for entry in folder.iterdir():
            if entry.is_dir():
                yield from _folders(entry, depth - 1)


@dataclass(frozen=True)
class Scans:
    """Measurements by time; ids: landmarks, teammate indices, or UTIAS subjects."""

    stamps_ns: Int64[np.ndarray, " R"]
    ids: UInt32[np.ndarray, " R"]
    ranges: Float[np.ndarray, " R"]
    bearings: Float[np.ndarray, " R"]
    points: Float[np.ndarray, "R 2"] | None = None
    covariances: Float[np.ndarray, "R 3"] | None = None

    def where(self, chosen: Bool[np.ndarray, " R"]) -> "Scans":
        """Chosen rows."""
        return rows_of(self, chosen)

    def grouped(self) -> Detections:
        """One message per stamp and form."""
        return grouped(
            self.stamps_ns, self.ids, self.ranges, self.bearings, self.points, self.covariances
        )


def first_of_each(
    stamps_ns: Int64[np.ndarray, " R"],
    ids: UInt32[np.ndarray, " R"],
    usable: Bool[np.ndarray, " R"],
) -> Bool[np.ndarray, " R"]:
    """Mask of the first usable row of each (stamp, id)."""
    rows = np.flatnonzero(usable)
    order = rows[np.lexsort((ids[rows], stamps_ns[rows]))]
    repeated = (np.diff(stamps_ns[order]) == 0) & (np.diff(ids[order].astype(np.int64)) == 0)
    single = usable.copy()
    single[order[1:][repeated]] = False
    return single


def on_circle(angles: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Wrap to (−π, π], leaving the bits of angles inside."""
    turned = (angles + np.pi) % (2.0 * np.pi) - np.pi
    turned = np.where(turned == -np.pi, np.pi, turned)
    return np.where((angles > -np.pi) & (angles <= np.pi), angles, turned)


def count_note(count: int, thing: str, what: str) -> str:
    """Note such as "2 measurements dropped"; empty for none."""
    return f"{count} {thing}{'s' if count != 1 else ''} {what}" if count else ""
