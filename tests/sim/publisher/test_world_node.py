import numpy as np
import pytest

from teamslam.sim.publisher import node as world_node
from teamslam.sim.publisher.node import WorldNode, expected_nodes
from teamslam.team.driver import source
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, stamps
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.teams import of, stream, world_of

SCENARIO = build.configuration(node="world", incarnation=0)
STREAMS = world_of(stream("r1", 12), stream("r2", 9, off_ns=300_000_000, beyond=2))


def world(streams=STREAMS, expected=frozenset(), **options):
    return WorldNode(streams, expected, SCENARIO, **options)


def alive(node, name, *, here=True):
    node.handle(build.liveliness(node=name, alive=here))


def all_of(node, clock=0.0):
    out = []
    while not node.ended:
        out += node.publish(clock)
    return out


def measurements(out):
    return [o.message for o in out if isinstance(o.message, m.Measurement)]


def progress(robot, count, incarnation=1, node="robot"):
    return build.progress(node=node, robot=robot, incarnation=incarnation, measurements=count)


def test_it_waits_for_everyone_and_says_for_whom():
    expected = expected_nodes(["r1", "r2"], recorder=True)
    node = world(expected=expected)
    for name in sorted(expected):
        assert name in node.waiting_for
        assert node.publish(5.0) == []
        assert name in node.status().warnings[0]
        alive(node, name)
    assert node.waiting_for == []
    assert measurements(node.publish(5.0))


def test_it_does_not_begin_without_one_that_came_and_went():
    node = world(expected=frozenset({"central", "robot/r1"}))
    alive(node, "central")
    alive(node, "central", here=False)
    alive(node, "robot/r1")
    assert node.publish(0.0) == []


def test_measurements_come_by_stamp_then_robot_and_count_from_0():
    out = measurements(all_of(world()))
    assert [(r.stamp_ns, r.robot) for r in out] == sorted((r.stamp_ns, r.robot) for r in out)
    for each in STREAMS.streams:
        mine = [r for r in out if r.robot == each.robot]
        assert [r.number for r in mine] == list(range(len(each)))
        assert {r.incarnation for r in mine} == {1}
        assert isinstance(mine[0], m.InitialPose)


def test_every_message_is_on_its_channel_and_passes_the_door():
    node = world()
    for o in [*node.begin(), *all_of(node)]:
        assert decoded(encoded(o.message), *o.channel.kinds) == o.message
        assert getattr(o.message, "robot", "") == o.name


def test_it_ends_once_with_the_last_counters():
    node = world()
    out = all_of(node)
    (end,) = of(out, ch.END)
    assert out[-1].message is end
    assert [(s.robot, s.incarnation, s.measurements) for s in end.streams] == [
        (each.robot, 1, len(each)) for each in STREAMS.streams
    ]
    assert node.publish(1e9) == []
    assert node.status().state == "ended"
    assert not node.finished


@pytest.mark.parametrize("slow", ["r1", "r2"])
def test_it_is_never_more_than_its_credit_ahead_of_a_living_robot(monkeypatch, slow):
    monkeypatch.setattr(world_node, "CREDIT_MEASUREMENTS", 5)
    node = world()
    for name in ("robot/r1", "robot/r2"):
        alive(node, name)
    consumed = {"r1": 0, "r2": 0}
    sent = {"r1": 0, "r2": 0}
    for _ in range(2):
        for measurement in measurements(node.publish(0.0)):
            sent[measurement.robot] += 1
            assert sent[measurement.robot] - consumed[measurement.robot] <= 5
        (other,) = {"r1", "r2"} - {slow}
        consumed[other] = sent[other]
        node.handle(progress(other, sent[other]))
    assert sent[slow] == 5
    assert not node.ended
    node.handle(progress(slow, 3))
    node.handle(progress(slow, 1))
    for measurement in measurements(node.publish(0.0)):
        sent[measurement.robot] += 1
    assert sent[slow] == 8, "progress that comes late takes no credit back"
    node.handle(progress(slow, 100, incarnation=9))
    assert measurements(node.publish(0.0)) == [], "nor does another incarnation's give any"
    node.handle(progress(other, 1000))
    alive(node, f"robot/{slow}", here=False)
    all_of(node)
    assert node.ended, "a dead robot's credit is freed"


def test_the_recorder_is_waited_for_while_it_lives(monkeypatch):
    monkeypatch.setattr(world_node, "CREDIT_RECORDER", 10)
    node = world()
    alive(node, "recorder")
    assert len(measurements(node.publish(0.0))) == 10
    assert measurements(node.publish(0.0)) == []
    node.handle(progress("r1", 2, node="recorder"))
    node.handle(progress("r2", 2, node="recorder"))
    assert len(measurements(node.publish(0.0))) == 4
    alive(node, "recorder", here=False)
    all_of(node)


@pytest.mark.parametrize("cache", [None, 3])
def test_a_recorder_that_comes_late_is_waited_for_until_it_has_what_can_be_had(monkeypatch, cache):
    monkeypatch.setattr(world_node, "CREDIT_RECORDER", 10)
    monkeypatch.setattr(world_node, "BATCH", 15)
    node = world(cache=cache)
    sent = len(measurements(node.publish(0.0)))
    for _ in range(2):
        alive(node, "recorder")
        if cache is None:
            assert measurements(node.publish(0.0)) == [], "it has not said yet what its log has"
            node.handle(progress("r1", sent, node="recorder"))
            assert node.unrecorded == 0
        taken = len(measurements(node.publish(0.0)))
        assert 0 < taken <= 10
        sent += taken
        assert node.unrecorded > 0
        node.handle(progress("r1", sent, node="recorder"))
        assert node.unrecorded <= 0
        alive(node, "recorder", here=False)
        assert node.unrecorded == 0, "who is not there is not waited for"


def wanted(node, **fields):
    return list(node.measurements(encoded(build.measurements_request(**fields))))


def test_what_is_asked_for_is_answered_with_the_bytes_that_were_published():
    node = world()
    out = [encoded(r) for r in measurements(all_of(node)) if r.robot == "r1"]
    assert wanted(node) == wanted(node, incarnation=0) == out
    assert wanted(node, first=3, last=5) == out[3:6]
    assert wanted(node, first=len(out) - 1, last=10_000) == out[-1:]
    assert wanted(node, first=len(out)) == []
    assert wanted(node, incarnation=2) == wanted(node, robot="r9") == []


def test_only_what_was_published_is_answered_and_in_portions(monkeypatch):
    monkeypatch.setattr(world_node, "BATCH", 7)
    monkeypatch.setattr(source, "ANSWER", 3)
    node = world()
    assert wanted(node) == []
    out = [encoded(r) for r in measurements(node.publish(0.0)) if r.robot == "r2"]
    got = []
    while part := wanted(node, robot="r2", first=len(got)):
        assert len(part) <= 3
        got += part
    assert got == out


def test_who_asks_for_what_is_no_longer_kept_gets_a_new_incarnation_at_a_free_pose(monkeypatch):
    monkeypatch.setattr(world_node, "BATCH", 12)
    node = world(cache=3)
    before = [r for r in measurements(node.publish(0.0)) if r.robot == "r1"]
    assert wanted(node, first=len(before) - 3) == [encoded(r) for r in before[-3:]]
    assert wanted(node, first=0) == []
    assert wanted(node, first=0) == [], "asked twice, there is still one new incarnation"
    out = all_of(node)
    mine = [r for r in measurements(out) if r.robot == "r1"]
    assert {r.incarnation for r in mine} == {2}
    assert [r.number for r in mine] == list(range(len(mine)))
    assert isinstance(mine[0], m.InitialPose)
    assert (mine[0].pose, mine[0].covariance) == (b"", b"")
    (end,) = of(out, ch.END)
    assert end.streams[0] == m.StreamEnd(robot="r1", incarnation=2, measurements=len(mine))
    total = len(STREAMS.streams[0])
    assert len(before) + len(mine) - 1 == total, "the start takes the place of the last one sent"


def test_a_new_incarnation_after_the_end_has_its_own_end():
    node = world(cache=3)
    all_of(node)
    wanted(node, first=0)
    out = node.publish(0.0)
    assert [type(o.message) for o in out] == [m.InitialPose, m.End]
    assert out[-1].message.streams[0] == m.StreamEnd(robot="r1", incarnation=2, measurements=1)
    assert node.publish(0.0) == []


def test_the_truth_comes_whole_in_batches_and_on_its_own_channels_only():
    node = world()
    out = [*node.begin(), *all_of(node)]
    for each in STREAMS.streams:
        batches = [o.message for o in out if o.channel is ch.TRUTH and o.name == each.robot]
        assert len(batches) > 1
        np.testing.assert_array_equal(
            np.concatenate([stamps(b.stamps, "stamps") for b in batches]), each.truth_ns
        )
        np.testing.assert_array_equal(
            np.concatenate([floats(b.poses, "poses") for b in batches]).reshape(-1, 3), each.truth
        )
    (landmarks,) = of(out, ch.TRUTH_LANDMARKS)
    np.testing.assert_array_equal(
        floats(landmarks.positions, "positions").reshape(-1, 2), STREAMS.landmarks
    )
    others = {o.channel.name for o in out if isinstance(o.message, m.Truth | m.TruthLandmarks)}
    assert others == {"truth", "truth_landmarks"}


def again(r1: int, r2: int, recorder=None, **options):
    expected = expected_nodes(["r1", "r2"], recorder=recorder is not None)
    node = world(expected=expected, **options)
    for name in sorted(expected):
        alive(node, name)
    for robot, count in (("r1", r1), ("r2", r2)):
        node.handle(progress(robot, count))
        if recorder is not None:
            node.handle(progress(robot, recorder, node="recorder"))
    return node


def test_a_world_that_is_started_again_goes_on_from_what_everybody_has():
    before = measurements(all_of(world()))
    node = again(7, 5)
    out = measurements(all_of(node))
    starts = [r for r in out if isinstance(r, m.InitialPose)]
    assert {(r.robot, r.number, r.incarnation) for r in starts} == {("r1", 0, 1), ("r2", 0, 1)}
    least = {"r1": 7, "r2": 5}
    assert out[len(starts) :] == [r for r in before if r.number >= least[r.robot]]
    assert node.status().figures["measurements"] == len(before)
    request = encoded(build.measurements_request())
    assert [decoded(reply).number for reply in node.measurements(request)] == list(range(26))


def test_a_world_that_is_started_again_waits_for_everyone_s_word_but_not_for_ever():
    node = world(expected=expected_nodes(["r1", "r2"], recorder=False))
    node.handle(progress("r1", 7))
    assert node.publish(100.0) == []
    assert measurements(node.publish(100.0 + world_node.RESUME_S))


def test_a_world_whose_stream_had_begun_anew_begins_it_once_more_where_the_robot_is():
    node = world()
    node.handle(build.progress(stamp_ns=5_000_000_000, incarnation=3, measurements=4))
    out = [r for r in measurements(node.publish(0.0) + node.publish(9.0)) if r.robot == "r1"]
    assert {r.incarnation for r in out} == {4}
    assert [r.number for r in out] == list(range(len(out)))
    assert min(r.stamp_ns for r in out) == 5_000_000_000


def test_a_world_begins_without_a_node_that_is_given_up():
    node = world(expected=frozenset({"robot/r1", "recorder"}))
    alive(node, "robot/r1")
    assert node.publish(0.0) == []
    node.handle(build.given_up(node="recorder", by="launch", reason="it died 5 times"))
    assert measurements(node.publish(0.0))
