"""Comma-separated tables with named columns and bit-exact numbers."""

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from itertools import chain
from math import isfinite, nan
from typing import TypeVar

import numpy as np

from teamslam.sim.datasets.tables import LARGEST, DatasetError, File
from teamslam.team.shapes import Bool, Float, Int64, UInt32

T = TypeVar("T")
NANO = Decimal(10**9)
SHOWN = 60  # letters of a faulty cell or line in an error
LARGEST_NAME = 2**31 - 1  # largest number of a named landmark


POINT, COMMA = (re.compile(rf"[+-]?[0-9]*{mark}[0-9]+([eE][+-]?[0-9]+)?") for mark in (r"\.", ","))
NAMED = re.compile(r"([A-Za-z](?:.*[^0-9])?)([0-9]+)")  # landmark name: a text with a final number


class UnknownColumnError(DatasetError):
    """Foreign column; header: all of the table."""

    def __init__(self, text: str, header: Sequence[str]) -> None:
        super().__init__(text)
        self.header = header


@dataclass(frozen=True)
class Origin:
    """Column map that a table comes from.

    columns: the user's column and its scale, by ours. unassigned: further columns of the file.
    """

    place: str
    columns: Mapping[str, tuple[str, float]]
    unassigned: Sequence[str] = ()


@dataclass(frozen=True)
class CsvTable:
    """Text cells by column, with the file line of each row; methods that convert raise
    DatasetError.
    """

    name: str
    columns: dict[str, list[str]]
    lines: list[int]
    origin: Origin | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.lines)

    def has(self, *columns: str) -> bool:
        """Whether all these columns exist."""
        return all(column in self.columns for column in columns)

    def numbers(self, *columns: str) -> Float[np.ndarray, "rows columns"]:
        """Finite numbers."""
        taken = [np.array(self._parsed(column, _number)) for column in columns]
        return np.column_stack(taken).astype(np.float64) if taken else np.zeros((len(self), 0))

    def known_numbers(self, *columns: str) -> Float[np.ndarray, "rows columns"]:
        """Finite numbers, NaN in empty cells."""
        taken = [
            np.array(self._parsed(column, lambda text: _number(text) if text else nan))
            for column in columns
        ]
        return np.column_stack(taken).astype(np.float64)

    def stamps(self, column: str, unit_s: Decimal = Decimal(1)) -> Int64[np.ndarray, " rows"]:
        """Exact times in nanoseconds."""
        scale = unit_s * NANO

        def remedy(unit: str, by: str) -> str:
            return self.conversion(column, unit, by)

        parsed = self._parsed(column, lambda text: _stamp_ns(text, scale, remedy))
        return np.array(parsed, dtype=np.int64)

    def names(self, column: str) -> UInt32[np.ndarray, " rows"]:
        """Landmark numbers, or final numbers of texts with one prefix, such as tag36h11:5."""
        ends = [NAMED.fullmatch(cell) for cell in self.columns[column]]
        named = [end for end in ends if end is not None]
        if not named or len(named) < len(ends):
            return np.array(self._parsed(column, _landmark), dtype=np.uint32)
        for row, end in enumerate(named):
            if end[1] != named[0][1]:
                raise self.error(
                    row,
                    column,
                    f"{end[0][:SHOWN]!r} and {named[0][0][:SHOWN]!r} begin differently, and the "
                    "number at the end alone would count: give each landmark a number of its own",
                )
        bare = CsvTable(self.name, {column: [end[2] for end in named]}, self.lines)
        return np.array(bare._parsed(column, _landmark), dtype=np.uint32)

    def rows(self, chosen: Iterable[bool]) -> "CsvTable":
        """Chosen rows."""
        rows = [i for i, each in enumerate(chosen) if each]
        columns = {name: [cells[i] for i in rows] for name, cells in self.columns.items()}
        return replace(self, columns=columns, lines=[self.lines[i] for i in rows])

    def filled(self, needed: Sequence[str]) -> "CsvTable":
        """Omit empty columns, except needed ones.

        All stay if no row has more than the first needed one: a time alone is an empty message.
        """
        empty = {name for name, cells in self.columns.items() if not any(cells)}
        if not set(self.columns) - empty - {*needed[:1]}:
            return self
        columns = {n: cells for n, cells in self.columns.items() if n in needed or n not in empty}
        return replace(self, columns=columns)

    def conversion(self, column: str, unit: str, scale: str) -> str:
        """Remedy for a column in another unit."""
        if self.origin is None or column not in self.origin.columns:
            robot, mark, file = self.name.partition("/")
            named = robot if robot and mark and "/" not in file else "r1"
            return (
                f"to convert from {unit}, add a column map (scale = {scale}), columns.toml, and "
                "import: `teamslam import SET -o NEW --columns columns.toml` converts every "
                f"robot's folder, `teamslam import SET/{named} -o NEW --robot {named} --columns "
                "columns.toml` one (docs/your_data.md)"
            )
        theirs, factor = self.origin.columns[column]
        entry = f'{column} = {{ column = "{theirs}", scale = {factor * float(scale)!r} }}'
        return f"to convert from {unit}, write {entry} in {self.origin.place}"

    def error(self, row: int, column: str, problem: str) -> DatasetError:
        """Error for one cell."""
        return DatasetError(f"{self.name}, line {self.lines[row]}, column {column}: {problem}")

    def refuse(self, rows: Bool[np.ndarray, " rows"], column: str, problem: str) -> None:
        """Raise the error of the first of these rows, if any."""
        if rows.any():
            raise self.error(int(rows.argmax()), column, problem)

    def fault(self, problem: str) -> DatasetError:
        """Error for the table's columns."""
        return DatasetError(f"{self.name}, line 1: {problem}")

    def lack(self, thing: str, forms: Sequence[Sequence[str]]) -> DatasetError:
        """Error for columns that make up none of these forms."""
        given = ", ".join(column for column in self.columns if column in chain(*forms))
        problem = f"no {thing} in its columns" + (f" ({given} alone)" if given else "")
        remedy = f"give {' or '.join(','.join(form) for form in forms)}"
        if self.origin is not None:
            left = ", ".join(self.origin.unassigned) or "none"
            remedy += f" in {self.origin.place}; columns of the file not assigned there: {left}"
        return self.fault(f"{problem}; {remedy}")

    def _parsed(self, column: str, parse: Callable[[str], T]) -> list[T]:
        cells = self.columns[column]
        try:
            return [parse(cell) for cell in cells]
        except ValueError:
            pass
        for row, cell in enumerate(cells):
            try:
                parse(cell)
            except ValueError as error:
                remedy = "correct it, or take the row out"
                raise self.error(row, column, f"{error}; {remedy}") from None
        raise AssertionError(column)


def read_table(file: File, name: str, known: Sequence[str] | None = None) -> CsvTable:
    """Read a table with a header line; skip empty lines and lines with `#`; raises DatasetError.

    known: allowed columns, in either case. Separators may be ; or tabs, decimals then commas. An
    unnamed first column that counts rows is omitted.
    """
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DatasetError(f"{name}: not UTF-8 text ({error.reason}); save it as UTF-8") from None
    lines_of_text = text.splitlines()
    delimiter = _delimiter(lines_of_text)
    rows = csv.reader(lines_of_text, delimiter=delimiter, skipinitialspace=True)
    try:
        header = _header(rows, name)
        lines, cells = [], []
        for row in rows:
            stripped = [cell.strip() for cell in row]
            if any(stripped) and not stripped[0].startswith("#"):
                lines.append(rows.line_num)
                cells.append(stripped)
    except csv.Error as error:
        raise DatasetError(f"{name}, line {rows.line_num}: {error}; check its quotes") from None
    if delimiter != ",":
        cells = _replace_commas(cells)
    if not header[0] and all(row[0] in (str(k), str(k + 1)) for k, row in enumerate(cells)):
        header, cells = header[1:], [row[1:] for row in cells]  # an index, as pandas writes it
    lowered = {column.lower(): column for column in known or ()}
    header = [lowered.get(column.lower(), column) for column in header]
    _check_header(header, name, known)
    if not header[-1] and all(len(row) == len(header) and not row[-1] for row in cells):
        header, cells = header[:-1], [row[:-1] for row in cells]  # each line ends with a comma
    for line, row in zip(lines, cells, strict=True):
        if len(row) != len(header):
            raise DatasetError(
                f"{name}, line {line}: {len(row)} columns, {len(header)} expected "
                f"({', '.join(header)}): `{','.join(row)[:SHOWN]}`"
            )
    by_column = zip(*cells, strict=True) if cells else ([] for _ in header)
    columns = {column: list(each) for column, each in zip(header, by_column, strict=True)}
    return CsvTable(name, columns, lines)


def cells_of(numbers: Float[np.ndarray, "R C"]) -> Sequence[Sequence[object]]:
    """Rows with empty cells for NaN."""
    rows: list[list[object]] = numbers.tolist()
    if not np.isnan(numbers).any():
        return rows
    return [["" if value != value else value for value in row] for row in rows]


def _delimiter(lines: Sequence[str]) -> str:
    first = next((line for line in lines if line.strip() and line.lstrip()[0] != "#"), "")
    return next((mark for mark in (",", ";", "\t") if mark in first), ",")


def _replace_commas(cells: list[list[str]]) -> list[list[str]]:
    if any(POINT.fullmatch(cell) for row in cells for cell in row):
        return cells
    return [[c.replace(",", ".") if COMMA.fullmatch(c) else c for c in row] for row in cells]


def _header(rows: Iterable[list[str]], name: str) -> list[str]:
    for row in rows:
        if row and not row[0].startswith("#"):
            return [column.strip() for column in row]
    raise DatasetError(f"{name}: empty; its first line names the columns, as t_s,landmark,…")


def _check_header(header: list[str], name: str, known: Sequence[str] | None) -> None:
    for i, column in enumerate(header):
        if column in header[:i]:
            raise DatasetError(f"{name}, line 1: two columns are called {column!r}")
        if not column and i + 1 < len(header):
            raise DatasetError(f"{name}, line 1: column {i + 1} has no name; give it one")
        if known is not None and column and column not in known:
            if _is_number(column):
                raise DatasetError(
                    f"{name}, line 1: {column!r} is a number, and the first line names the "
                    f"columns; put a line above it, as {','.join(known[:4])}"
                )
            raise UnknownColumnError(
                f"{name}, line 1: unknown column {column!r}; known: {', '.join(known)}. "
                "`teamslam import` takes other names by a map of columns",
                header,
            )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        comma = "; use a decimal point and no thousands separator" if "," in text else ""
        raise ValueError(f"{text[:SHOWN]!r} is not a number{comma}") from None
    if not isfinite(value):
        raise ValueError(f"{text[:SHOWN]!r} is not finite")
    if abs(value) > LARGEST:
        raise ValueError(f"{text[:SHOWN]} is out of bounds (largest: {LARGEST:g})")
    return value


def _stamp_ns(text: str, scale: Decimal, remedy: Callable[[str, str], str]) -> int:
    try:
        value = Decimal(text) * scale
    except InvalidOperation:
        raise ValueError(
            f"{text[:SHOWN]!r} is not a time in numbers: times are in seconds, since 1970 or since "
            "the start"
        ) from None
    if not value.is_finite() or abs(value) > LARGEST * 1e9:
        raise ValueError(
            f"{text[:SHOWN]} is out of bounds: a time is finite and at most {LARGEST:g} s"
            f"; {remedy(*_unit_of(abs(value) / 10**9))}"
        )
    return int(value.to_integral_value())


def _unit_of(seconds: Decimal) -> tuple[str, str]:
    """Probable unit of a Unix time, and its scale."""
    unit, scale = "nanoseconds", "1e-9"
    for each, by in (("microseconds", "1e-6"), ("milliseconds", "1e-3")):
        if seconds.is_finite() and seconds * Decimal(by) <= LARGEST:
            unit, scale = each, by
    return unit, scale


def _landmark(text: str) -> int:
    try:
        value = int(text.removesuffix(".0"))
    except ValueError:
        raise ValueError(
            f"{text[:SHOWN]!r} is not a whole number, nor are all rows texts that end in one, as "
            "tag36h11:5: give each landmark a number"
        ) from None
    if not 0 <= value <= LARGEST_NAME:
        raise ValueError(f"{value} is out of bounds: a landmark has a number from 0 to 2^31 - 1")
    return value


POSE_COVARIANCE = ("c_xx", "c_xy", "c_yy", "c_xt", "c_yt", "c_tt")


def matrices(packed: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, "N 3 3"]:
    """Symmetric matrices from rows (xx, xy, yy, xt, yt, tt)."""
    return packed[:, [0, 1, 3, 1, 2, 4, 3, 4, 5]].reshape(-1, 3, 3)


def numbers_in(
    table: CsvTable, form: tuple[str, ...], forms: Sequence[tuple[str, ...]]
) -> Float[np.ndarray, "R _"]:
    """Numbers of one of the table's forms, NaN in rows of another; each row has one form."""
    if form not in forms:
        return np.full((len(table), len(form)), np.nan)
    if len(forms) == 1:
        return table.numbers(*form)
    cells = {each: zip(*(table.columns[c] for c in each), strict=True) for each in forms}
    filled = np.array([[any(row) for row in cells[each]] for each in forms]).reshape(len(forms), -1)
    for row in np.flatnonzero(filled.sum(axis=0) != 1)[:1].tolist():
        defect = "in two forms" if filled[:, row].any() else "in no form"
        names = " or ".join(",".join(each) for each in forms)
        raise table.error(
            row, forms[0][0], f"{defect}; a row has {names}, its other cells are empty"
        )
    numbers = table.known_numbers(*form)
    mine = filled[list(forms).index(form)]
    for row in np.flatnonzero(mine & np.isnan(numbers).any(axis=1))[:1].tolist():
        column = form[int(np.isnan(numbers[row]).argmax())]
        raise table.error(row, column, "empty; correct it, or take the row out")
    return numbers


def covariances_of(table: CsvTable, columns: Sequence[str]) -> Float[np.ndarray, "R _"]:
    """Packed covariance of each row, NaN if absent."""
    numbers = table.known_numbers(*columns)
    empty = np.isnan(numbers)
    for row in np.flatnonzero(empty.any(axis=1) & ~empty.all(axis=1))[:1].tolist():
        raise table.error(
            row,
            columns[int(empty[row].argmax())],
            f"no number here; a covariance has all of {','.join(columns)}, or none in this row",
        )
    return numbers


def pose_covariances(table: CsvTable) -> Float[np.ndarray, "N 3 3"]:
    """Covariances of a table with all their columns."""
    missing = ", ".join(column for column in POSE_COVARIANCE if not table.has(column))
    if missing:
        raise table.fault(
            f"a covariance has all of {','.join(POSE_COVARIANCE)}: {missing} missing; give 0 where "
            "nothing is correlated"
        )
    return matrices(covariances_of(table, POSE_COVARIANCE))
