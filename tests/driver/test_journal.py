import os
import time

import msgpack
import msgspec
import pytest

from teamslam.team.driver import journal as j
from teamslam.team.driver.journal import Journal, JournalError, open_journal
from teamslam.team.driver.node import SourceNode
from teamslam.team.wire.codec import encoded
from tests import build

LATENCY_NS = 200_000_000


def measured(journal, kind, stamp_ns):
    common = {"stamp_ns": stamp_ns, "robot": "r1", "incarnation": 1, "number": 0}
    message = {
        j.START: lambda: build.initial_pose(**common),
        j.ODOMETRY: lambda: build.odometry(duration_ns=1, forward=0.0, yaw_rate=0.0, **common),
        j.OBSERVATIONS: lambda: build.observations(**common),
    }[kind]()
    journal.append(kind, stamp_ns, encoded(message))


def numbered(journal, incarnation=1):
    messages = [journal.message(incarnation, n) for n in range(journal.count(incarnation))]
    assert [each.number for each in messages] == list(range(len(messages)))
    return [(each.stamp_ns // 10**8, type(each).__name__) for each in messages]


def filled(path):
    journal, _, _ = open_journal(path, "r1", LATENCY_NS)
    measured(journal, j.START, 0)
    for tenth in range(1, 8):
        measured(journal, j.ODOMETRY, tenth * 10**8)
        if tenth in (2, 5):
            measured(journal, j.OBSERVATIONS, (tenth - 1) * 10**8)  # as late as a camera's frame
    return journal


def test_what_is_seen_at_a_time_is_numbered_before_the_odometry_to_it(tmp_path):
    found = numbered(filled(tmp_path / "r1.stream"))
    assert found[:4] == [(0, "InitialPose"), (1, "Observations"), (1, "Odometry"), (2, "Odometry")]
    assert found.index((4, "Observations")) == found.index((4, "Odometry")) - 1


@pytest.mark.parametrize("lost", [0, 1, 7])
def test_a_driver_that_is_killed_goes_on_with_the_same_numbers(tmp_path, lost):
    path = tmp_path / "r1.stream"
    journal = filled(path)
    before, size = numbered(journal), path.stat().st_size
    journal.close()
    os.truncate(path, size - lost)
    again, said, _ = open_journal(path, "r1", LATENCY_NS)
    assert "continues " in said
    assert ("cut off" in said) == (lost in (1, 7))
    found = numbered(again)
    assert found == before[: len(found)]
    assert len(found) >= len(before) - 2
    for tenth in range(8, 12):
        measured(again, j.ODOMETRY, tenth * 10**8)
    assert (8, "Odometry") in numbered(again)


def test_a_stream_that_has_ended_or_is_old_steps_aside_and_the_next_one_counts_on(tmp_path):
    path = tmp_path / "r1.stream"
    journal = filled(path)
    journal.mark("ended", delivered=True)
    journal.close()
    second, said, _ = open_journal(path, "r1", LATENCY_NS)
    assert "has ended: it is now" in said
    assert (tmp_path / "r1.stream.1").exists()
    assert second.next_incarnation == 2
    measured(second, j.START, 0)
    assert second.incarnation == 2
    second.close()
    os.utime(path, (0, 0))
    third, _, said = open_journal(path, "r1", LATENCY_NS)
    assert "h old, and not delivered: it is now" in said
    assert third.next_incarnation == 3


@pytest.mark.parametrize("zeros", [0, 1, 4096, 9000])
def test_a_file_that_a_crash_left_empty_or_half_written_is_begun_anew(tmp_path, zeros):
    path = tmp_path / "r1.stream"
    journal = Journal(path, "r1")
    head = j.MAGIC + msgpack.packb({"robot": "r1", "incarnation": 1})
    for size in range(len(head)):
        path.write_bytes(head[:size] + bytes(zeros))
        journal, said, _ = open_journal(path, "r1", LATENCY_NS)
        assert ("left out" in said) == bool(size + zeros)
        measured(journal, j.START, 0)
        assert journal.incarnation == 1
        journal.close()
        again, said, _ = open_journal(path, "r1", LATENCY_NS)
        assert "1 measurements, no start" in said
        again.close()


@pytest.mark.parametrize("step_s", [7200.0, 50 * 365 * 86_400.0])
def test_a_clock_that_was_set_makes_no_undelivered_stream_an_old_one(tmp_path, monkeypatch, step_s):
    path = tmp_path / "r1.stream"
    now = time.time
    with monkeypatch.context() as wrong:  # until the network set the clock
        wrong.setattr(time, "time", lambda: now() - step_s)
        filled(path).close()
    before_s = now() - step_s
    os.utime(path, (before_s, before_s))
    journal, said, _ = open_journal(path, "r1", LATENCY_NS)
    assert "continues " in said
    assert journal.count(1) == 7


def test_behind_a_damaged_record_nothing_is_read_and_nothing_destroyed(tmp_path):
    path = tmp_path / "r1.stream"
    journal = filled(path)
    before, at = numbered(journal), journal.calls[3]
    journal.close()
    content = bytearray(path.read_bytes())
    content[at + 20] ^= 1
    path.write_bytes(content)
    again, said, _ = open_journal(path, "r1", LATENCY_NS)
    assert "behind a damaged record are left out" in said
    assert (tmp_path / "r1.stream.damaged").read_bytes() == content
    found = numbered(again)
    assert found == before[: len(found)]


def test_a_file_has_one_driver_and_one_robot(tmp_path):
    path = tmp_path / "r1.stream"
    journal = filled(path)
    with pytest.raises(JournalError, match="another driver has it open: end that one"):
        open_journal(path, "r1", LATENCY_NS)
    journal.close()
    with pytest.raises(JournalError, match="a file of r1, not of r2"):
        open_journal(path, "r2", LATENCY_NS)
    other = tmp_path / "notes.txt"
    other.write_text("t,v\n")
    with pytest.raises(JournalError, match="no driver's"):
        open_journal(other, "r1", LATENCY_NS)


def test_nobody_has_consumed_more_than_the_driver_has_numbered(tmp_path):
    node = SourceNode(filled(tmp_path / "r1.stream"))
    node.listening = False
    here = node.journal.count(1)
    whole = build.progress(measurements=here)
    done = build.done(incarnation=2)
    assert node.refusal(whole) is None
    for far in (
        msgspec.structs.replace(whole, measurements=here + 1),
        msgspec.structs.replace(whole, node="recorder", incarnation=2, measurements=0),
        done,
    ):
        assert f"has {here} of incarnation 1" in str(node.refusal(far))
    assert node.refusal(msgspec.structs.replace(whole, incarnation=2**62)) is not None
    node.listening = True  # another file may have the missing ones
    assert node.refusal(msgspec.structs.replace(whole, incarnation=2)) is None
