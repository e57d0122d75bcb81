"""Columns that only some rows have: measurement forms, covariances."""

from collections.abc import Sequence

import numpy as np

from teamslam.sim.datasets.csv_table import CsvTable
from teamslam.team.shapes import Float

POSE_COVARIANCE = ("c_xx", "c_xy", "c_yy", "c_xt", "c_yt", "c_tt")


def matrices(packed: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, "N 3 3"]:
    """Symmetric matrices from packed rows (xx, xy, yy, xt, yt, tt)."""
    return packed[:, [0, 1, 3, 1, 2, 4, 3, 4, 5]].reshape(-1, 3, 3)


def numbers_in(
    table: CsvTable, form: tuple[str, ...], forms: Sequence[tuple[str, ...]]
) -> Float[np.ndarray, "R _"]:
    """Numbers of one of the table's forms, NaN in rows of another.

    Raises DatasetError for a row without exactly one form.
    """
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
    """Packed covariance of each row, NaN if absent; raises DatasetError for an incomplete one."""
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
    """Covariances of a table with all their columns; raises DatasetError if some are missing."""
    missing = ", ".join(column for column in POSE_COVARIANCE if not table.has(column))
    if missing:
        raise table.fault(
            f"a covariance has all of {','.join(POSE_COVARIANCE)}: {missing} missing; give 0 where "
            "nothing is correlated"
        )
    return matrices(covariances_of(table, POSE_COVARIANCE))
