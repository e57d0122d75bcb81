"""Export a log as tables, CSV or Parquet (pyarrow), one per channel with a row per message.

Columns: key, counter, wall_ns, then the message's fields. Arrays are exact numbers with spaces
between in CSV, lists in Parquet. Digests are hexadecimal, lists and tables of parts JSON.
"""

import csv
import json
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from teamslam.team.recording.reader import Log
from teamslam.team.wire.arrays import derivatives, floats, ids, octets, stamps
from teamslam.team.wire.bus import opened
from teamslam.team.wire.channels import Channel, channel_of
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.messages import Digest, Message, Submap, tag_of

HEAD = ("key", "counter", "wall_ns")
LATEST_NS = 2**63 - 1
"""Largest wall clock [ns] of a table; larger ones are from damaged or hostile logs."""
_ARRAYS: dict[str, Callable[[bytes, str], NDArray[Any]]] = {
    **dict.fromkeys(("ids", "counts", "labels", "landmarks", "rows"), ids),
    **dict.fromkeys(("stamps", "nodes"), stamps),
    **dict.fromkeys(("seen", "pairs", "certificate", "signature", "sha256"), octets),
}
"""Decoder of a field's bytes by name; other fields are floats, but for a submap's derivatives."""


@dataclass
class Exported:
    """Rows of each written file, and number of omitted invalid messages."""

    rows: dict[Path, int] = field(default_factory=dict)
    unsound: int = 0


def table_of(channel: Channel, message: Message) -> str:
    """Return the table name: the channel's, or an alternative message's."""
    kind = type(message)
    return channel.name if kind is channel.message else tag_of(kind).partition("/")[0]


def numbers_of(message: Message, name: str) -> NDArray[Any]:
    """Return the numbers in a field's bytes."""
    value: bytes = getattr(message, name)
    if isinstance(message, Submap) and name in ("sensitivity", "curvature"):
        rows = len(message.biases) if name == "sensitivity" else bool(value)
        return derivatives(value, rows * len(message.mean) // 8, name)
    return _ARRAYS.get(name, floats)(value, name)


class CsvTable:
    """One channel's CSV file."""

    def __init__(self, path: Path, kind: type[Message]) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow((*HEAD, *kind.__struct_fields__))

    def add(self, row: Sequence[object], size: int) -> None:
        """Write a row."""
        self._writer.writerow(map(_text, row))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _text(value: object) -> str:
    match value:
        case np.ndarray():
            return " ".join(map(repr, value.tolist()))
        case str():
            return value
        case bool():
            return json.dumps(value)
        case _:
            return repr(value)


GROUP_ROWS = 20_000
GROUP_BYTES = 32 * 2**20  # payload bytes per row group


class ParquetTable:
    """One channel's Parquet file, written by row group; raises ImportError without pyarrow."""

    def __init__(self, path: Path, kind: type[Message]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        types = {"key": pa.string(), "counter": pa.int64(), "wall_ns": pa.int64()}
        for each in msgspec.structs.fields(kind):
            types[each.name] = _arrow_type(pa, each.name, each.type)
        self._schema = pa.schema(list(types.items()))
        self._pa = pa
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd")
        self._rows: list[Sequence[object]] = []
        self._bytes = 0

    def add(self, row: Sequence[object], size: int) -> None:
        """Add a row of a payload of this size."""
        self._rows.append(row)
        self._bytes += size
        if len(self._rows) >= GROUP_ROWS or self._bytes >= GROUP_BYTES:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            arrays = [
                self._pa.array(column, type=each.type)
                for column, each in zip(zip(*self._rows, strict=True), self._schema, strict=True)
            ]
            self._writer.write_table(self._pa.Table.from_arrays(arrays, schema=self._schema))
        self._rows, self._bytes = [], 0

    def close(self) -> None:
        """Write the remaining rows."""
        self._flush()
        self._writer.close()


def export_tables(
    log: Log,
    folder: Path,
    channels: Collection[Channel] | None = None,
    form: type[CsvTable] | type[ParquetTable] = CsvTable,
) -> Exported:
    """Write a table for each non-empty channel (None: all); raises `LogError` or OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    exported, ending = Exported(), "csv" if form is CsvTable else "parquet"
    with ExitStack() as files:
        tables: dict[Path, CsvTable | ParquetTable] = {}
        for sample in log.samples(channels):
            if channel_of(sample.key) is None:  # as of a view
                continue
            try:
                channel, _, message = opened(sample)
            except WireError:
                exported.unsound += 1
                continue
            path = folder / f"{table_of(channel, message)}.{ending}"
            if path not in tables:
                tables[path] = files.enter_context(closing(form(path, type(message))))
            values = [
                _value(message, each.name, each.type) for each in msgspec.structs.fields(message)
            ]
            head = (sample.key, sample.counter, min(sample.wall_ns, LATEST_NS))
            tables[path].add((*head, *values), len(sample.payload))
            exported.rows[path] = exported.rows.get(path, 0) + 1
    return exported


def _arrow_type(pa: Any, name: str, kind: object) -> Any:
    of = getattr(kind, "__origin__", kind)
    if of is bytes and kind != Digest:
        return pa.list_(pa.from_numpy_dtype(_ARRAYS.get(name, floats)(b"", name).dtype))
    scalars = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    return scalars.get(of, pa.string()) if isinstance(of, type) else pa.string()


def _value(message: Message, name: str, kind: object) -> object:
    match value := getattr(message, name):
        case bytes() if kind == Digest:
            return value.hex()
        case bytes():
            return numbers_of(message, name)
        case tuple() | dict() | msgspec.Struct():
            return json.dumps(msgspec.to_builtins(value))
        case _:
            return value
