"""Which kind of data set lies at a path."""

from pathlib import Path
from typing import Literal

from sim.datasets import folder_files, tables, unlabelled
from sim.datasets.tables import DatasetError

Kind = Literal["utias", "folder", "unlabelled"]
UTIAS_MARKER = "Barcodes.dat"


def kind_of(path: str | Path) -> Kind:
    """UTIAS files, CSV tables by robot or of detections; raises DatasetError for what is none."""
    if unlabelled.is_unlabelled(path):
        return "unlabelled"
    if folder_files.has_tables(path):
        return "folder"
    try:
        with tables.opened(str(path), UTIAS_MARKER):
            return "utias"
    except DatasetError as error:
        if not Path(path).exists() or UTIAS_MARKER not in str(error):
            raise
        raise DatasetError(
            f"{error}; or {folder_files.EXPECTED.removeprefix('expected ')}"
        ) from None
