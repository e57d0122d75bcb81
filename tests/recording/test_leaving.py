import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from teamslam.team import shell
from teamslam.team.recording.check import holes
from teamslam.team.recording.inventory import Inventory, Received
from teamslam.team.recording.reader import open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.recording.shell import RecordLoop
from teamslam.team.shell import Shell
from teamslam.team.wire import channels as c
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.recording.test_shell import FINAL, logged
from tests.support import wait_until
from tests.test_shell import Waiting

TRAJECTORIES = [f"r{k}" for k in range(1, 51)]


def trajectory(robot: str) -> m.Trajectory:
    return build.trajectory(robot=robot, incarnation=0, digest=FINAL.digest)


@contextmanager
def leaving(bus: ZenohBus) -> Iterator[threading.Thread]:
    bus.watch_alive("recorder")
    node = Shell(bus, Waiting(), "central", threading.Event())
    bus.declare_alive("central")
    tokens: list[Sample] = []

    def there() -> bool:
        tokens.extend(bus.receive(0.02))
        node.note(tokens)
        return bool(tokens)

    wait_until(there)
    bus.publish(Outgoing(c.FINAL_MAP, "", FINAL))
    for robot in TRAJECTORIES:
        bus.publish(Outgoing(c.TRAJECTORY, robot, trajectory(robot)))
    thread = threading.Thread(target=node.wait_for_recorder, args=(lambda: False,))
    thread.start()
    yield thread
    thread.join(20.0)
    assert not thread.is_alive()


def test_a_centre_stays_until_a_slow_recorder_has_every_trajectory(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO, "teamslam")
    monkeypatch.setattr(shell, "REMIND_S", 0.1)
    path = tmp_path / "log.mcap"
    with router() as at, ZenohBus("t", at) as centre, ZenohBus("t", at) as there:
        recorder = Recorder(path, "t", {})
        loop = RecordLoop(there, recorder, ())
        with leaving(centre) as thread:
            wait_until(lambda: caplog.text.count("waiting for the recorder") >= 3)
            assert thread.is_alive(), "the recorder has not read yet"
            wait_until(lambda: bool(loop.take(there.receive(0.02)) or not thread.is_alive()))
        loop.close()
    assert logged(path, c.TRAJECTORY) == len(TRAJECTORIES)


def test_a_centre_stays_for_what_was_lost_on_the_way(tmp_path):
    """Messages that the recorder missed come from the cache of the centre, which leaves last."""
    path = tmp_path / "log.mcap"
    with router() as at, ZenohBus("t", at) as centre, ZenohBus("t", at) as there:
        loop = RecordLoop(there, Recorder(path, "t", {}), ())
        lost = {c.TRAJECTORY.key(robot) for robot in TRAJECTORIES[:12]}
        arrived = there._recovery.take_sample

        def lossy(sample: Sample, source: object) -> list[Sample]:
            if sample.key in lost:  # the first time: the cache has it
                lost.discard(sample.key)
                return []
            return arrived(sample, source)

        there._recovery.take_sample = lossy

        def turn() -> None:
            loop.take(there.receive(0.02))
            loop.status()

        with leaving(centre) as thread:
            wait_until(lambda: bool(turn() or not thread.is_alive()))
        assert not lost
        centre.close()
        wait_until(lambda: bool(turn() or logged(path, c.TALLY) == 2))
        loop.close()
    found = [str(each) for each in holes(open_log(path)) if each.where.startswith("central")]
    assert found == [], "the totals, too, are counted"
    assert logged(path, c.TRAJECTORY) == len(TRAJECTORIES)


def sample(key: str, counter: int, wall_ns: int) -> Sample:
    return Sample(key, b"", 0, wall_ns, counter)


def test_each_life_of_a_process_is_counted_by_itself_and_each_sample_once():
    key = c.STATUS.key("central")
    there = Received()
    for counter, wall_ns in ((0, 10), (1, 11), (3, 13), (2, 12), (1, 11), (3, 13)):
        there.take(sample(key, counter, wall_ns))
    for counter in (0, 1):
        there.take(sample(key, counter, 100 + counter))
    assert there.of_process(key, 10) == (6, 4)
    assert there.of_process(key, 50) == (2, 2)

    def lacks(count: int, awaited: set[str]) -> dict[str, int]:
        tally = build.tally(node="central", since_ns=50, keys=(key,), counts=(count,))
        return there.lacking(tally, awaited)

    assert lacks(2, set()) == {}
    assert lacks(3, set()) == {key: 2}
    there.take(sample(key, 3, 103))
    assert lacks(4, {key}) == {key: 3}
    assert lacks(4, set()) == {}, "its publisher does not have it any more"


def test_a_recorder_that_was_started_again_counts_what_is_in_the_earlier_parts():
    key = c.TRAJECTORY.key("r1")
    inventory = Inventory(has_earlier_parts=True)
    inventory.remember(sample(key, 0, 10))
    assert not inventory.is_new(sample(key, 0, 10))
    assert inventory.received.of_process(key, 5) == (1, 1)


def test_an_undecodable_measurement_is_no_substitute_for_a_sound_one():
    key = c.ODOMETRY.key("r1")
    first, second = (encoded(build.odometry(incarnation=0, number=number)) for number in (0, 1))
    inventory = Inventory()
    nested = first[:-1] + b"\x91" * 5_000
    for payload in (first[:-1], nested, second):
        assert inventory.is_new(Sample(key, payload, 0, 0, 0))
    assert list(inventory.findings()) == [
        ("source/r1", "1 measurements of incarnation 0 missing: 0")
    ]
    assert inventory.is_new(Sample(key, first, 0, 0, 0))
    assert not inventory.is_new(Sample(key, first, 0, 0, 0)), "requested and recorded once"
    assert list(inventory.findings()) == []
