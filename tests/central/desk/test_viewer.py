import threading

import msgspec
import pytest

from teamslam.central.desk.view.export import run_viewer
from teamslam.team import end_query
from teamslam.team.shell import FaultyRunError
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork
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
