"""The recorder and the replayer as processes see them: on a bus, until the team has finished."""

import math
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from team.recording.reader import open_log
from team.recording.recorder import Recorder
from team.recording.shell import PROGRESS_EVERY, RecordLoop, record, replay
from team.wire import channels as c
from team.wire import messages as m
from team.wire.bus import Bus, MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from team.wire.codec import encoded
from team.wire.zenoh_bus import ZenohBus, router
from tests.support import examples, odometry, received, submap, wait_until

FINAL = next(message for message in examples() if isinstance(message, m.FusedMap))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


@pytest.fixture
def endpoint() -> Iterator[str]:
    with router() as bound:
        yield bound


def messages_of(samples: list[Sample], channel: c.Channel) -> list[m.Message]:
    found = [opened(sample) for sample in samples]
    return [message for of, _, message in found if of is channel]


def test_progress_is_told_every_256_readings_and_when_it_is_quiet(path: Path) -> None:
    network = MemoryNetwork()
    world, bus = MemoryBus(network), MemoryBus(network)
    world.subscribe(c.RECORDER_PROGRESS)
    told = []
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ())
        for count in (PROGRESS_EVERY - 1, 1, 10, 0, 0):
            for i in range(count):
                world.publish(Outgoing(c.ODOMETRY, "alpha", odometry(i)))
            loop.take(bus.receive())
            got = messages_of(world.receive(), c.RECORDER_PROGRESS)
            told.append([message.readings for message in got if isinstance(message, m.Progress)])
    assert told == [[], [PROGRESS_EVERY], [], [PROGRESS_EVERY + 10], []]


def test_a_new_epoch_counts_from_zero(path: Path) -> None:
    network = MemoryNetwork()
    world, bus = MemoryBus(network), MemoryBus(network)
    world.subscribe(c.RECORDER_PROGRESS)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ())
        for epoch, reading in ((0, 0), (0, 1), (3, 0)):
            message = m.Odometry(7, "alpha", epoch, reading, 0, 0.0, 0.0)
            world.publish(Outgoing(c.ODOMETRY, "alpha", message))
        loop.take(bus.receive())
        loop.take([])
    assert messages_of(world.receive(), c.RECORDER_PROGRESS) == [
        m.Progress(7, "recorder", "alpha", 3, 1, 0)
    ]


def test_unsound_payloads_are_recorded_as_they_came(path: Path) -> None:
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


def test_absent_nodes_are_a_warning_until_they_appear(path: Path) -> None:
    network = MemoryNetwork()
    bus = MemoryBus(network)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ("central", "world"))
        MemoryBus(network).declare_alive("world")
        loop.take(bus.receive())
        assert loop.status().warnings == ("central has not appeared yet",)


def team_of(source: Bus) -> list[Outgoing]:
    """What a small team publishes, its final map at the end."""
    out = [Outgoing(c.ODOMETRY, "alpha", odometry(i)) for i in range(1_000)]
    out += [Outgoing(c.SUBMAP, "alpha", submap(i)) for i in range(20)]
    out.append(Outgoing(c.FINAL_MAP, "", FINAL))
    for one in out:
        source.publish(one)
    return out


def test_a_recording_ends_with_the_final_map_and_the_last_token(path: Path, endpoint: str) -> None:
    statuses: list[m.Status] = []
    with ZenohBus("t", endpoint) as team, ZenohBus("t", endpoint) as bus:
        team.watch_alive("recorder")
        team.declare_alive("robot/alpha")
        thread = threading.Thread(
            target=record, args=(bus, Recorder(path, "t", {}), ("central",), statuses.append)
        )
        thread.start()
        received(team, 1)  # the recorder is alive: its subscriptions are declared
        flows(team, path)
        published = team_of(team)
        wait_until(lambda: any(one.key == "central/final" for one in open_log(path).samples()))
        assert thread.is_alive()
        team.close()
        thread.join(20.0)
    assert not thread.is_alive()
    log = open_log(path)
    assert log.complete
    assert messages_of(list(log.samples([c.ODOMETRY, c.SUBMAP, c.FINAL_MAP])), c.ODOMETRY) == [
        one.message for one in published if one.channel is c.ODOMETRY
    ]
    assert messages_of(list(log.samples()), c.ALIVE) == [
        m.Liveliness(0, "robot/alpha", True),
        m.Liveliness(999_000_000, "robot/alpha", False),
    ]
    assert messages_of(list(log.samples()), c.STATUS) == statuses != []
    assert statuses[0].warnings == ("central has not appeared yet",)


def flows(source: ZenohBus, path: Path) -> None:
    """Return when what `source` publishes is in the log at `path`."""

    def heard() -> bool:
        source.publish(Outgoing(c.SIGHTINGS, "probe", PROBE))
        return any(sample.key == "source/probe/sightings" for sample in open_log(path).samples())

    wait_until(heard)


PROBE = m.Sightings(0, "probe", 0, 0, (), b"", b"")


def test_a_recording_ends_when_asked(path: Path) -> None:
    stop = threading.Event()
    network = MemoryNetwork()
    bus, world = MemoryBus(network), MemoryBus(network)

    def stopping(status: m.Status) -> None:
        world.publish(Outgoing(c.ODOMETRY, "alpha", odometry(1)))
        stop.set()

    record(bus, Recorder(path, "t", {}), on_status=stopping, stop=stop)
    log = open_log(path)
    assert log.complete
    assert messages_of(list(log.samples()), c.ODOMETRY) == [odometry(1)]


def plain_subscriber(endpoint: str, arrived: list[tuple[str, bytes, bytes]]) -> zenoh.Session:
    """A foreign session on everything that the team `t` publishes."""
    config = zenoh.Config.from_json5(
        f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, '
        "scouting: {multicast: {enabled: false}}, "
        "transport: {shared_memory: {enabled: false}}}"
    )
    session = zenoh.open(config)

    def take(sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        arrived.append((str(sample.key_expr), sample.payload.to_bytes(), attachment))

    session.declare_subscriber("team/t/**", zenoh.handlers.Callback(take, indirect=False))
    return session


def test_a_replay_is_the_log_byte_by_byte_in_its_order(path: Path, endpoint: str) -> None:
    readings, submaps = [encoded(odometry(i)) for i in range(50)], [encoded(submap(0))]
    keys = [c.ODOMETRY, c.SUBMAP, c.ROBOT_PROGRESS, c.TRUTH, c.STATUS]
    with Recorder(path, "t", {}) as recorder:
        recorder.write(
            Sample(channel.key("alpha"), (submaps + readings)[i % 51], i, 2 * i, i)
            for i in range(4_000)
            for channel in keys
        )
    log = open_log(path)
    arrived: list[tuple[str, bytes, bytes]] = []
    with plain_subscriber(endpoint, arrived), ZenohBus("t", endpoint) as bus:

        def heard() -> bool:
            bus.publish_raw(Sample("source/probe/sightings", b"", 0, 0, 0))
            return bool(arrived)

        wait_until(heard)
        assert replay(bus, log.samples(), math.inf, threading.Event()) == 20_000
        wait_until(lambda: sum("/probe/" not in key for key, _, _ in arrived) >= 20_000)
    assert [one for one in arrived if "/probe/" not in one[0]] == [
        (
            f"team/t/{one.key}",
            one.payload,
            struct.pack("<qqq", one.stamp_ns, one.wall_ns, one.counter),
        )
        for one in log.samples()
    ]


def test_a_replayed_recording_is_recorded_the_same(path: Path, tmp_path: Path) -> None:
    network = MemoryNetwork()
    bus, team = MemoryBus(network), MemoryBus(network)
    with Recorder(path, "t", {}) as recorder:
        loop = RecordLoop(bus, recorder, ())
        team_of(team)
        loop.take(bus.receive())
    again = MemoryNetwork()
    sink, source = MemoryBus(again), MemoryBus(again)
    with Recorder(tmp_path / "again.mcap", "t", {}) as recorder:
        loop = RecordLoop(sink, recorder, ())
        replay(source, open_log(path).samples(), math.inf, threading.Event())
        loop.take(sink.receive())
    assert list(open_log(tmp_path / "again.mcap").samples()) == list(open_log(path).samples())


def test_a_finite_speed_spaces_the_samples_and_a_stop_ends_them() -> None:
    stop = threading.Event()
    published: list[float] = []

    class Watched(MemoryBus):
        def publish_raw(self, sample: Sample) -> None:
            published.append(time.monotonic())
            if len(published) == 3:
                stop.set()  # before the fourth, which is due in days

    samples = [Sample("view/x", b"", stamp, 0, 0) for stamp in (0, 10**8, 2 * 10**8, 10**15)]
    assert replay(Watched(MemoryNetwork()), samples, 2.0, stop) == 3
    assert published[2] - published[0] >= 0.09
