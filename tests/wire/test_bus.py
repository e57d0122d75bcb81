import threading
from collections.abc import Iterable
from contextlib import ExitStack
from itertools import count

import pytest

from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.bus import (
    NO_COUNTER,
    Bus,
    BusError,
    MemoryBus,
    MemoryNetwork,
    Outgoing,
    Sample,
    opened,
    read_reply,
)
from teamslam.team.wire.codec import WireError, decoded, encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.support import odometry, received, submap, wait_until

TEAMS = count()


@pytest.fixture(scope="module")
def endpoint():
    with router() as bound:
        yield bound


@pytest.fixture(params=["memory", "zenoh"])
def joined(request):
    with ExitStack() as stack:
        if request.param == "memory":
            network = MemoryNetwork()
            yield lambda: MemoryBus(network)
        else:
            endpoint = request.getfixturevalue("endpoint")
            team = f"t{next(TEAMS)}"
            yield lambda: stack.enter_context(ZenohBus(team, endpoint))


def send(bus: Bus, *messages: tuple[c.Channel, str, m.Message]) -> None:
    for message in messages:
        bus.publish(Outgoing(*message))


def until_heard(source: Bus, sink: Bus) -> None:
    sink.subscribe(c.ODOMETRY, "probe")

    def heard() -> bool:
        send(source, (c.ODOMETRY, "probe", odometry(0, "probe")))
        return bool(sink.receive(0.02))

    wait_until(heard)
    while sink.receive(0.05):
        pass


def test_what_is_published_arrives_with_its_stamps_and_counter(joined):
    robot, centre = joined(), joined()
    centre.subscribe(c.SUBMAP)
    send(robot, (c.SUBMAP, "alpha", submap(0)), (c.SUBMAP, "alpha", submap(1)))
    first, second = received(centre, 2)
    assert opened(first) == (c.SUBMAP, "alpha", submap(0))
    assert (first.key, first.stamp_ns, first.counter) == ("robot/alpha/submap", 1_000_000, 0)
    assert (second.payload, second.counter) == (encoded(submap(1)), 1)


def test_a_bus_does_not_receive_what_it_publishes(joined):
    robot, other = joined(), joined()
    robot.subscribe(c.SUBMAP)
    send(robot, (c.SUBMAP, "alpha", submap(0)))
    send(other, (c.SUBMAP, "bravo", submap(1, "bravo")))
    assert [sample.key for sample in received(robot, 1)] == ["robot/bravo/submap"]


def test_a_subscription_by_name_hears_that_robot_only(joined):
    source, sink = joined(), joined()
    sink.subscribe(c.SUBMAP, "bravo")
    send(source, (c.SUBMAP, "alpha", submap(0)), (c.SUBMAP, "bravo", submap(1, "bravo")))
    assert [sample.key for sample in received(sink, 1)] == ["robot/bravo/submap"]
    assert sink.receive(0.0) == []


def test_a_node_channel_hears_nodes_of_any_depth(joined):
    source, sink = joined(), joined()
    sink.subscribe(c.STATUS)
    for node in ("central", "robot/alpha"):
        send(source, (c.STATUS, node, build.status(node=node, state="running")))
    assert {sample.key for sample in received(sink, 2)} == {"central/status", "robot/alpha/status"}


def test_a_late_joiner_gets_every_message_of_an_all_channel(joined):
    source = joined()
    send(source, *[(c.SUBMAP, "alpha", submap(i)) for i in range(600)])
    late = joined()
    late.subscribe(c.SUBMAP)
    assert [sample.counter for sample in received(late, 600)] == list(range(600))


def test_a_late_joiner_gets_the_newest_message_of_a_latest_channel(joined):
    source = joined()
    for i in range(5):
        send(source, (c.WORLD_CONFIG, "", build.configuration(stamp_ns=i, node="world")))
    late = joined()
    late.subscribe(c.WORLD_CONFIG)
    assert [sample.counter for sample in received(late, 1)] == [4]


def test_a_late_joiner_gets_nothing_of_a_stream(joined):
    source, late = joined(), joined()
    send(source, (c.ODOMETRY, "alpha", odometry(0)))
    late.subscribe(c.ODOMETRY, "alpha")
    until_heard(source, late)
    send(source, (c.ODOMETRY, "alpha", odometry(1)))
    assert [sample.counter for sample in received(late, 1)] == [1]


def test_order_holds_across_keys_and_deliveries(joined):
    source, sink = joined(), joined()
    for channel in (c.SUBMAP, c.ROBOT_PROGRESS, c.ODOMETRY):
        sink.subscribe(channel, "alpha")
    until_heard(source, sink)
    for i in range(300):
        progress = build.progress(stamp_ns=i, robot="alpha", incarnation=0, measurements=i)
        send(source, (c.ODOMETRY, "alpha", odometry(i)), (c.SUBMAP, "alpha", submap(i)))
        send(source, (c.ROBOT_PROGRESS, "alpha", progress))
    keys = ["source/alpha/odometry", "robot/alpha/submap", "robot/alpha/progress"]
    arrived = received(sink, 900)
    expected = [(key, i) for i in range(300) for key in keys]
    assert [(sample.key, sample.counter) for sample in arrived] == expected


def test_a_question_gets_all_its_answers_in_order(joined):
    centre, robot = joined(), joined()

    def answer(request: bytes) -> Iterable[bytes]:
        wanted = decoded(request, m.SubmapsRequest)
        return [encoded(submap(i, wanted.robot)) for i in range(300)]

    centre.answer(c.SUBMAPS, "", answer)
    got = asked(robot, centre, c.SUBMAPS, "", build.submaps_request(robot="bravo"))
    assert got == [encoded(submap(i, "bravo")) for i in range(300)]


def test_a_question_that_nobody_answers_has_no_answers(joined):
    assert joined().ask(c.SUBMAPS, "", build.submaps_request(robot="alpha"), 5.0) == []


def test_an_answer_that_fails_is_told_to_the_asker(joined):
    centre, robot = joined(), joined()

    def answer(request: bytes) -> Iterable[bytes]:
        raise ValueError("no such robot")

    centre.answer(c.SUBMAPS, "", answer)
    with pytest.raises(BusError, match="central/submaps: no such robot"):
        asked(robot, centre, c.SUBMAPS, "", build.submaps_request(robot="nobody"))


def asked(
    asker: Bus, answerer: Bus, channel: c.Channel, name: str, request: m.Message
) -> list[bytes]:
    """Query while another thread runs the answering bus; repeat until its declaration is known."""
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            answerer.receive(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    replies: list[bytes] = []
    try:
        wait_until(lambda: bool(replies.extend(asker.ask(channel, name, request, 5.0)) or replies))
    finally:
        done.set()
        thread.join()
    return replies


def test_tokens_are_seen_as_they_appear_and_go_and_never_ones_own(joined):
    early, watcher = joined(), joined()
    early.declare_alive("world")
    watcher.declare_alive("central")
    watcher.watch_alive()
    late = joined()
    late.declare_alive("robot/alpha")
    seen = [opened(sample)[2] for sample in received(watcher, 2)]
    late.close()
    seen += [opened(sample)[2] for sample in received(watcher, 1)]
    assert seen == [
        build.liveliness(node="world"),
        build.liveliness(node="robot/alpha"),
        build.liveliness(node="robot/alpha", alive=False),
    ]


def test_who_holds_a_token_can_be_asked_for(joined):
    asker, robot = joined(), joined()
    assert not asker.is_alive("robot/alpha")
    robot.declare_alive("robot/alpha")
    wait_until(lambda: asker.is_alive("robot/alpha"))
    assert not asker.is_alive("robot/alph")
    robot.close()
    wait_until(lambda: not asker.is_alive("robot/alpha"))


def test_replies_to_a_request_come_with_what_arrives(joined):
    centre, robot = joined(), joined()
    answered = [encoded(submap(i)) for i in range(30)]
    robot.answer(c.SENT, "alpha", lambda request: answered)
    arrived: list[Sample] = []

    def all_here() -> bool:
        if not arrived:  # the answerer's declaration may not have arrived yet
            centre.request(c.SENT, "alpha", build.submaps_request(robot="alpha"))
        robot.receive(0.02)
        arrived.extend(centre.receive(0.02))
        return len(arrived) >= 30

    wait_until(all_here)
    assert [(s.key, s.payload, s.counter) for s in arrived] == [
        ("robot/alpha/submap", encoded(submap(i)), NO_COUNTER) for i in range(30)
    ]


@pytest.mark.parametrize("reply", [encoded(submap(0, "bravo")), encoded(odometry(0)), b"\xc1"])
def test_what_is_no_reply_to_the_question_is_dropped(reply):
    with pytest.raises(WireError):
        read_reply(c.SENT, "alpha", reply, 0)


@pytest.mark.parametrize("channel", c.CHANNELS, ids=lambda channel: channel.name)
def test_every_key_leads_back_to_its_channel_and_name(channel):
    names = {"{node}": "robot/alpha", "{robot}": "alpha"}
    name = next((name for place, name in names.items() if place in channel.template), "")
    expected = None if channel in c.UNOPENED else (channel, name)
    assert c.channel_of(channel.key(name)) == expected


def test_no_two_channels_share_a_name_or_a_key():
    assert len({channel.name for channel in c.CHANNELS}) == len(c.CHANNELS)
    assert len({channel.template for channel in c.CHANNELS}) == len(c.CHANNELS)


@pytest.mark.parametrize(
    ("key", "message", "why"),
    [
        ("robot/alpha/gossip", submap(0), "no channel has the key 'robot/alpha/gossip'"),
        ("robot/bravo/submap", submap(0), "a message of 'alpha' on the key 'robot/bravo/submap'"),
        ("robot/alpha/submap", odometry(0), "wrong tag: 'odometry/1' where 'submap/1' belongs"),
    ],
)
def test_a_message_on_a_key_that_is_not_its_own_is_refused(key, message, why):
    with pytest.raises(WireError, match=why):
        opened(Sample(key, encoded(message), message.stamp_ns, 0, 0))
