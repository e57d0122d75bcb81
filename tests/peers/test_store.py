"""A set on disk: what a robot that was started again finds there, however its file was torn."""

from pathlib import Path

import pytest

from team.peers.replica import Replica
from team.peers.store import MAGIC, Store, StoreError, record_of
from tests.peers.teams import said

MEMBERS = [each for occasion in said("r1", 4, "r2") for each in occasion]


def kept_in(path: Path, content: bytes) -> int:
    path.write_bytes(content)
    store = Store(path)
    store.close()
    return len(store.members)


def test_what_was_appended_is_there_again_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "r1.set"
    store = Store(path)
    store.append(MEMBERS[:3])
    store.close()
    again = Store(path)
    assert again.members == MEMBERS[:3]
    again.append(MEMBERS[3:])
    again.close()
    found = Replica(["r1", "r2"])
    last = Store(path)
    last.close()
    for each in last.members:
        found.add(each)
    assert found.submaps == 4


def test_a_torn_or_damaged_end_is_cut_off_and_nothing_before_it(tmp_path: Path) -> None:
    records = [record_of(each) for each in MEMBERS]
    whole = MAGIC + b"".join(records)
    before = len(whole) - len(records[-1])
    for cut in (1, 7, 9, len(records[-1]) - 1):
        path = tmp_path / f"{cut}.set"
        assert kept_in(path, whole[: before + cut]) == len(MEMBERS) - 1
        assert path.read_bytes() == whole[:before]
    damaged = bytearray(whole)
    damaged[before + 20] ^= 1
    assert kept_in(tmp_path / "damaged.set", bytes(damaged)) == len(MEMBERS) - 1
    assert kept_in(tmp_path / "torn.set", MAGIC[:3]) == 0
    assert (tmp_path / "torn.set").read_bytes() == MAGIC


def test_another_file_is_not_overwritten(tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("something of the user's")
    with pytest.raises(StoreError, match="is no set of a peer: give --set another file"):
        Store(other)
    assert other.read_text() == "something of the user's"
