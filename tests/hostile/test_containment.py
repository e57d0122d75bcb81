import re
import threading

import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.verification.verification import verify
from teamslam.central.main import CentralShell
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.node import CentralNode
from teamslam.sim.in_memory.team import final_map
from teamslam.team.containment import Boundary
from teamslam.team.recording.recorder import Recorder
from teamslam.team.recording.shell import RecordLoop
from teamslam.team.rejection import Rejection
from teamslam.team.robot.main import RobotShell
from teamslam.team.robot.mapper import Mapper
from teamslam.team.robot.node import RobotNode
from teamslam.team.shell import FaultyRunError, Shell
from teamslam.team.store import SubmapStore
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, opened
from teamslam.team.wire.codec import encoded
from tests import build
from tests.sim.reruns import messages, team_samples, thesis, written
from tests.support import submap
from tests.teams import config, published, stream
from tests.test_laws import CENTRE, assert_each_measurement_once

BROKEN_NS = 17_000_000_000
"""r1's and r2's odometry that ends here, in their second window, can not be handled."""


@pytest.fixture
def brittle(monkeypatch):
    whole = Mapper._drive

    def drive(self, measurement):
        if measurement.stamp_ns == BROKEN_NS:
            self._slam.sequence += 7
            self._slam.segmenter = None
            raise ZeroDivisionError("no way")
        return whole(self, measurement)

    monkeypatch.setattr(Mapper, "_drive", drive)


def faults(samples: list[Sample]) -> list[m.Fault]:
    found = [opened(s)[2] for s in samples if s.key.endswith("/fault")]
    return [message for message in found if isinstance(message, m.Fault)]


@pytest.mark.usefixtures("brittle")
def test_a_measurement_that_raises_is_named_and_its_robot_maps_on_as_if_it_had_not_been_there(
    tmp_path,
):
    samples = list(team_samples(thesis(45)))
    told = faults(samples)
    assert [(f.node, f.origin, f.message) for f in told] == [
        (f"robot/{r}", ch.ODOMETRY.key(r), "odometry/1") for r in ("r1", "r2")
    ]
    assert {(f.error, f.text, f.stamp_ns) for f in told} == {
        ("ZeroDivisionError", "no way", BROKEN_NS)
    }
    for fault in told:
        assert re.fullmatch(r"teamslam\.team\.robot\.mapper:Mapper\.drive:\d+", fault.place)
    assert_each_measurement_once(samples)
    for robot in ("r1", "r2"):
        (done,) = messages(samples, ch.ROBOT_DONE, robot)
        assert isinstance(done, m.Done)
        ledger = {each.disposition: each.measurements for each in done.ledger}
        assert ledger[Rejection.SET_ASIDE.disposition] == 1
    assert {x.robot for x in final_map(samples).members} == {"r1", "r2"}
    evaluation = evaluate(samples)
    assert evaluation.faults == 2
    assert [note.partition(",")[0] for note in evaluation.notes] == [
        f"{f.node} set 1 messages aside; the first" for f in told
    ]
    result = verify(written(tmp_path / "log.mcap", samples))
    assert result.first is None, str(result.first)


@pytest.mark.usefixtures("brittle")
def test_a_robot_that_was_put_back_says_what_one_says_that_never_had_the_measurement():
    measurements = published(stream("r1", 30))
    broken = next(r for r in measurements if isinstance(r, m.Odometry) and r.stamp_ns == BROKEN_NS)
    node, without = RobotNode(config()), RobotNode(config())
    boundary = Boundary("robot/r1")
    said: list[list[m.Message]] = [[], []]
    for measurement in measurements:
        said[0] += submaps(boundary.hand(node, measurement))
        if measurement is broken:
            without.inbox.next_measurement += 1
        else:
            said[1] += submaps(without.handle(measurement))
    assert boundary.faults == 1
    assert said[0] == said[1]
    assert len(said[0]) > 5


def submaps(out: list[Outgoing]) -> list[m.Message]:
    shown = (ch.SUBMAP, ch.OWN_POSE, ch.OWN_MAP)
    return [o.message for o in out if o.channel in shown]


def test_a_submap_that_raises_at_the_centre_is_acknowledged_and_the_others_are_in_the_map(
    monkeypatch,
):
    whole = SubmapStore.add_submap

    def add(self: SubmapStore, of: m.Submap) -> str | None:
        if (of.robot, of.sequence) == ("r1", 1):
            raise np.linalg.LinAlgError("singular")
        return whole(self, of)

    monkeypatch.setattr(SubmapStore, "add_submap", add)
    samples = list(team_samples(thesis(90)))
    (fault,) = faults(samples)
    assert (fault.node, fault.message, fault.error) == ("central", "submap/1", "LinAlgError")
    (done,) = messages(samples, ch.ROBOT_DONE, "r1")
    assert isinstance(done, m.Done)
    credit = messages(samples, ch.CENTRAL_PROGRESS, "r1")
    assert isinstance(credit[-1], m.Progress)
    assert credit[-1].submaps == done.submaps > 5, "nobody waits for what was set aside"
    final = final_map(samples)
    assert {x.robot: x.sequence for x in final.members}["r1"] == 0
    assert m.VersionEntry(robot="r1", incarnation=done.incarnation, sequence=1) in final.missing


def singular(*_: object) -> list[Outgoing]:
    raise np.linalg.LinAlgError("singular")


def test_where_the_final_map_raises_the_newest_one_is_final_provisional_and_says_so(monkeypatch):
    monkeypatch.setattr(MapPublisher, "publish_final", singular)
    samples = list(team_samples(thesis(45)))
    final = final_map(samples)
    assert final.provisional
    assert "not the final map, which raised" in final.reasons[-1]
    assert len(faults(samples)) == 1


def test_running_maps_that_raise_take_nothing_from_the_final_one(monkeypatch):
    whole = final_map(list(team_samples(thesis(20))))
    monkeypatch.setattr(MapPublisher, "publish_due", singular)
    final = final_map(list(team_samples(thesis(20))))
    assert not final.provisional
    assert (final.means, final.covariance) == (whole.means, whole.covariance)


def test_a_reply_that_is_none_is_refused_and_a_robot_that_can_not_resume_begins_anew():
    network = MemoryNetwork()
    centre, viewer = MemoryBus(network), MemoryBus(network)
    start = build.initial_pose()
    centre.answer(ch.SUBMAPS, "", lambda _: [encoded(start)])
    centre.answer(ch.MEASUREMENTS, "r1", lambda _: [encoded(submap(0))])
    for channel in (ch.FAULT, ch.ROBOT_CONFIG):
        viewer.subscribe(channel)
    stop = threading.Event()
    stop.set()
    robot = RobotShell(MemoryBus(network), config("r1"), stop, patience_s=0.0)
    with pytest.raises(FaultyRunError, match=r"central/submaps: \w+ at teamslam\.team\.robot"):
        robot.run()
    assert robot.node.next_measurement == 0
    assert len(faults([s for s in viewer.receive() if s.key.endswith("fault")])) == 1


def test_a_token_with_a_name_that_no_node_has_ends_neither_centre_nor_recorder(tmp_path):
    network, name = MemoryNetwork(), "robot/" + "a" * 25_000
    MemoryBus(network).declare_alive(name)
    shell = CentralShell(MemoryBus(network), CENTRE, ["r1"], threading.Event())
    token = Sample(ch.ALIVE.key(name), encoded(build.liveliness(node=name)), 0, 0, 0)
    shell._shell.take(shell._patient([token]))
    assert shell._shell.boundary.refused == 1
    with Recorder(tmp_path / "log.mcap", "t", {}) as recorder:
        loop = RecordLoop(MemoryBus(network), recorder, [])
        loop.take([token])
        assert loop.written == 0, "the key is of no channel"


def test_a_centre_that_fails_to_list_measurements_looks_for_missing_submaps(monkeypatch):
    shell = CentralShell(MemoryBus(MemoryNetwork()), CENTRE, ["r1"], threading.Event())
    looks: list[int] = []

    def fail() -> None:
        raise ZeroDivisionError("no way")

    def look() -> list[m.SubmapsRequest]:
        looks.append(1)
        return []

    monkeypatch.setattr(shell.node, "requests", fail)
    monkeypatch.setattr(shell.node, "lacking", look)
    shell._duty()
    assert looks
    assert shell._shell.boundary.faults == 1


def test_what_can_not_be_published_is_a_fault_and_the_rest_is_published(monkeypatch):
    network = MemoryNetwork()
    bus, sink = MemoryBus(network), MemoryBus(network)
    sink.subscribe(ch.SUBMAP)
    sink.subscribe(ch.FAULT)
    whole = bus.publish_raw

    def publish_raw(sample: Sample) -> None:
        if sample.key.endswith("submap") and sample.counter == 0:
            raise OSError("too large")
        whole(sample)

    monkeypatch.setattr(bus, "publish_raw", publish_raw)
    shell = Shell(bus, CentralNode(CENTRE, ["r1"]), "robot/alpha", threading.Event())
    shell.publish(Outgoing(ch.SUBMAP, "alpha", submap(k)) for k in range(2))
    assert [s.key for s in sink.receive()] == ["robot/alpha/fault", "robot/alpha/submap"]


def test_an_interrupt_within_native_code_ends_the_run_and_is_no_fault():
    """A callback from native code turns it into a SystemError."""

    class Interrupted:
        def handle(self, message: m.Message) -> list[Outgoing]:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    boundary = Boundary("central")
    with pytest.raises(KeyboardInterrupt):
        boundary.hand(Interrupted(), submap(0))
    assert boundary.faults == 0
