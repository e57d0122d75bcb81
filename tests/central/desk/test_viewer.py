"""The viewer's process: it leaves at the end, whenever it comes."""

import threading

import msgspec
import pytest

from teamslam.central.desk.view.viewer import run_viewer
from teamslam.team import end_query
from teamslam.team.shell import FaultyRunError
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing
from teamslam.team.wire.codec import encoded
from tests import build
from tests.support import examples

FINAL = next(message for message in examples() if isinstance(message, m.FusedMap))


@pytest.mark.parametrize("lost", [(), ("r2",)])
def test_a_viewer_that_comes_after_the_end_leaves_and_says_what_is_wrong(lost, monkeypatch):
    monkeypatch.setattr(end_query, "FINAL_S", 0.1)
    final = msgspec.structs.replace(FINAL, final=True, lost=lost, withdrawn=())
    network = MemoryNetwork()
    router = MemoryBus(network)
    router.answer(
        ch.KEPT,
        "",
        lambda _: [encoded(build.kept(key="central/final", payload=encoded(final)))],
    )
    stop = threading.Event()
    timer = threading.Timer(20.0, stop.set)
    timer.start()
    try:
        if lost:
            with pytest.raises(FaultyRunError, match="r2 lost"):
                run_viewer(MemoryBus(network), stop)
        else:
            run_viewer(MemoryBus(network), stop)
        assert not stop.is_set(), "it left by itself"
    finally:
        timer.cancel()


def test_a_viewer_of_a_team_with_a_centre_does_not_end_by_a_robots_own_map(monkeypatch):
    """The robot's map, which names r2 as lost, is there before the centre's."""
    monkeypatch.setattr(end_query, "FINAL_S", 0.1)
    true = msgspec.structs.replace(FINAL, final=True, lost=(), withdrawn=())
    forged = msgspec.structs.replace(true, lost=("r2",))
    network = MemoryNetwork()
    robot = MemoryBus(network)
    robot.publish(Outgoing(ch.TEAM_FINAL, "r1", forged))
    kept = m.Kept(stamp_ns=0, key="central/final", payload=encoded(true), wall_ns=0, counter=0)
    replies = [[], [encoded(kept)]]
    MemoryBus(network).answer(ch.KEPT, "", lambda _: replies.pop(0))
    stop = threading.Event()
    timer = threading.Timer(20.0, stop.set)
    timer.start()
    try:
        run_viewer(MemoryBus(network), stop)
        assert not stop.is_set(), "it left by itself"
    finally:
        timer.cancel()
