import itertools
import random
import subprocess
import sys
import threading
import time

import msgspec
import pytest
import zenoh

from teamslam.team import end_query
from teamslam.team.end_query import EndQuery
from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.bus import BusError, Outgoing, Sample, opened
from teamslam.team.wire.codec import LARGEST_PAYLOAD, decoded, encoded
from teamslam.team.wire.zenoh import bus as zenoh_bus, recovery as recovery_module
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.delivery import Attachment, pack, unpack
from teamslam.team.wire.zenoh.recovery import Recovery
from teamslam.team.wire.zenoh.router import router
from teamslam.team.wire.zenoh.session import client
from tests import build
from tests.support import ROOT, Link, example, odometry, received, submap, wait_until

FINAL = example(m.FusedMap)


@pytest.fixture
def endpoint():
    with router() as bound:
        yield bound


def flowing(source: ZenohBus, sink: ZenohBus, *channels: c.Channel) -> None:
    for channel in (*channels, c.SIGHTINGS):
        sink.subscribe(channel)
    probe = Sample("source/probe/sightings", b"", 0, 0, 0)

    def heard() -> bool:
        source.publish_raw(probe)
        return bool(sink.receive(0.02))

    wait_until(heard)
    while sink.receive(0.1):
        pass


def progress(i: int) -> Outgoing:
    said = build.progress(stamp_ns=i, robot="alpha", incarnation=0, measurements=i)
    return Outgoing(c.ROBOT_PROGRESS, "alpha", said)


def counters(samples: list[Sample], key: str) -> list[int]:
    return [sample.counter for sample in samples if sample.key == key]


@pytest.mark.parametrize("behind", ["source", "sink"])
def test_a_cut_link_loses_nothing_but_streams(endpoint, behind):
    with (
        Link(endpoint) as link,
        ZenohBus("t", link.endpoint if behind == "source" else endpoint) as source,
        ZenohBus("t", link.endpoint if behind == "sink" else endpoint) as sink,
    ):
        flowing(source, sink, c.SUBMAP, c.ROBOT_PROGRESS)
        for i in range(100):
            if i == 50:
                arrived = received(sink, 100)
                link.cut()
            source.publish(Outgoing(c.SUBMAP, "alpha", submap(i)))
            source.publish(progress(i))
        source.publish(Outgoing(c.SUBMAP, "bravo", submap(0, "bravo")))  # a publisher of the cut
        link.mend()
        arrived += received(sink, 101)
    assert counters(arrived, "robot/alpha/submap") == list(range(100))
    assert counters(arrived, "robot/alpha/progress") == list(range(100))
    assert counters(arrived, "robot/bravo/submap") == [0]


def test_a_killed_process_loses_its_token(endpoint):
    program = (
        "import sys; from teamslam.team.wire.zenoh.bus import ZenohBus\n"
        f"bus = ZenohBus('t', {endpoint!r}); bus.declare_alive('robot/alpha')\n"
        "print('ready', flush=True); sys.stdin.read()"
    )
    with ZenohBus("t", endpoint) as watcher, python(program) as child:
        watcher.watch_alive()
        assert opened(received(watcher, 1)[0])[2] == build.liveliness(node="robot/alpha")
        child.kill()
        gone = build.liveliness(node="robot/alpha", alive=False)
        assert opened(received(watcher, 1)[0])[2] == gone


def python(program: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_process_that_dies_of_an_exception_ends(endpoint):
    program = (
        "from teamslam.team.wire import channels as c\n"
        "from teamslam.team.wire.zenoh.bus import ZenohBus\n"
        f"bus = ZenohBus('t', {endpoint!r})\n"
        "for channel in c.CHANNELS: bus.subscribe(channel)\n"
        "bus.answer(c.SUBMAPS, '', lambda request: []); bus.watch_alive()\n"
        "print('ready', flush=True)\n"
        "while not bus.receive(1.0): pass\n"
        "raise RuntimeError('of an exception')"
    )
    with ZenohBus("t", endpoint) as source, python(program) as child:
        assert child.stdout.readline() == "ready\n"
        end = time.monotonic() + 30.0
        while child.poll() is None and time.monotonic() < end:  # traffic while it goes down
            source.publish(Outgoing(c.ODOMETRY, "alpha", odometry(0)))
        gone = child.poll()
        child.kill()
        told = child.stderr.read()
    assert gone == 1
    assert told.endswith("RuntimeError: of an exception\n")


def test_a_client_waits_for_a_router_that_starts_later():
    with router() as free:
        pass
    joined: list[ZenohBus] = []
    thread = threading.Thread(target=lambda: joined.append(ZenohBus("t", free)))
    thread.start()
    with router(free):
        thread.join()
        joined[0].close()


def test_a_taken_port_is_an_error_that_names_it(endpoint):
    with pytest.raises(BusError, match=f"can not listen at {endpoint}"), router(endpoint):
        pass


def test_teams_do_not_hear_each_other(endpoint):
    with ZenohBus("a", endpoint) as a, ZenohBus("b", endpoint) as b, ZenohBus("a", endpoint) as own:
        own.subscribe(c.SUBMAP)
        b.publish(Outgoing(c.SUBMAP, "bravo", submap(0, "bravo")))
        a.publish(Outgoing(c.SUBMAP, "alpha", submap(0)))
        assert [sample.key for sample in received(own, 1)] == ["robot/alpha/submap"]


def test_an_answer_that_never_comes_is_an_error(endpoint):
    with ZenohBus("t", endpoint) as silent, ZenohBus("t", endpoint) as asker:
        silent.answer(c.SUBMAPS, "", lambda request: [])

        def timed_out() -> bool:
            try:
                asker.ask(c.SUBMAPS, "", build.submaps_request(robot="alpha"), 0.2)
            except BusError as error:
                return "team/t/central/submaps" in str(error)
            return False  # its declaration has not arrived yet

        wait_until(timed_out)


def test_a_payload_beyond_the_limit_is_not_sent(endpoint):
    with ZenohBus("t", endpoint) as bus, pytest.raises(BusError, match="split the map"):
        bus.publish_raw(Sample("robot/alpha/submap", bytes(LARGEST_PAYLOAD + 1), 0, 0, 0))


def test_a_publication_without_its_attachment_is_dropped_and_logged(endpoint, caplog):
    with ZenohBus("t", endpoint) as source, ZenohBus("t", endpoint) as sink:
        flowing(source, sink, c.ODOMETRY)
        with client(endpoint, 5.0, None) as stranger:
            stranger.put("team/t/source/alpha/odometry", encoded(odometry(0)))
        wait_until(lambda: sink.receive(0.02) == [] and bool(caplog.records))
        assert sink.dropped == 1
    assert "team/t/source/alpha/odometry: dropped" in caplog.text


def put_beside(bus: ZenohBus, key: str, beside: bytes) -> None:
    bus._publishers[key].put(encoded(submap(1)), attachment=beside)


OTHER = "robot/alpha/sighting_factor"
"""A valid key, under which a sample of `robot/alpha/submap` may arrive after a cut."""


@pytest.mark.parametrize(
    ("beside", "why"),
    [
        (pack(f"team/t/{OTHER}", Attachment(1, 2, 1)), "on another key"),
        (pack("team/u/robot/alpha/submap", Attachment(1, 2, 1)), "on another key"),
        (pack("team/t/robot/alpha/submap", Attachment(1, 2, 1))[:24], "an older version"),
    ],
    ids=["another key", "another team", "no hash"],
)
def test_a_sample_of_another_key_is_dropped_and_has_not_arrived(endpoint, caplog, beside, why):
    caplog.set_level("INFO")
    key = "robot/alpha/submap"
    with ZenohBus("t", endpoint) as source, ZenohBus("t", endpoint) as sink:
        flowing(source, sink, c.SUBMAP)
        source.publish(Outgoing(c.SUBMAP, "alpha", submap(0)))
        arrived = received(sink, 1)
        put_beside(source, key, beside)

        def requested() -> bool:
            arrived.extend(sink.receive(0.02))
            return "asked for" in caplog.text

        wait_until(requested)
        source._published[key] = 2
        source.publish(Outgoing(c.SUBMAP, "alpha", submap(2)))
        wait_until(lambda: bool(arrived.extend(sink.receive(0.02)) or len(arrived) >= 2))
        assert counters(arrived, key) == [0, 2]
        assert sink.find_missing() == {key: [(1, 1)]}
        assert sink.dropped >= 1
    assert why in caplog.text


def test_a_sample_that_came_under_another_key_is_fetched_from_its_publisher(endpoint, monkeypatch):
    """The first arrival of the second submap is as Zenoh delivered some after a cut."""
    misled: list[str] = []

    def unpack_misled(key: str, data: bytes) -> Attachment:
        if unpack(key, data).counter == 1 and not misled:
            misled.append(key)
            return unpack(f"team/t/{OTHER}", data)
        return unpack(key, data)

    monkeypatch.setattr(zenoh_bus, "unpack", unpack_misled)
    with ZenohBus("t", endpoint) as source, ZenohBus("t", endpoint) as sink:
        flowing(source, sink, c.SUBMAP)
        for k in range(3):
            source.publish(Outgoing(c.SUBMAP, "alpha", submap(k)))
        assert counters(received(sink, 3), "robot/alpha/submap") == [0, 1, 2]
        assert (misled, sink.dropped) == (["team/t/robot/alpha/submap"], 1)
        assert sink.find_missing() == {}


def test_a_heartbeat_on_half_a_key_is_nobodys(endpoint, caplog):
    """Zenoh delivered such a heartbeat when links of fifty robots had been cut."""
    caplog.set_level("INFO")
    with ZenohBus("t", endpoint) as bus, client(endpoint, 5.0, None) as stranger:
        bus.subscribe(c.HEAD)

        def heard() -> bool:  # a sample without attachment is logged, and came after the heartbeat
            stranger.put("team/t/source/alpha/head/@adv/pub", (30).to_bytes(4, "little"))
            stranger.put("team/t/source/alpha/head", b"")
            bus.receive(0.02)
            return "attachment" in caplog.text

        wait_until(heard)
        until = time.monotonic() + 1.0  # missing samples are requested after half a second
        while time.monotonic() < until:
            bus.receive(0.05)
        assert bus.find_missing() == {}
    assert "asked for" not in caplog.text


def test_the_publishers_of_a_node_and_of_all_nodes_are_tracked_up_to_a_bound(
    endpoint, monkeypatch, caplog
):
    """Keys and publishers are names from the wire; those beyond the bound are not requested."""
    asked: list[tuple[str, str]] = []
    monkeypatch.setattr(
        Recovery, "_ask_cache", lambda self, key, publisher, *_: asked.append((key, publisher))
    )
    monkeypatch.setattr(recovery_module, "MOST_OF_A_NODE", 10)
    monkeypatch.setattr(recovery_module, "MOST_PUBLISHERS", 15)
    monkeypatch.setattr(recovery_module, "MOST_ASKED", 4)
    with client(endpoint, 5.0, None) as session:
        recovery = Recovery(session, "team/t/", lambda sample: None, lambda work: None)
        for key in ("robot/r1/submap", "robot/r2/submap"):
            for k in range(1_000):
                recovery.take_heartbeat(key, f"{key}/{k}", 2**32 - 2)
        lost = {key: len(intervals) for key, intervals in recovery.find_missing().items()}
        assert lost == {"robot/r1/submap": 10, "robot/r2/submap": 5}
        assert recovery.untracked == 1_985
        assert len(caplog.records) < 120
        for tick in range(40):
            before = len(asked)
            recovery.overdue(0.15 * tick)
            assert len(asked) <= before + 4
        assert len(set(asked)) == 15, "each is asked in its turn"


def test_a_heartbeat_of_a_publisher_that_is_another_keys_counts_for_nothing(endpoint):
    with client(endpoint, 5.0, None) as session:
        source = zenoh.SourceInfo(session.declare_publisher("any").id, 0)
        recovery = Recovery(session, "team/t/", lambda sample: None, lambda work: None)
        own = Sample("robot/r1/submap", b"", 0, 0, 0)
        assert recovery.take_sample(own, source) == [own]
        name = f"{source.source_id.zid}/{source.source_id.eid}"
        recovery.take_heartbeat("robot/r2/submap", name, 25)
        assert recovery.find_missing() == {}
        recovery.take_heartbeat("robot/r1/submap", name, 2)
        assert recovery.find_missing() == {"robot/r1/submap": [(1, 2)]}


def test_a_team_that_speaks_faster_than_it_is_read_keeps_nobody(endpoint, monkeypatch):
    """Samples that arrive during a read wait for the next one, so that a slow reader returns."""
    with ZenohBus("t", endpoint) as source, ZenohBus("t", endpoint) as sink:
        flowing(source, sink)
        read, back = sink._take_sample, threading.Event()

        def slowly(received: zenoh.Sample) -> list[Sample]:
            time.sleep(0.005)
            return read(received)

        monkeypatch.setattr(sink, "_take_sample", slowly)

        def speak() -> None:
            until = time.monotonic() + 10.0
            while not back.is_set() and time.monotonic() < until:
                source.publish_raw(Sample("source/probe/sightings", b"", 0, 0, 0))
                time.sleep(0.001)

        publisher = threading.Thread(target=speak)
        publisher.start()
        wait_until(lambda: bool(sink.receive(0.1)))
        heard = publisher.is_alive()
        back.set()
        publisher.join()
    assert heard, "it was back while the other still spoke"


def test_close_wakes_a_receiver_and_ends_the_bus(endpoint):
    bus = ZenohBus("t", endpoint)
    got: list[list[Sample]] = []
    thread = threading.Thread(target=lambda: got.append(bus.receive(60.0)))
    thread.start()
    bus.close()
    thread.join(60.0)
    bus.close()
    assert not thread.is_alive()
    for act in (bus.receive, lambda: bus.subscribe(c.SUBMAP), lambda: bus.publish(progress(0))):
        with pytest.raises(BusError, match="closed"):
            act()


def join_late(endpoint: str, team: str, rng: random.Random) -> dict[str, list[int]]:
    """Counters of each key that a bus receives which joins while four others publish."""
    robots, messages = [f"r{n}" for n in range(4)], 24
    buses = {robot: ZenohBus(team, endpoint) for robot in robots}

    def publish(first: int, end: int) -> None:
        for count, robot in itertools.product(range(first, end), robots):
            message = build.withdrawal(stamp_ns=count, robot=robot, reason="x" * 1_500)
            buses[robot].publish(Outgoing(c.WITHDRAWAL, robot, message))

    before = rng.randrange(messages)
    publish(0, before)
    sending = threading.Thread(target=publish, args=(before, messages))
    sending.start()
    found: dict[str, list[int]] = {c.WITHDRAWAL.key(robot): [] for robot in robots}
    with ZenohBus(team, endpoint) as late:
        late.subscribe(c.WITHDRAWAL)
        for sample in received(late, messages * len(robots)):
            found[sample.key].append(sample.counter)
        sending.join()
    for bus in buses.values():
        bus.close()
    return found


def test_who_joins_while_others_publish_gets_everything_once_and_in_order(endpoint):
    rng = random.Random(5)
    for number in range(12):
        found = join_late(endpoint, f"t{number}", rng)
        assert all(counters == list(range(24)) for counters in found.values())


def test_who_wants_the_whole_of_a_key_gets_what_was_said_before_it_came(endpoint):
    with ZenohBus("t", endpoint) as source, ZenohBus("t", endpoint) as sink:
        for i in range(50):
            source.publish(progress(i))
        sink.subscribe(c.ROBOT_PROGRESS, whole=True)
        assert counters(received(sink, 50), "robot/alpha/progress") == list(range(50))
        assert sink.find_missing() == {}


def test_the_router_keeps_the_final_map_of_each_team_for_who_was_away(endpoint, monkeypatch):
    first, final = FINAL, msgspec.structs.replace(FINAL, dof=99)
    with ZenohBus("t", endpoint) as centre, ZenohBus("other", endpoint) as stranger:
        assert EndQuery(centre).find_missed() == []
        centre.publish(Outgoing(c.FINAL_MAP, "", first))
        centre.publish(Outgoing(c.FINAL_MAP, "", final))
        wait_until(lambda: bool(EndQuery(centre).find_missed()))
        assert EndQuery(stranger).find_missed() == []
    with ZenohBus("t", endpoint) as straggler:
        (sample,) = EndQuery(straggler).find_missed()
        assert decoded(sample.payload, m.FusedMap) == final
        assert (sample.key, sample.stamp_ns) == (c.FINAL_MAP.key(), final.stamp_ns)
        monkeypatch.setattr(end_query, "_STARTED", time.monotonic())
        assert EndQuery(straggler).find_missed() == [], "it begins and knows nothing of that run"
        monkeypatch.setenv(end_query.SINCE, str(time.time_ns() - 60 * 10**9))
        assert EndQuery(straggler).find_missed(), "its parent says that it belongs to that run"


def test_keys_of_no_channel_are_dropped_and_counted_before_anything_is_stored(endpoint, caplog):
    buses = ZenohBus("t", endpoint), ZenohBus("t", endpoint)
    with buses[0] as sink, buses[1] as source, client(endpoint, 5.0, None) as session:
        flowing(source, sink, c.STATUS)
        for k in range(3_000):
            deep = f"team/t/robot/r1/x{k}/status"
            odd = f"team/t/robot/X{k}/status"  # as many parts as a status key, of no node
            for key in (deep, odd):
                session.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        assert source.publish(Outgoing(c.STATUS, "robot/r1", build.status()))
        assert [sample.key for sample in received(sink, 1)] == ["robot/r1/status"]
        wait_until(lambda: sink.receive(0.02) == [] and sink.dropped == 3_000)
    assert "no channel has this key" in caplog.text
    assert len(caplog.records) < 100


def test_a_bus_receives_samples_of_a_bounded_number_of_keys(endpoint, monkeypatch):
    """Without keys anyone can publish in the names of any number of robots."""
    monkeypatch.setattr(zenoh_bus, "MOST_KEYS", 3)
    with ZenohBus("t", endpoint) as sink, ZenohBus("t", endpoint) as source:
        flowing(source, sink, c.STATUS)
        seen: set[str] = set()

        def dropped() -> bool:
            for k in range(6):
                node = f"robot/r{k}"
                source.publish(Outgoing(c.STATUS, node, build.status(node=node)))
            seen.update(sample.key for sample in sink.receive(0.02))
            return sink.dropped >= 6

        wait_until(dropped)
        assert len(seen) <= 3
