"""Which kind of data set lies at a path."""

from pathlib import Path
from typing import Literal

from sim.datasets import folder, tables
from sim.datasets.tables import DatasetError

Kind = Literal["utias", "folder"]
UTIAS_MARKER = "Barcodes.dat"


def kind_of(path: str | Path) -> Kind:
    """UTIAS files, or CSV tables by robot; raises DatasetError for what is neither."""
    if folder.is_folder(path):
        return "folder"
    try:
        with tables.opened(str(path), UTIAS_MARKER):
            return "utias"
    except DatasetError as error:
        if not Path(path).exists() or UTIAS_MARKER not in str(error):
            raise
        raise DatasetError(f"{error}; or {folder.EXPECTED.removeprefix('expected ')}") from None
