"""A flipped bit costs a second of recorded time at the most, wherever in the records it is."""

import random
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.recording.records import read_frames
from teamslam.team.recording.repair import read_undamaged
from teamslam.team.wire import channels as c
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import encoded
from tests.support import odometry, submap

SECOND = 10**9
RATE = 40


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[Sample]]:
    """The bytes of a log of 20 s, written much faster, and its samples."""
    path = tmp_path_factory.mktemp("flips") / "log.mcap"
    samples = [
        Sample(c.ODOMETRY.key("alpha"), encoded(odometry(i)), i, 10**18 + i * SECOND // RATE, i)
        for i in range(20 * RATE)
    ]
    late = [
        Sample(c.SUBMAP.key("alpha"), encoded(submap(i)), i, 10**18 + i * SECOND // 2, i)
        for i in range(20)
    ]
    with Recorder(path, "t", {"scenario": "s"}) as recorder:
        recorder.write([*samples, *late])
    return path.read_bytes(), [*samples, *late]


def saved(path: Path) -> list[Sample]:
    found: list[Sample] = []
    for chunk in read_undamaged(open_log(path)):
        if not isinstance(chunk, LogError):
            found += chunk
    return found


def heads(path: Path) -> list[int]:
    """Where the opcodes and the lengths of chunks and of their indices are."""
    with path.open("rb") as file:
        kinds = (Opcode.CHUNK, Opcode.MESSAGE_INDEX)
        offsets = [frame.offset for frame in read_frames(file, path) if frame.opcode in kinds]
    return [offset + k for offset in offsets for k in range(9)]


@pytest.mark.parametrize("where", ["anywhere", "in the heads of records"])
def test_a_flipped_bit_costs_a_second_of_recorded_time_at_the_most(
    where: str, recorded: tuple[bytes, list[Sample]], tmp_path: Path
) -> None:
    data, samples = recorded
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    with path.open("rb") as file:
        first = next(f.offset for f in read_frames(file, path) if f.opcode == Opcode.CHUNK)
    places = list(range(first, len(data))) if where == "anywhere" else heads(path)
    rng = random.Random(3)
    losses = 0
    for place in rng.sample(places, 60):
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.randrange(8)
        path.write_bytes(flipped)
        there = set(saved(path))
        lost = [s for s in samples if s not in there]
        losses += bool(lost)
        regular = [s.wall_ns for s in lost if "odometry" in s.key]
        assert max(regular, default=0) - min(regular, default=0) <= SECOND, f"bit at {place}"
        assert len(lost) <= RATE, f"bit at {place}"
    assert losses, "a flip that costs nothing at all shows nothing"
