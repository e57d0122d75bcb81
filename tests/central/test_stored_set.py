from contextlib import closing
from pathlib import Path

import pytest

from teamslam.central.main import StoredSet
from teamslam.team.peers.members import Member
from teamslam.team.peers.set_file import SetFileError
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import encoded
from tests.support import odometry, submap

SENT = [Sample(ch.SUBMAP.key("alpha"), encoded(submap(i)), 0, 0, i) for i in range(3)]


def a_life(path: Path) -> closing[StoredSet]:
    return closing(StoredSet(path))


def heard(found: list[Sample] | list[Member]) -> list[tuple[str, bytes]]:
    return [(each.key, each.payload) for each in found]


def kept_in(path: Path) -> list[tuple[str, bytes]]:
    with a_life(path) as kept:
        return heard(kept.members)


def test_a_later_life_hears_each_member_once_and_nothing_else(tmp_path):
    path = tmp_path / "central.set"
    measured = Sample(ch.ODOMETRY.key("alpha"), encoded(odometry(1)), 0, 0, 0)
    unsound = Sample(ch.SUBMAP.key("alpha"), b"no message", 0, 0, 0)
    with a_life(path) as kept:
        assert kept.members == []
        kept.note([SENT[0], measured, unsound, SENT[0]])
        kept.note(SENT[:2])
    with a_life(path) as again:
        again.note(SENT)
        assert heard(again.members) == heard(SENT[:2])
    assert kept_in(path) == heard(SENT)


def test_what_a_death_tore_is_cut_off_and_the_rest_is_there(tmp_path):
    path = tmp_path / "central.set"
    with a_life(path) as kept:
        kept.note(SENT)
    path.write_bytes(path.read_bytes()[:-1])
    with a_life(path) as torn:
        assert heard(torn.members) == heard(SENT[:2])
        torn.note(SENT)
    assert kept_in(path) == heard(SENT)


def test_after_its_end_nothing_is_kept(tmp_path):
    path = tmp_path / "central.set"
    with a_life(path) as kept:
        pass
    kept.note(SENT)
    assert kept_in(path) == []


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "central.set"
    path.write_text("something else")
    with pytest.raises(SetFileError, match="is not a peer's set: give --set another file"):
        StoredSet(path)
