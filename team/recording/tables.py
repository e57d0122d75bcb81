"""Export a log as tables, one per channel with a row per message: CSV, and Parquet for pandas,
Polars, DuckDB and others.

Columns: key, counter, wall_ns, then the message's fields. In CSV arrays are exactly readable
numbers with spaces between, in Parquet lists of numbers. Digests are hexadecimal, lists and tables
of parts JSON. Parquet needs pyarrow (extra `parquet`), which is imported on call.
"""

import csv
import json
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from numpy.typing import NDArray

from teamslam.team.recording.reader import Log
from teamslam.team.wire.arrays import floats, ids, octets, stamps
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.channels import Channel, channel_of
from teamslam.team.wire.codec import WireError
from teamslam.team.wire.messages import Digest, Message, tag_of

HEAD = ("key", "counter", "wall_ns")
_ARRAYS: dict[str, Callable[[bytes, str], NDArray[Any]]] = {
    "ids": ids,
    "stamps": stamps,
    "nodes": stamps,
    "counts": ids,
    "labels": ids,
    "landmarks": ids,
    "rows": ids,
    "seen": octets,
    "pairs": octets,
    "certificate": octets,
    "signature": octets,
    "sha256": octets,
}
"""Decoder of a field's bytes by name; other fields are floats."""


@dataclass
class Exported:
    """Rows of each written file, and number of invalid messages, which are omitted."""

    rows: dict[Path, int] = field(default_factory=dict)
    unsound: int = 0

    def messages(
        self, log: Log, channels: Collection[Channel] | None
    ) -> Iterator[tuple[Sample, Channel, Message]]:
        """Valid messages of the channels (None: all), without views; others are counted."""
        for sample in log.samples(channels):
            if channel_of(sample.key) is None:
                continue
            try:
                channel, _, message = opened(sample)
            except WireError:
                self.unsound += 1
                continue
            yield sample, channel, message


def table_of(channel: Channel, message: Message) -> str:
    """Table name: the channel's, or an alternative message's."""
    kind = type(message)
    return channel.name if kind is channel.message else tag_of(kind).partition("/")[0]


def numbers_of(name: str, value: bytes) -> NDArray[Any]:
    """Numbers in a field's bytes."""
    return _ARRAYS.get(name, floats)(value, name)


def type_of_numbers(name: str) -> str:
    """NumPy type of a field's numbers."""
    return str(numbers_of(name, b"").dtype)


def export_csv(log: Log, folder: Path, channels: Collection[Channel] | None = None) -> Exported:
    """Write `<channel>.csv` for each non-empty channel (None: all) into `folder`.

    Raises `LogError` for a damaged log, OSError for an unwritable folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    exported = Exported()
    with ExitStack() as files:
        writers: dict[str, tuple[Path, Any]] = {}  # csv does not export its writer's type
        for sample, channel, message in exported.messages(log, channels):
            name = table_of(channel, message)
            if name not in writers:
                path = folder / f"{name}.csv"
                file = files.enter_context(path.open("w", newline="", encoding="utf-8"))
                writers[name] = (path, csv.writer(file, lineterminator="\n"))
                writers[name][1].writerow((*HEAD, *message.__struct_fields__))
            path, writer = writers[name]
            writer.writerow((sample.key, sample.counter, sample.wall_ns, *_cells(message)))
            exported.rows[path] = exported.rows.get(path, 0) + 1
    return exported


def _cells(message: Message) -> list[str]:
    return [
        _cell(field.name, field.type, getattr(message, field.name))
        for field in msgspec.structs.fields(message)
    ]


def _cell(name: str, kind: object, value: object) -> str:
    match value:
        case bytes() if kind == Digest:
            return value.hex()
        case bytes():
            return " ".join(map(repr, numbers_of(name, value).tolist()))
        case str():
            return value
        case bool() | tuple() | dict() | msgspec.Struct():
            return json.dumps(msgspec.to_builtins(value))
        case _:
            return repr(value)


GROUP_ROWS = 20_000
GROUP_BYTES = 32 * 2**20
"""Payload bytes per row group."""


class _Table:
    """One channel's file, collected by column and written by row group."""

    def __init__(self, path: Path, kind: type[Message]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._fields = msgspec.structs.fields(kind)
        types = {"key": pa.string(), "counter": pa.int64(), "wall_ns": pa.int64()}
        for each in self._fields:
            types[each.name] = _arrow_type(pa, each.name, each.type)
        self._schema = pa.schema(list(types.items()))
        self._pa = pa
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd")
        self._columns: list[list[Any]] = [[] for _ in types]
        self._bytes = 0

    def __enter__(self) -> "_Table":
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()
        self._writer.close()

    def add(self, head: tuple[str, int, int], message: Message, size: int) -> None:
        values = [_value(f.name, f.type, getattr(message, f.name)) for f in self._fields]
        for column, value in zip(self._columns, (*head, *values), strict=True):
            column.append(value)
        self._bytes += size
        if len(self._columns[0]) >= GROUP_ROWS or self._bytes >= GROUP_BYTES:
            self._flush()

    def _flush(self) -> None:
        if self._columns[0]:
            arrays = [
                self._pa.array(column, type=each.type)
                for column, each in zip(self._columns, self._schema, strict=True)
            ]
            self._writer.write_table(self._pa.Table.from_arrays(arrays, schema=self._schema))
        self._columns = [[] for _ in self._columns]
        self._bytes = 0


def export_parquet(log: Log, folder: Path, channels: Collection[Channel] | None = None) -> Exported:
    """Write `<channel>.parquet` for each non-empty channel (None: all) into `folder`.

    Memory is bounded by a row group per channel. Raises `LogError` for a damaged log, OSError for
    an unwritable folder, ImportError without pyarrow.
    """
    folder.mkdir(parents=True, exist_ok=True)
    exported = Exported()
    with ExitStack() as files:
        tables: dict[str, tuple[Path, _Table]] = {}
        for sample, channel, message in exported.messages(log, channels):
            name, kind = table_of(channel, message), type(message)
            if name not in tables:
                path = folder / f"{name}.parquet"
                tables[name] = (path, files.enter_context(_Table(path, kind)))
            path, table = tables[name]
            head = (sample.key, sample.counter, min(sample.wall_ns, 2**63 - 1))
            table.add(head, message, len(sample.payload))
            exported.rows[path] = exported.rows.get(path, 0) + 1
    return exported


def _arrow_type(pa: Any, name: str, kind: object) -> Any:
    """Column type of a field, by the class under its annotation's bounds."""
    of = getattr(kind, "__origin__", kind)
    if of is bytes and kind != Digest:
        return pa.list_(pa.from_numpy_dtype(type_of_numbers(name)))
    scalars = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    return scalars.get(of, pa.string()) if isinstance(of, type) else pa.string()


def _value(name: str, kind: object, value: object) -> object:
    match value:
        case bytes() if kind == Digest:
            return value.hex()
        case bytes():
            return numbers_of(name, value)
        case tuple() | dict() | msgspec.Struct():
            return json.dumps(msgspec.to_builtins(value))
        case _:
            return value
