"""Detections without identities in a robot's folder (docs/landmarks_without_names.md)."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from teamslam.sim.datasets.csv_table import CsvTable, cells_of, covariances_of, read_table
from teamslam.sim.datasets.folder_files import DETECTIONS, name_table
from teamslam.sim.datasets.folder_tables import POLAR, POLAR_COVARIANCE, check_polar
from teamslam.sim.datasets.tables import File, on_circle
from teamslam.sim.world.identities import in_order
from teamslam.sim.world.streams import NO_LABEL, Detections
from teamslam.team.shapes import Float, Int64, UInt32

CLASS, RIGHT = "class", "class_probability"
COLUMNS = ("t_s", *POLAR, *POLAR_COVARIANCE, "diameter_m", CLASS, RIGHT)
USUAL_RIGHT = 0.95  # probability that a class is right where the table states none
MOST_CLASSES = 64
LABELS = ("landmark",)
FILES = (DETECTIONS, "labels.csv")


def detections_of(place: File, robot: str, classes: Sequence[str] = ()) -> Detections | None:
    """Read detections without identities, or None; raises DatasetError.

    Rows of one time are a scan; ids are labels, or NO_LABEL.
    """
    table = _read(place, FILES[0], robot, COLUMNS)
    if table is None or not len(table):
        return None
    lacking = [column for column in ("t_s", *POLAR) if not table.has(column)]
    if lacking:
        raise table.fault(f"no column {', '.join(lacking)}; it needs t_s,{','.join(POLAR)}")
    ranges, bearings = table.numbers(*POLAR).T
    check_polar(table, ranges, bearings)
    return scans_of(
        table,
        table.stamps("t_s"),
        ranges.copy(),
        on_circle(bearings),
        labels_of(_read(place, FILES[1], robot, LABELS), len(table)),
        covariances_of(table, POLAR_COVARIANCE) if table.has(*POLAR_COVARIANCE) else None,
        table.known_numbers("diameter_m")[:, 0] if table.has("diameter_m") else None,
        _classes_of(table, classes) if table.has(CLASS) else None,
    )


def scans_of(
    table: CsvTable,
    stamps_ns: Int64[np.ndarray, " R"],
    ranges: Float[np.ndarray, " R"],
    bearings: Float[np.ndarray, " R"],
    labels: UInt32[np.ndarray, " R"],
    covariances: Float[np.ndarray, "R 3"] | None,
    signatures: Float[np.ndarray, " R"] | None,
    classes: Float[np.ndarray, "R C"] | None = None,
) -> Detections:
    """Scans without identities, one per stamp; raises DatasetError."""
    if (np.diff(stamps_ns) < 0).any():
        raise table.fault("its rows are not in order of time")
    table.refuse(ranges < 0.0, "range_m", "below 0")
    first = np.flatnonzero(np.diff(stamps_ns, prepend=stamps_ns[:1] - 1))
    return Detections(
        stamps_ns=stamps_ns[first],
        offsets=np.append(first, len(stamps_ns)).astype(np.int64),
        ids=labels,
        ranges=ranges,
        bearings=bearings,
        covariances=covariances,
        hidden=np.ones(len(first), np.bool_),
        signatures=signatures,
        classes=classes,
    )


def _classes_of(table: CsvTable, names: Sequence[str]) -> Float[np.ndarray, "R C"]:
    """Compute ln P(reported | class): p for the reported one, (1 − p)/(C − 1) for others."""
    number_of = {name: str(number) for number, name in enumerate(names)}
    cells = [number_of.get(cell.strip(), cell) for cell in table.columns[CLASS]]
    for row, cell in enumerate(cells):
        if cell.strip()[:1].isalpha():
            known = ", ".join(names) or "none"
            raise table.error(
                row, CLASS, f"{cell!r} is no name in central.classes, which has {known}"
            )
    reported = CsvTable(table.name, {CLASS: cells}, table.lines).numbers(CLASS)[:, 0]
    right = table.numbers(RIGHT)[:, 0] if table.has(RIGHT) else np.full(len(table), USUAL_RIGHT)
    is_class = (reported >= 0) & (reported < MOST_CLASSES) & (reported == np.floor(reported))
    table.refuse(~is_class, CLASS, f"no class: give a whole number from 0 to {MOST_CLASSES - 1}")
    table.refuse((right <= 0.0) | (right >= 1.0), RIGHT, "not between 0 and 1")
    count = max(2, int(reported.max()) + 1, len(names))
    is_reported = reported[:, np.newaxis] == np.arange(count)
    others = ((1.0 - right) / (count - 1))[:, np.newaxis]
    return np.asarray(np.log(np.where(is_reported, right[:, np.newaxis], others)))


def merge_detections(named: Detections, unnamed: Detections | None) -> Detections:
    """Merge named and unnamed scans by time."""
    if unnamed is None:
        return named
    labelled = replace(named, hidden=np.zeros(len(named.stamps_ns), np.bool_))
    return in_order([labelled, unnamed]) if len(named.stamps_ns) else unnamed


def rows_of(
    seen: Detections,
) -> tuple[Sequence[str], Iterable[tuple[int, Sequence[object]]], Sequence[int]]:
    """Columns of detections.csv, rows (stamp [ns], numbers), labels."""
    numbers = np.column_stack((seen.ranges, seen.bearings))
    columns = ["t_s", *POLAR]
    if seen.covariances is not None:
        numbers = np.hstack((numbers, seen.covariances))
        columns += POLAR_COVARIANCE
    if seen.signatures is not None:
        numbers = np.column_stack((numbers, seen.signatures))
        columns.append("diameter_m")
    if seen.classes is not None:
        best = seen.classes.argmax(axis=1)
        numbers = np.column_stack((numbers, best, np.exp(seen.classes.max(axis=1))))
        columns += (CLASS, RIGHT)
    stamps = np.repeat(seen.stamps_ns, np.diff(seen.offsets)).tolist()
    labels = [-1 if label == NO_LABEL else label for label in seen.ids.tolist()]
    return columns, zip(stamps, cells_of(numbers), strict=True), labels


def split(seen: Detections) -> tuple[Detections, Detections | None]:
    """Separate named scans from unnamed ones (or None)."""
    if seen.hidden is None or not seen.hidden.any():
        return seen, None
    named, unnamed = (seen.take(np.flatnonzero(each)) for each in (~seen.hidden, seen.hidden))
    return _without_empty(named), _without_empty(unnamed)


def _without_empty(seen: Detections) -> Detections:
    optional = ("points", "covariances", "signatures", "classes")
    columns = {name: getattr(seen, name) for name in optional}
    empty: dict[str, Any] = {
        name: None
        for name, values in columns.items()
        if values is not None and np.isnan(values).all()
    }
    return replace(seen, **empty)


def _read(place: File, name: str, robot: str, columns: Sequence[str]) -> CsvTable | None:
    file = place / name
    if not file.is_file():
        return None
    return read_table(file, name_table(place, file, robot), columns)


def labels_of(table: CsvTable | None, rows: int) -> UInt32[np.ndarray, " R"]:
    """Labels, row by row of detections.csv."""
    if table is None:
        return np.full(rows, NO_LABEL, np.uint32)
    if not table.has(*LABELS):
        raise table.fault(f"no column {LABELS[0]}")
    labels = table.numbers(*LABELS)[:, 0].astype(np.int64)
    if len(labels) != rows:
        raise table.fault(f"{len(labels)} rows, {rows} in detections.csv: row by row, one for each")
    return np.where(labels < 0, NO_LABEL, labels).astype(np.uint32)
