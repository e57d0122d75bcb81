import pytest

from teamslam.team.end_query import EndQuery
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Sample
from teamslam.team.wire.codec import encoded
from tests import build
from tests.support import example

FINAL = example(m.FusedMap)
CENTRES = ch.FINAL_MAP.key()
OF_R1, OF_R2 = (ch.TEAM_FINAL.key(robot) for robot in ("r1", "r2"))


@pytest.fixture
def bus():
    def kept(key: str, payload: bytes) -> bytes:
        return encoded(build.kept(stamp_ns=3, key=key, payload=payload, wall_ns=4, counter=5))

    network = MemoryNetwork()
    replies = [kept(key, encoded(FINAL)) for key in (CENTRES, OF_R1, OF_R2)]
    garbage = [b"", kept(CENTRES, b"garbage"), kept("central/map", encoded(FINAL))]
    MemoryBus(network).answer(ch.KEPT, "", lambda _: [*garbage, *replies])
    return MemoryBus(network)


@pytest.mark.parametrize(
    ("ends", "robot", "taken"),
    [
        ((ch.FINAL_MAP,), "*", [CENTRES]),
        ((ch.TEAM_FINAL,), "*", [OF_R1, OF_R2]),
        ((ch.FINAL_MAP, ch.TEAM_FINAL), "r2", [CENTRES, OF_R2]),
        ((ch.CONCLUDED,), "*", []),
    ],
    ids=["with a centre", "peers", "a driver", "by conclusions"],
)
def test_only_the_ends_that_the_team_has_are_taken(bus, ends, robot, taken):
    end = EndQuery(bus, "robot/r2", ends, robot)
    assert end.find_missed() == [Sample(key, encoded(FINAL), 3, 4, 5) for key in taken]
    assert end.find_missed() == [], "it asks again only after a while"
