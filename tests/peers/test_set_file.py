import errno
import os
import random
import struct
import zlib
from itertools import accumulate
from pathlib import Path

import msgpack
import pytest

from teamslam.team.peers.members import member_of
from teamslam.team.peers.replica import Replica
from teamslam.team.peers.set_file import MAGIC, SetFile, SetFileError, record_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import encoded
from tests import build
from tests.peers.teams import said

MEMBERS = [each for occasion in said("r1", 4, "r2") for each in occasion]


def opened_and_closed(path: Path) -> SetFile:
    store = SetFile(path)
    store.close()
    return store


def test_what_was_appended_is_there_again_and_goes_on(tmp_path):
    path = tmp_path / "r1.set"
    store = SetFile(path)
    store.append(MEMBERS[:3])
    store.close()
    again = SetFile(path)
    assert again.members == MEMBERS[:3]
    again.append(MEMBERS[3:])
    again.close()
    found = Replica(["r1", "r2"])
    for each in opened_and_closed(path).members:
        found.add(each)
    assert found.submaps == 4


RECORDS = [record_of(each) for each in MEMBERS]
WHOLE = MAGIC + b"".join(RECORDS)
ENDS = [len(MAGIC), *(len(MAGIC) + n for n in accumulate(map(len, RECORDS)))]


def touched(first: int, last: int) -> set[int]:
    """Records that have a byte in this closed interval."""
    return {k for k in range(len(RECORDS)) if ENDS[k] <= last and first < ENDS[k + 1]}


def check_recovered(path: Path, content: bytes, lost: set[int]) -> SetFile:
    path.write_bytes(content)
    store = SetFile(path)
    assert store.members == [each for k, each in enumerate(MEMBERS) if k not in lost]
    store.append([MEMBERS[0]])
    store.close()
    again = opened_and_closed(path)
    assert again.members == [*store.members, MEMBERS[0]]
    assert not again.lost
    assert not again.torn
    return store


def test_truncated_at_any_byte_a_set_has_every_whole_record(tmp_path):
    for size in (*range(ENDS[4]), *range(ENDS[-2], len(WHOLE))):
        cut = max(sum(end <= size for end in ENDS) - 1, 0)
        path = tmp_path / "set"
        path.write_bytes(WHOLE[:size])
        store = opened_and_closed(path)
        assert store.members == MEMBERS[:cut]
        if size % 20 == 0:
            check_recovered(path, WHOLE[:size], set(range(cut, 99)))
        assert bool(store.torn) == (size not in (*ENDS, *range(len(MAGIC))))
        assert not store.lost


def test_behind_flipped_bits_a_set_has_every_intact_record_and_names_the_loss(tmp_path):
    rng = random.Random(1)
    for _ in range(120):
        damaged = bytearray(WHOLE)
        places = rng.sample(range(len(WHOLE)), rng.choice([1, 1, 2, 5]))
        for at in places:
            damaged[at] ^= 1 << rng.randrange(8)
        lost = set().union(*(touched(at, at) for at in places))
        store = check_recovered(tmp_path / "set", bytes(damaged), lost)
        assert store.lost or store.torn


def test_what_is_known_to_be_lost_is_named_by_its_number(tmp_path, caplog):
    submaps = [k for k, each in enumerate(MEMBERS) if isinstance(each.message, m.Submap)]
    damaged = bytearray(WHOLE)
    damaged[ENDS[submaps[1]] + 30] ^= 4
    path = tmp_path / "r1.set"
    path.write_bytes(bytes(damaged))
    (warning,) = opened_and_closed(path).warnings
    missing = MEMBERS[submaps[1]].message
    assert isinstance(missing, m.Submap)
    size = len(RECORDS[submaps[1]])
    assert f"damaged in 1 place: {size} bytes are lost" in warning
    assert f"{len(MEMBERS) - 1} members are intact" in warning
    assert f"lacks submaps {missing.sequence} of r1" in warning
    assert warning in caplog.text


def test_a_record_within_a_damaged_one_is_not_taken(tmp_path):
    """Its author put it there; only records written by the process count."""
    order = build.given_up(node="robot/r2", by="nobody", reason="")
    forged = member_of(ch.GIVEN_UP.key("robot/r2"), encoded(order))
    body = msgpack.packb(["robot/r1/submap", record_of(forged) * 3, b""])
    outer = bytearray(struct.pack("<II", len(body), zlib.crc32(body)) + body)
    outer[8 + 3] ^= 1
    path = tmp_path / "r1.set"
    path.write_bytes(MAGIC + bytes(outer) + RECORDS[0])
    assert opened_and_closed(path).members == [MEMBERS[0]]


def test_a_write_that_is_cut_short_is_finished_or_taken_back(tmp_path, monkeypatch, caplog):
    path = tmp_path / "r1.set"
    room = 5000
    pwrite = os.pwrite

    def into_room(file: int, data: bytes, at: int) -> int:
        taken = min(len(data), room - at)
        if taken <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return pwrite(file, data[: max(taken // 2, 1)], at)  # in pieces, too

    monkeypatch.setattr(os, "pwrite", into_room)
    monkeypatch.setattr("teamslam.team.peers.set_file.RETRY_S", 0.0)
    store = SetFile(path)
    several = [MEMBERS[k % len(MEMBERS)] for k in range(60)]
    for each in several[:50]:
        store.append([each])
    (warning,) = store.warnings
    assert "No space left on device" in warning
    assert "members are not stored" in warning
    assert caplog.text.count("the set is not stored") == 1
    cut = opened_and_closed(path)
    assert 0 < len(cut.members) < 50
    assert not cut.torn, "what was written of the last record is taken back"
    room = 10**9
    for each in several[50:]:
        store.append([each])
    assert not store.warnings
    store.close()
    assert opened_and_closed(path).members == several


def test_another_file_is_not_overwritten(tmp_path):
    other = tmp_path / "notes.txt"
    other.write_text("something of the user's")
    with pytest.raises(SetFileError, match="is not a peer's set: give --set another file"):
        SetFile(other)
    assert other.read_text() == "something of the user's"
