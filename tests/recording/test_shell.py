import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import shell
from teamslam.team.recording import recorder as recorder_module
from teamslam.team.recording.check import holes
from teamslam.team.recording.inventory import Inventory, Received
from teamslam.team.recording.parts import next_part
from teamslam.team.recording.reader import open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.recording.shell import RecordLoop, replay, schedule
from teamslam.team.shell import Shell
from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.bus import Bus, MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from teamslam.team.wire.codec import decoded, encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.support import example, odometry, received, submap, wait_until
from tests.test_shell import Waiting

FINAL = example(m.FusedMap)


@pytest.fixture
def endpoint():
    with router() as bound:
        yield bound


def messages_of(samples: list[Sample], channel: c.Channel) -> list[m.Message]:
    found = [opened(sample) for sample in samples]
    return [message for of, _, message in found if of is channel]


CONCLUDED = example(m.Concluded)
GIVEN_UP = build.given_up(node="robot/r3", reason="lost")


@pytest.mark.parametrize("peers", [("r1", "r2", "r3"), ()], ids=["peers", "a centre"])
def test_a_robots_own_conclusion_does_not_end_the_log_of_a_team(path, peers):
    network = MemoryNetwork()
    team, bus = MemoryBus(network), MemoryBus(network)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, (), peers=peers)

        def ends_by(out: Outgoing) -> bool:
            team.publish(out)
            loop.take(bus.receive())
            return loop.finished

        for robot in ("r1", "r1", "r2"):
            concluded = msgspec.structs.replace(CONCLUDED, robot=robot)
            assert not ends_by(Outgoing(c.CONCLUDED, robot, concluded))
        assert ends_by(Outgoing(c.GIVEN_UP, "robot/r3", GIVEN_UP)) == bool(peers)
        assert ends_by(Outgoing(c.FINAL_MAP, "", FINAL))


def test_a_flood_of_keys_and_of_tags_leaves_a_whole_log(path, monkeypatch):
    """MCAP numbers a log's keys by 16 bits."""
    monkeypatch.setattr(recorder_module, "MOST_CHANNELS", 10)
    network = MemoryNetwork()
    robot, bus = MemoryBus(network), MemoryBus(network)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ())
        loop.take([Sample(f"robot/r1/x{k}/status", b"", 0, 0, 0) for k in range(20)])
        for k in range(20):
            forged = b"\x95\xaa" + f"forged/{k:03}".encode() + bytes(3)
            robot.publish_raw(Sample(c.ODOMETRY.key("r1"), forged, 0, 0, k))
            status = build.status(node=f"robot/r{k}", state="x")
            robot.publish(Outgoing(c.STATUS, f"robot/r{k}", status))
        loop.take(bus.receive())
        wait_until(lambda: recorder.waiting() == 0 and recorder.dropped > 0)
        figures = loop.status().figures
    counts = {key: count.messages for key, count in open_log(path).counts().items()}
    assert counts[c.ODOMETRY.key("r1")] == 20
    assert sum(key.endswith("/status") for key in counts) == 9
    assert figures["dropped_samples"] == 20 + 11
    assert holes(open_log(path)) == []


def test_unsound_payloads_are_recorded_as_they_came(path):
    network = MemoryNetwork()
    world, bus = MemoryBus(network), MemoryBus(network)
    unsound = [
        Sample("source/alpha/odometry", payload, i, 0, i)
        for i, payload in enumerate([b"", b"\x91" * 200, b"\xc1", b"\x94\xc0\xc0\xc0\xc0", b"\x94"])
    ]
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ())
        for sample in unsound:
            world.publish_raw(sample)
        loop.take(bus.receive())
    assert list(open_log(path).samples()) == unsound


def test_absent_nodes_are_a_warning_until_they_appear(path):
    network = MemoryNetwork()
    bus = MemoryBus(network)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ("central", "world"))
        MemoryBus(network).declare_alive("world")
        loop.take(bus.receive())
        assert loop.status().warnings == ("central has not appeared yet",)


def team_of(source: Bus) -> list[Outgoing]:
    out = [Outgoing(c.ODOMETRY, "alpha", odometry(i)) for i in range(1_000)]
    out += [Outgoing(c.SUBMAP, "alpha", submap(i)) for i in range(20)]
    out.append(Outgoing(c.FINAL_MAP, "", FINAL))
    for one in out:
        source.publish(one)
    return out


def test_a_recording_ends_with_the_final_map_and_the_last_token(path, endpoint):
    with ZenohBus("t", endpoint) as team, ZenohBus("t", endpoint) as bus:
        team.watch_alive("recorder")
        team.declare_alive("robot/alpha")
        loop = RecordLoop(bus, Recorder(path, "t", {}), ("central",))
        thread = threading.Thread(target=loop.run, args=(threading.Event(),))
        thread.start()
        received(team, 1)  # its subscriptions are declared by then
        flows(team, path)
        published = team_of(team)
        wait_until(lambda: any(one.key == "central/final" for one in open_log(path).samples()))
        assert thread.is_alive()
        team.close()
        thread.join(60.0)
    assert not thread.is_alive()
    log = open_log(path)
    assert log.complete
    assert messages_of(list(log.samples([c.ODOMETRY, c.SUBMAP, c.FINAL_MAP])), c.ODOMETRY) == [
        one.message for one in published if one.channel is c.ODOMETRY
    ]
    assert messages_of(list(log.samples()), c.ALIVE) == [
        build.liveliness(node="robot/alpha"),
        build.liveliness(stamp_ns=999_000_000, node="robot/alpha", alive=False),
    ]
    first, *_, last = messages_of(list(log.samples()), c.STATUS)
    assert (first.state, first.warnings) == ("recording", ("central has not appeared yet",))
    assert last.state == "done"


class Team:
    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.published: list[m.Measurement] = []
        self.submaps: list[m.Submap] = []
        bus.answer(c.MEASUREMENTS, "alpha", self.measurements)
        bus.answer(c.SENT, "alpha", lambda _: [encoded(each) for each in self.submaps])

    def measurements(self, request: bytes) -> list[bytes]:
        wanted = decoded(request, m.MeasurementsRequest)
        assert wanted.only
        return [encoded(each) for each in self.published[wanted.first : wanted.last + 1]]

    def says(self, count: int) -> None:
        for _ in range(count):
            i = len(self.published)
            self.published.append(odometry(i))
            self.bus.publish(Outgoing(c.ODOMETRY, "alpha", odometry(i)))
            if i % 10 == 9:
                self.submaps.append(submap(i // 10))
                self.bus.publish(Outgoing(c.SUBMAP, "alpha", submap(i // 10)))
                self.bus.publish(Outgoing(c.OWN_POSE, "alpha", POSE))

    def ends(self, until: Callable[[], bool]) -> None:
        end = build.end(incarnation=0, alpha=len(self.published))
        self.bus.publish(Outgoing(c.END, "", end))
        self.bus.publish(Outgoing(c.FINAL_MAP, "", FINAL))

        def asked() -> bool:
            self.bus.receive(0.02)
            return until()

        wait_until(asked)
        self.bus.close()


POSE = example(m.PoseEstimate)


def logged(path: Path, channel: c.Channel) -> int:
    return len(list(open_log(path).samples([channel])))


def test_what_a_restarted_world_publishes_again_is_written_once(path):
    network = MemoryNetwork()
    bus, world = MemoryBus(network), MemoryBus(network)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ())
        for i in (0, 1, 2, 0, 1, 2, 3):
            world.publish(Outgoing(c.ODOMETRY, "alpha", odometry(i)))
        loop.take(bus.receive())
    assert messages_of(list(open_log(path).samples()), c.ODOMETRY) == [
        odometry(i) for i in range(4)
    ]


def test_the_recorder_names_the_run_by_its_log_also_after_a_restart(tmp_path):
    runs = []
    for name in ("log.mcap", "log.mcap", "other.mcap"):
        recorder, inventory = next_part(tmp_path / name, "t", {"scenario": "s"})
        with recorder:
            runs.append(
                RecordLoop(MemoryBus(MemoryNetwork()), recorder, (), inventory).status().run
            )
    first, restarted, other = runs
    assert first == restarted == open_log(tmp_path / "log.mcap").metadata["log_id"]
    assert other not in ("", first)


def flows(source: ZenohBus, path: Path) -> None:
    def heard() -> bool:
        source.publish(Outgoing(c.SIGHTINGS, "probe", PROBE))
        return any(sample.key == "source/probe/sightings" for sample in open_log(path).samples())

    wait_until(heard)


PROBE = build.sightings(robot="probe", incarnation=0)


def test_a_finite_speed_spaces_the_samples_and_a_stop_ends_them():
    stop = threading.Event()
    published: list[float] = []

    class Watched(MemoryBus):
        def publish_raw(self, sample: Sample) -> None:
            published.append(time.monotonic())
            if len(published) == 3:
                stop.set()  # before the fourth, which is due in days

    samples = [Sample("view/x", b"", stamp, 0, 0) for stamp in (0, 10**8, 2 * 10**8, 10**15)]
    began = time.monotonic()
    assert replay(Watched(MemoryNetwork()), samples, 2.0, stop) == 3
    assert published[2] - began >= 0.1


def at(*stamps: int) -> list[Sample]:
    return [Sample("k", b"", stamp, 0, i) for i, stamp in enumerate(stamps)]


@settings(deadline=None)
@given(st.lists(st.integers(-(2**62), 2**62)), st.floats(1e-3, 1e6))
def test_order_is_kept_and_delays_add_up_to_the_time_that_passed(stamps, speed):
    planned = list(schedule(at(*stamps), speed))
    assert [sample for _, sample in planned] == at(*stamps)
    assert all(delay >= 0.0 for delay, _ in planned)
    with pytest.raises(ValueError, match=r"speed .* is not positive"):
        list(schedule(at(0), math.nan))
    passed = 1e-9 * (max(stamps) - stamps[0]) / speed if stamps else 0.0
    assert math.isclose(sum(delay for delay, _ in planned), passed, rel_tol=1e-9)


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
