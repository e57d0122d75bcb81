import logging
import signal
import threading
from collections.abc import Callable

import msgspec
import pytest

from teamslam.team import shell
from teamslam.team.shell import BACK_S, RECORDER, RECORDER_S, Shell, process
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample
from tests import build


class Waiting:
    finished = False
    state = "waiting"

    def begin(self) -> list[Outgoing]:
        return []

    def handle(self, message: m.Message) -> list[Outgoing]:
        return []

    def status(self) -> m.Status:
        return build.status(node="world", state=self.state, warnings=("waiting for robot/r2",))


@pytest.fixture
def clock(monkeypatch):
    """A list of the present time [s]."""
    now = [100.0]
    monkeypatch.setattr(shell.time, "monotonic", lambda: now[0])
    return now


def test_a_node_that_waits_is_heard_of_again_and_again_until_it_works(clock, caplog):
    caplog.set_level(logging.INFO, "teamslam")
    node = Waiting()
    turning = Shell(MemoryBus(MemoryNetwork()), node, "world", threading.Event())
    said = []
    for now in range(100, 136):
        clock[0] = float(now)
        node.state = "waiting" if now < 125 else "publishing"
        turning.report()
        said.append(len(caplog.messages))
    assert caplog.messages == ["waiting for robot/r2"] * 2, "after 10 s and 20 s"
    assert said.index(1) == 10


class Slow(MemoryBus):
    def __init__(self, network: MemoryNetwork, clock: list[float]) -> None:
        super().__init__(network)
        self._clock = clock
        self.at: dict[float, Callable[[], None]] = {}

    def receive(self, timeout_s: float = 0.0) -> list[Sample]:
        self._clock[0] += 0.5
        for due in [t for t in self.at if t <= self._clock[0]]:
            self.at.pop(due)()
        return super().receive(timeout_s)


@pytest.fixture
def beside_recorder(clock):
    """Buses of a process and of its recorder."""
    network = MemoryNetwork()
    bus, recorder = Slow(network, clock), MemoryBus(network)
    bus.watch_alive(RECORDER)
    return network, bus, recorder


@pytest.mark.parametrize("case", ["nobody records", "all is there", "lacks", "away", "back"])
def test_a_process_stays_while_who_records_may_still_ask_for_something(
    case, clock, beside_recorder
):
    """It leaves at once without a recorder, or when the recorder has everything."""
    network, bus, recorder = beside_recorder
    if case != "nobody records":
        recorder.declare_alive(RECORDER)
    turning = Shell(bus, Waiting(), "robot/r1", threading.Event())
    if case == "away":
        recorder.close()
    if case == "back":
        recorder.close()
        bus.at[102.0] = lambda: MemoryBus(network).declare_alive(RECORDER)
    turning.take(MemoryBus.receive(bus))
    turning.wait_for_recorder(lambda: case == "lacks" and clock[0] < 104.0)
    stayed = clock[0] - 100.0
    expected = {"lacks": 4.0, "away": RECORDER_S, "back": 2.0 + BACK_S}
    assert stayed == expected.get(case, 0.0)


@pytest.mark.parametrize("case", ["no report", "gets on", "gets no further", "an earlier life's"])
def test_a_process_stays_for_a_recorder_that_gets_on_and_leaves_one_that_does_not(
    case, clock, beside_recorder
):
    """A missing report means that the recorder has not read it yet."""
    _, bus, recorder = beside_recorder
    key = ch.TRAJECTORY.key("r1")
    totals = build.tally(node="central", since_ns=7, keys=(key,), counts=(9,))
    bus.publish_totals = lambda: totals
    recorder.declare_alive(RECORDER)
    turning = Shell(bus, Waiting(), "central", threading.Event())
    turning.take(MemoryBus.receive(bus))

    def reports(has: int | None, since_ns: int = 7) -> Callable[[], None]:
        lacking = {} if has is None else {"keys": (key,), "counts": (has,)}
        empty = build.tally(node="central", since_ns=since_ns)
        said = msgspec.structs.replace(empty, **lacking)
        return lambda: recorder.publish(Outgoing(ch.RECORDED, "central", said)) and None

    if case == "gets on":
        bus.at |= {100.0 + 20.0 * k: reports(k) for k in range(9)}
    if case == "gets no further":
        bus.at |= {110.0 + k: reports(3) for k in range(100)}
    bus.at[400.0] = reports(None)
    if case == "an earlier life's":
        bus.at[110.0] = reports(None, since_ns=3)
    turning.wait_for_recorder(lambda: False)
    stayed = clock[0] - 100.0
    expected = {"gets on": 160.0 + RECORDER_S, "gets no further": 10.0 + RECORDER_S}
    assert stayed == expected.get(case, 300.0)


def test_who_has_to_deliver_is_ended_by_the_second_signal_only():
    with process("driver", endless=True, patient=True) as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        assert signal.alarm(0) == 0  # nothing ends it
        signal.raise_signal(signal.SIGINT)
        assert signal.alarm(0) > 0
    with process("node", endless=True) as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        assert signal.alarm(0) > 0
