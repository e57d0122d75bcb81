import msgspec
import numpy as np

from teamslam.sim.radio.bus import behind_radio, plan_of, reach_of
from teamslam.sim.world.config import Radio, RadioWindow
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing
from tests import build
from tests.support import submap
from tests.teams import stream

SECOND = 1_000_000_000
PAIR = (stream("r1", 20), stream("r2", 20, y=30.0))  # they drive side by side, 30 m apart


def test_robots_reach_each_other_within_the_range_by_the_truth():
    for range_m, reached in ((29.0, False), (31.0, True)):
        reach = reach_of(Radio(comm_range_m=range_m), PAIR)
        assert reach.between("r1", "r2", 5 * SECOND) is reached
        assert reach.between("r1", "r2", 20 * SECOND), "collected at the end"


def test_windows_open_for_whom_they_name():
    three = (*PAIR, stream("r3", 20, y=5.0))
    window = RadioWindow(robots=("r1", "r3"), from_s=3.0, to_s=6.0)
    reach = reach_of(Radio(windows=(window,)), three)
    at = [t for t in range(1, 19) if reach.between("r1", "r3", t * SECOND)]
    first = reach.first_ns // SECOND
    assert at == [first + 3, first + 4, first + 5]
    assert not any(reach.between("r1", "r2", t * SECOND) for t in range(1, 19))


def test_what_is_out_of_reach_does_not_come_in_and_nobody_hears_its_question():
    network = MemoryNetwork()
    mate, world, own = (MemoryBus(network) for _ in range(3))
    door = behind_radio(own, "r1", Radio(comm_range_m=29.0))
    door.subscribe(ch.SUBMAP)
    window = RadioWindow(robots=("r1", "r2"), from_s=3.0, to_s=6.0)
    reach = reach_of(Radio(windows=(window,)), PAIR)
    world.publish(Outgoing(ch.RADIO, "", plan_of(reach)))
    assert door.receive(0.0) == []
    heard = []
    mate.answer(ch.MEMBERS, "robot/r2", lambda request: heard.append(request) or [])
    for sequence in range(10):
        stamp_ns = reach.first_ns + sequence * SECOND
        said = submap(sequence, "r2", 1)
        mate.publish(Outgoing(ch.SUBMAP, "r2", _stamped(said, stamp_ns)))
        door.publish(Outgoing(ch.OWN_POSE, "r1", _pose(stamp_ns)))
        asked = build.members_request(stamp_ns=stamp_ns)
        door.request(ch.MEMBERS, "robot/r2", asked)
    stamps = [sample.stamp_ns for sample in door.receive(0.0)]
    assert [(t - reach.first_ns) // SECOND for t in stamps] == [3, 4, 5]
    assert len(heard) == 3


def _stamped(said: m.Submap, stamp_ns: int) -> m.Submap:
    return msgspec.structs.replace(said, stamp_ns=stamp_ns, start_ns=stamp_ns - 1)


def _pose(stamp_ns: int) -> m.PoseEstimate:
    return build.pose_estimate(stamp_ns=stamp_ns, pose=np.zeros(3), covariance=np.eye(3))
