import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import msgspec
import pytest
from click.testing import Result

from teamslam.central.config import CentralConfig
from teamslam.central.desk import orders
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.orders import WithdrawError, give_up, judge, local_landmark, withdraw
from teamslam.central.desk.report.tables import team_rows
from teamslam.central.node import CentralNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from teamslam.team.wire.codec import encoded
from tests import commands
from tests.support import example, fused_map, on_its_key, wait_until

FUSED = example(m.FusedMap)
CONFIG = on_its_key(ch.ROBOT_CONFIG, "r3", example(m.Configuration))


@contextmanager
def centre(network: MemoryNetwork, turn: Callable[[MemoryBus], None]) -> Iterator[None]:
    """A centre that announces r3, receives orders and takes these turns until the end."""
    bus, over = MemoryBus(network), threading.Event()
    bus.declare_alive("central")
    for channel in (ch.ORDER, ch.GIVEN_UP):
        bus.subscribe(channel)

    def run() -> None:
        while not over.wait(0.01):
            bus.publish(Outgoing(ch.ROBOT_CONFIG, "r3", CONFIG))
            turn(bus)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def ordered(monkeypatch: pytest.MonkeyPatch, **answer: object) -> list[m.Message]:
    monkeypatch.setattr(orders, "CENTRE_S", 30.0)
    network, received = MemoryNetwork(), []

    def turn(bus: MemoryBus) -> None:
        for sample in bus.receive(0.0):
            received.append(opened(sample)[2])
            if answer:
                reply = msgspec.structs.replace(FUSED, **answer)
                bus.publish(Outgoing(ch.FINAL_MAP if reply.final else ch.FUSED_MAP, "", reply))

    with centre(network, turn):
        withdraw(MemoryBus(network), "r3", "a flat wheel", 30.0 if answer else 1.0)
        wait_until(lambda: bool(received), what="the order")
    return received


def test_an_order_is_given_once_and_followed(monkeypatch):
    (order,) = ordered(monkeypatch, final=False, withdrawn=("r3",))
    assert isinstance(order, m.Withdrawal)
    assert (order.robot, order.by, order.reason) == ("r3", "operator", "a flat wheel")


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ({"final": True, "withdrawn": ()}, "the final map was out before the order"),
        ({"final": False, "rule": "kalman", "withdrawn": ()}, "the rule kalman can not withdraw"),
        ({}, "no map without r3 within 1 s"),
    ],
)
def test_an_order_that_is_not_followed_says_why(monkeypatch, answer, why):
    with pytest.raises(WithdrawError, match=why):
        ordered(monkeypatch, **answer)


def test_without_a_centre_there_is_nobody_to_order(monkeypatch):
    monkeypatch.setattr(orders, "CENTRE_S", 0.2)
    with pytest.raises(WithdrawError, match="no centre and no peer answers"):
        withdraw(MemoryBus(MemoryNetwork()), "r3", "a flat wheel", 1.0)


def test_an_order_to_wait_for_a_robot_no_more_is_heard_by_the_centre_and_told(monkeypatch):
    network, node = MemoryNetwork(), CentralNode(CentralConfig(), ["r1", "r3"])

    def turn(bus: MemoryBus) -> None:
        for sample in bus.receive(0.0):
            node.handle(opened(sample)[2])
        bus.publish(Outgoing(ch.STATUS, "central", node.status()))

    with centre(network, turn):
        give_up(MemoryBus(network), "r3", "it fell into the water", 30.0)
        monkeypatch.setattr(orders, "CENTRE_S", 2.0)
        with pytest.raises(WithdrawError, match="the team has no robot r9; its robots: r3"):
            give_up(MemoryBus(network), "r9", "", 1.0)
    assert "r3 is given up" in node.status().warnings[0]


def test_what_is_no_message_of_the_team_does_not_end_an_operators_command(monkeypatch):
    monkeypatch.setattr(orders, "CENTRE_S", 0.3)
    network = MemoryNetwork()
    stranger = MemoryBus(network)
    stranger.declare_alive("central")
    stranger.publish(Outgoing(ch.ROBOT_CONFIG, "r3", CONFIG))
    for channel in (ch.ROBOT_CONFIG, ch.STATUS, ch.FUSED_MAP, ch.FINAL_MAP):
        stranger.publish_raw(Sample(channel.key("r4"), b"\xc1", 0, 0, 0))
    for order in (
        lambda bus: withdraw(bus, "r3", "", 0.2),
        lambda bus: give_up(bus, "r3", "", 0.2),
        lambda bus: judge(bus, pair(True), "", 0.2),
    ):
        with pytest.raises(WithdrawError, match=r"within 0.2 s; the (order stands|verdict is rec)"):
            order(MemoryBus(network))


def said(monkeypatch: pytest.MonkeyPatch, *words: str, rests_on: tuple[m.Judgement, ...]) -> Result:
    monkeypatch.setattr(orders, "CENTRE_S", 2.0)
    network, running = MemoryNetwork(), Outgoing(ch.FUSED_MAP, "", fused_map(verdicts=rests_on))
    monkeypatch.setattr(
        "teamslam.sim.cli.options.connect_bus", lambda *_: nullcontext(MemoryBus(network))
    )
    with centre(network, lambda bus: bus.publish(running)):
        return commands.run("verdict", *words, "--team", "t")


def pair(same: bool) -> m.Judgement:
    first, second = local_landmark("r3/1/2/3"), local_landmark("r3/1/4/5")
    return m.Judgement(first=first, second=second, same=same)


def test_a_verdict_against_an_earlier_one_on_the_pair_says_which_of_them_holds(monkeypatch):
    names, both = ("r3/1/4/5", "r3/1/2/3"), (pair(True), pair(False))
    alone = said(monkeypatch, "different", *names, rests_on=both[1:])
    assert (alone.exit_code, alone.stderr) == (0, "")
    against = said(monkeypatch, "different", *names, rests_on=both)
    assert against.exit_code == 0
    assert "have an earlier verdict, same; different is what holds" in against.stderr
    in_vain = said(monkeypatch, "same", *names, rests_on=both)
    assert in_vain.exit_code == 1
    assert "have an earlier verdict, different, which is what holds" in in_vain.stderr


def test_a_report_names_the_verdicts_and_which_of_them_the_map_rests_on():
    other = m.Judgement(
        first=local_landmark("r3/1/77/1"), second=local_landmark("r3/1/4/5"), same=True
    )
    verdicts = [
        m.Verdict(stamp_ns=0, robot="r3", judgement=each, by="operator", reason="seen")
        for each in (pair(True), other)
    ]
    log = [Sample(ch.VERDICT.key("r3"), encoded(each), 0, k, k) for k, each in enumerate(verdicts)]
    final = fused_map(final=True, verdicts=(pair(True),))
    found = evaluate([*log, Sample(ch.FINAL_MAP.key(), encoded(final), 0, 2, 2)])
    assert [words for name, words in team_rows(found) if name == "verdict"] == [
        "r3/1/2/3 and r3/1/4/5 are one landmark: seen",
        "r3/1/77/1 and r3/1/4/5 are one landmark: seen (not in the map: withdrawn, or it does not "
        "have both)",
    ]
