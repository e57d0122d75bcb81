"""Write samples into an MCAP file with unchanged payload bytes.

Channel: full key, encoding `msgpack`, JSON Schema of its message (docs/wire.md); views use those of
their viewers. Log time: team time, at least 0. Publish time: publisher's wall clock. Sequence:
counter modulo 2³². The metadata record "teamslam" describes run and program.
"""

import json
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, NamedTuple, Self

import msgspec
from mcap.writer import Writer

from teamslam.team.wire.bus import Sample
from teamslam.team.wire.channels import channel_of
from teamslam.team.wire.codec import tag_in
from teamslam.team.wire.messages import Message, tag_of
from teamslam.team.wire.views import json_schema, view_of


def schema_of(message: type[Message]) -> bytes:
    """Return the JSON Schema of a message as UTF-8 bytes, deterministic."""
    return json.dumps(msgspec.json.schema(message), sort_keys=True).encode()


class Declaration(NamedTuple):
    """A key's payload encoding, schema name and text."""

    encoding: str
    schema: str
    schema_encoding: str
    text: bytes


def declaration_of(key: str, tag: str = "") -> Declaration | None:
    """Return the declaration of a relative key, of a message's tag if it has several, or None."""
    found = channel_of(key)
    if found is not None:
        kind = found[0].kind_of(tag)
        return Declaration("msgpack", tag_of(kind), "jsonschema", schema_of(kind))
    view = view_of(key)
    if view is None:
        return None
    if isinstance(view.schema, str):
        from mcap_protobuf.schema import build_file_descriptor_set  # needed for views only

        name = view.schema.removeprefix("foxglove.")
        kind_there = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
        files = build_file_descriptor_set(kind_there).SerializeToString()
        return Declaration("protobuf", view.schema, "protobuf", files)
    name = f"teamslam.{view.schema.__name__}"
    text = json.dumps(json_schema(view.schema), sort_keys=True).encode()
    return Declaration("json", name, "jsonschema", text)


METADATA = "teamslam"
CHUNK_NS = 500_000_000  # largest span of wall time in a chunk, since a flipped bit costs a chunk …
CHUNK_LEAST = 16  # … unless the chunk has fewer messages than this
MOST_CHANNELS = 60_000  # most keys of a log; MCAP numbers them with 16 bits
FLUSH_S = 0.5  # seconds between flushes: the loss of a killed recorder


class RecorderError(RuntimeError):
    """The log cannot be written: existing file, missing folder, full disk."""


class Recorder:
    """Write one log on a thread, whose errors the next call raises as `RecorderError`."""

    def __init__(self, path: str | Path, team: str, metadata: Mapping[str, str]) -> None:
        self.path = Path(path)
        self.metadata = {**metadata, "team": team}
        self._prefix = f"team/{team}/"
        self._queue: SimpleQueue[Sample | None] = SimpleQueue()
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._failure: Exception | None = None
        self._in_chunk = 0
        self._span = (2**63, 0)
        self._closed = False
        self.dropped = 0  # number of samples dropped beyond MOST_CHANNELS keys
        try:
            self._file: IO[bytes] = self.path.open("xb")
            self._writer = _open_writer(self._file, self.metadata)
        except FileExistsError:
            raise RecorderError(f"{self.path} exists: choose another name or remove it") from None
        except OSError as error:
            raise RecorderError(f"{self.path}: {error.strerror}; choose another place") from error
        # Daemon: a program that dies without `close` must end; it loses half a second at most.
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, samples: Iterable[Sample]) -> None:
        """Queue samples for the thread; raises `RecorderError` after its failure."""
        self._check()
        if self._closed:
            raise RecorderError(f"{self.path} is closed")
        for sample in samples:
            self._queue.put(sample)

    def waiting(self) -> int:
        """Number of queued samples."""
        return self._queue.qsize()

    def close(self) -> None:
        """Write queued samples, then the index; raises `RecorderError` on failure."""
        if not self._closed:
            self._closed = True
            self._queue.put(None)
            self._thread.join()
        self._check()

    def _check(self) -> None:
        if self._failure is not None:
            raise RecorderError(
                f"{self.path}: {self._failure}; what was flushed before can be repaired"
            ) from self._failure

    def _run(self) -> None:
        try:
            with self._file:
                self._write_all()
                self._writer.finish()  # type: ignore[no-untyped-call] # mcap leaves out `-> None`
        except Exception as error:  # raised by the next call, on the caller's thread
            self._failure = error

    def _write_all(self) -> None:
        flushed = time.monotonic()
        unflushed = False
        while True:
            try:
                sample = self._queue.get(timeout=FLUSH_S)
            except Empty:
                pass
            else:
                if sample is None:
                    return
                self._write(sample)
                unflushed = True
            if unflushed and time.monotonic() - flushed >= FLUSH_S:
                _flush(self._writer)
                self._in_chunk, self._span = 0, (2**63, 0)
                flushed, unflushed = time.monotonic(), False

    def _bound_chunk(self, sample: Sample) -> None:
        first, last = self._span
        first, last = min(first, sample.wall_ns), max(last, sample.wall_ns)
        if self._in_chunk >= CHUNK_LEAST and last - first > CHUNK_NS:
            _flush(self._writer)
            self._in_chunk, first, last = 0, sample.wall_ns, sample.wall_ns
        self._in_chunk += 1
        self._span = (first, last)

    def _write(self, sample: Sample) -> None:
        of = sample.key, self._tag(sample)
        channel = self._channels.get(of)
        if channel is None:
            if len(self._channels) >= MOST_CHANNELS:
                self.dropped += 1
                return
            channel = self._channels[of] = self._register(*of)
        self._bound_chunk(sample)
        self._writer.add_message(
            channel_id=channel,
            log_time=max(sample.stamp_ns, 0),
            data=sample.payload,
            publish_time=max(sample.wall_ns, 0),
            sequence=sample.counter % 2**32,
        )

    def _tag(self, sample: Sample) -> str:
        found = channel_of(sample.key)
        if found is None or not found[0].alternatives:
            return ""
        return tag_of(found[0].kind_of(tag_in(sample.payload)))

    def _register(self, key: str, tag: str) -> int:
        declaration = declaration_of(key, tag)
        if declaration is None:  # undeclared key: kept unchanged, unverified
            return self._writer.register_channel(self._prefix + key, "", 0)
        if declaration.schema not in self._schemas:
            number = self._writer.register_schema(
                declaration.schema, declaration.schema_encoding, declaration.text
            )
            self._schemas[declaration.schema] = number
        number = self._schemas[declaration.schema]
        return self._writer.register_channel(self._prefix + key, declaration.encoding, number)


def _open_writer(file: IO[bytes], metadata: dict[str, str]) -> Writer:
    """Open a writer; header and metadata come first, for a log whose recorder is killed."""
    writer = Writer(file)
    try:
        writer.start(profile="teamslam")
        writer.add_metadata(METADATA, metadata)
        _flush(writer)
    except OSError:
        with suppress(OSError):  # the same error again, from buffered data
            file.close()
        raise
    return writer


def _flush(writer: Writer) -> None:
    writer.flush()  # type: ignore[no-untyped-call] # mcap leaves out `-> None`
