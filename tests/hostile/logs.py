"""Small files with large contents: what an MCAP log can hide in 16 kB."""

import struct
from collections.abc import Sequence
from pathlib import Path
from random import Random

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer

from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.codec import encoded
from tests import build
from tests.recording.test_log import bomb
from tests.support import packed, spd

LARGEST_FILE = 16 * 1024
NOISE = 4500
PRIVATE = 0x90  # an opcode of nobody's, which readers skip
DIGEST = b"configur"


def log_of(path: Path, *chunks: bytes) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        writer.add_metadata("teamslam", {"team": "demo"})
        for k, chunk in enumerate(chunks):
            # Incompressible bytes make the overall ratio plausible.
            noise = Random(k).randbytes(NOISE)
            records = struct.pack("<BQ", PRIVATE, NOISE) + noise + chunk
            data = zstandard.compress(records, 19)
            size = struct.pack("<QQQII", 0, 0, len(records), 0, 4) + b"zstd"
            body = size + struct.pack("<Q", len(data)) + data
            file.write(struct.pack("<BQ", Opcode.CHUNK, len(body)) + body)
        writer.finish()
    assert path.stat().st_size <= LARGEST_FILE
    return path


def records_of(told: Sequence[tuple[ch.Channel, str, bytes]]) -> bytes:
    out = RecordBuilder()
    keys = [f"team/demo/{channel.key(name)}" for channel, name, _ in told]
    numbers = {key: k + 1 for k, key in enumerate(dict.fromkeys(keys))}
    for key, number in numbers.items():
        row = {"topic": key, "message_encoding": "msgpack", "metadata": {}, "schema_id": 0}
        Channel(id=number, **row).write(out)
    for key, (_, _, payload) in zip(keys, told, strict=True):
        at = {"log_time": 1, "publish_time": 1, "sequence": 0}
        Message(channel_id=numbers[key], data=payload, **at).write(out)
    return out.end()


def expands(path: Path) -> Path:
    bomb(path, 500 * 10**6, 500 * 10**6)
    return path


def many_small(path: Path) -> Path:
    """Millions of the smallest messages: a few bytes each, some hundred as objects."""
    told = records_of([(ch.OWN_POSE, "alpha", b"")] * 2)
    channel = records_of([(ch.OWN_POSE, "alpha", b"")])[: -(9 + 22)]
    one = told[len(channel) :][: 9 + 22]
    return log_of(path, channel + one * (58_000_000 // len(one)))


def few_large(path: Path) -> Path:
    large = records_of([(ch.OWN_MAP, "alpha", bytes(58_000_000))])
    return log_of(path, large, large)


def far_counters(path: Path) -> Path:
    far = 2**60
    joint = from_floats([0.0] * 5)
    counts = {"first_measurement": 0, "last_measurement": far}
    map_ = {"ids": [1], "mean": joint, "covariance": packed(spd(5))}
    submap = build.submap(stamp_ns=9, robot="alpha", start_ns=1, config=DIGEST, **counts, **map_)
    of_alpha = {"robot": "alpha", "duration_ns": 5}
    told: list[tuple[ch.Channel, str, m.Message]] = [
        (ch.START, "alpha", build.initial_pose(robot="alpha")),
        *(
            (ch.ODOMETRY, "alpha", build.odometry(stamp_ns=at, **of_alpha, number=number))
            for at, number in ((5, 1), (2**61, far))
        ),
        (ch.SUBMAP, "alpha", submap),
        (ch.ROBOT_DONE, "alpha", build.done(robot="alpha", measurements=far, steps=far, submaps=1)),
        (ch.END, "", build.end(2**61, alpha=far)),
    ]
    return log_of(path, records_of([(c, n, encoded(message)) for c, n, message in told]))


KINDS = (expands, many_small, few_large, far_counters)
