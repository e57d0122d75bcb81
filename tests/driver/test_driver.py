import re
import threading
import warnings
from decimal import Decimal
from itertools import count

import numpy as np
import pytest

from teamslam import Driver, DriverError, DriverWarning, MeasurementError
from teamslam.team.saved_map import write_map
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import Outgoing, opened
from teamslam.team.wire.codec import decoded, encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.commands import run
from tests.support import ROOT, example, wait_until

S = 10**9


@pytest.fixture
def alone(tmp_path):
    robots = []

    def make(**options):
        options = {"file": tmp_path / "r1.stream", "latency_s": 0.0} | options
        robot = Driver("r1", team="lab", connect="tcp/127.0.0.1:1", patience_s=0.0, **options)
        robots.append(robot)
        return robot

    yield make
    for robot in robots:
        robot.close()


def killed(driver):
    """As by the kernel: its file has no last record."""
    driver._link._leaving.set()
    driver._link._thread.join()
    driver._journal.close()


def messages(robot):
    journal = robot._journal
    with robot._lock:
        journal.mark("open")
    return [
        journal.message(incarnation, number)
        for incarnation in journal.incarnations
        for number in range(journal.count(incarnation))
    ]


def test_speeds_and_what_is_seen_become_the_messages_of_the_wire(alone):
    robot = alone(start=(1.0, 2.0, 0.5))
    robot.odometry(Decimal("1700000000.123456789"), 0.0, 0.0)
    robot.observe(Decimal("1700000000.2"), [4, 7], [2.0, 3.0], [0.5, 4.0])
    robot.odometry(Decimal("1700000000.223456789"), 0.5, 0.1)
    start, seen, driven = messages(robot)
    assert start.stamp_ns == 1_700_000_000_123_456_789
    assert floats(start.pose, "pose").tolist() == [1.0, 2.0, 0.5]
    assert ids(seen.ids, "ids").tolist() == [4, 7]
    assert floats(seen.bearings, "bearings") == pytest.approx([0.5, 4.0 - 2 * np.pi])
    assert (driven.duration_ns, driven.forward, driven.yaw_rate) == (100_000_000, 0.5, 0.1)
    assert [each.number for each in (start, seen, driven)] == [0, 1, 2]


def test_a_saved_map_is_published_for_the_teams_set(alone, tmp_path):
    saved, site = example(m.SavedMap), tmp_path / "site.map"
    write_map(site, saved)
    robot = alone(map=site)
    assert robot._node.begin() == [Outgoing(ch.SAVED_MAP, saved.author, saved)]
    robot.odometry(1.0, 0.0, 0.0)
    messages(robot)
    with pytest.raises(DriverError, match="central --map"):
        alone(map=site, keys=tmp_path)
    with pytest.raises(DriverError, match="no saved map"):
        alone(map=tmp_path / "r1.stream")


REFUSED = [
    (lambda r: r.odometry(9.0, 0.1, 0.0), "time goes back by 1.000 s"),
    (lambda r: r.odometry(10.1, float("nan"), 0.0), r"forward of odometry.* is nan"),
    (lambda r: r.odometry(10.1, 500.0, 0.0), "500 m/s, 300 at most"),
    (lambda r: r.odometry(10.1, 0.1, 180.0), "180 degrees are 3.14"),
    (lambda r: r.odometry(10.5, 0.1, 0.0, duration=0.9), "before the last interval has ended"),
    (lambda r: r.odometry(10.1, 0.5, -20.0), "is 3.2 turns a second: .* degrees are -0.349"),
    (lambda r: r.odometry(1.7e18, 0.1, 0.0), "divide nanoseconds by 1e9"),
    (lambda r: r.observe(10.1, [1.5], [1.0], [0.0]), "ids are whole numbers"),
    (lambda r: r.observe(10.1, [-1], [1.0], [0.0]), "the id -1 is not in"),
    (lambda r: r.observe(10.1, [1, 2], [1.0], [0.0, 0.0]), "1 ranges of 2 seen"),
    (lambda r: r.observe(10.1, [1], [-1.0], [0.0]), "a range of -1 m"),
    (lambda r: r.observe(10.1, [1], [1.0], [90.0]), "bearings are in radians"),
    (lambda r: r.observe(10.1, [1], [float("inf")], [0.0]), "ranges have inf"),
    (lambda r: r.observe(1.7e9, [1], [1.0], [0.0]), "both need one clock"),
    (lambda r: r.observe(9.5, [1], [1.0], [0.0]), "give a latency_s above 0.50"),
    (lambda r: r.observe(-99.0, [1], [1.0], [0.0]), "have been published: all that a robot"),
    (lambda r: r.odometry(1.7e9, 0.1, 0.0), "another clock. Use one clock for all times"),
    (lambda r: r.observe(10.1, [1], [1.0], [0.0], [[[1.0, 2.0], [2.0, 1.0]]]), "leave covariances"),
    (lambda r: r.observe_points(10.1, [1], [[1.0, 0.0]], [[[1.0, 0.0], [0.5, 1.0]]]), "symmetric"),
    (lambda r: r.sight(10.1, ["r1"], [1.0], [0.0]), "can not see itself"),
    (lambda r: r.sight(10.1, ["R 2"], [1.0], [0.0]), "is no robot's name"),
    (lambda r: r.fix(10.1, 1.0, float("nan")), "fix at 10.100 s"),
    (lambda r: r.fix(10.1, 1.0, 2.0, [1.0, 1.0]), "fix at 10.100 s: its covariance is not 2 × 2"),
    (lambda r: r.fix(10.1, 1.0, 2.0, [[1.0, 2.0], [2.0, 1.0]]), "symmetric and positive definite"),
    (lambda r: r.odometry_pose(9.5, 0.0, 0.0, 0.0), "time goes back"),
]


def test_what_can_not_be_is_refused_at_once_by_name_and_nothing_of_it_is_kept(alone):
    robot = alone()
    robot.odometry(9.9, 0.0, 0.0)
    robot.odometry(10.0, 0.1, 0.0)
    before = len(robot._journal.calls)
    for call, words in REFUSED:
        with pytest.raises(MeasurementError, match=words):
            call(robot)
        assert len(robot._journal.calls) == before
    robot.odometry(10.1, 0.1, 0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start": (0.0, 0.0, 90.0)}, "theta is 90; it is in radians"),
        ({"start": (0.0, 0.0)}, "a pose is"),
        ({"start": (0.0, 0.0, 0.0), "start_covariance": -np.eye(3)}, "the start of r1: a covar"),
    ],
)
def test_a_start_that_can_not_be_is_refused(alone, options, words):
    with pytest.raises(MeasurementError, match=words):
        alone(**options)


def test_what_is_hardly_meant_is_warned_of_once(alone):
    robot = alone(landmarks=[1, 2])
    with pytest.warns(DriverWarning, match="saw landmark 9, which is not in `landmarks`"):
        robot.observe(1.0, [9], [1.0], [0.0])
    with pytest.warns(DriverWarning, match="ids are not ascending"):
        robot.observe(1.1, [2, 1], [1.0, 1.0], [0.0, 0.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot.observe(1.2, [9], [1.0], [0.0])
        robot.observe(1.3, [2, 1], [1.0, 1.0], [0.0, 0.0])


def test_behind_a_gap_in_the_odometry_the_stream_begins_anew_at_an_unknown_pose(alone):
    robot = alone(start=(0.0, 0.0, 0.0))
    robot.odometry(1.0, 0.0, 0.0)
    robot.odometry(1.1, 0.5, 0.0)
    with pytest.warns(DriverWarning, match=r"no odometry from 1\.100 to 8\.900 s: its stream"):
        robot.odometry(9.0, 0.5, 0.0, duration=0.1)
    robot.odometry(9.1, 0.5, 0.0)
    found = messages(robot)
    starts = [each for each in found if isinstance(each, m.InitialPose)]
    assert [(s.incarnation, s.stamp_ns, bool(s.pose)) for s in starts] == [
        (1, 1_000_000_000, True),
        (2, 8_900_000_000, False),
    ]
    assert [each.incarnation for each in found] == [1, 1, 2, 2, 2]


def test_a_short_gap_is_bridged_by_a_motion_of_which_little_is_known(alone):
    robot = alone()
    robot.odometry(1.0, 0.0, 0.0)
    robot.odometry(1.1, 0.5, 0.0)
    with pytest.warns(DriverWarning, match=r"no odometry from 1\.100 to 1\.700 s: the robot is"):
        robot.odometry(1.8, 0.5, 0.0, duration=0.1)
    _, first, bridge, last = messages(robot)
    assert isinstance(bridge, m.Increment)
    assert (bridge.stamp_ns, bridge.duration_ns) == (1_700_000_000, 600_000_000)
    assert floats(bridge.increment, "increment").tolist() == pytest.approx([0.3, 0.0, 0.0])
    assert floats(bridge.covariance, "covariance").reshape(3, 3).diagonal() == pytest.approx(
        [0.36, 0.36, 0.09]
    )
    assert (first.incarnation, last.incarnation) == (1, 1)
    with pytest.warns(DriverWarning, match=r"no odometry from 1\.800 to 4\.800 s: the robot is"):
        robot.odometry(4.8, 0.5, 0.0)  # longer than one call covers, without a new stream
    *_, again = messages(robot)
    assert (again.incarnation, again.stamp_ns, again.duration_ns) == (1, 4 * S + 800_000_000, 3 * S)


@pytest.mark.parametrize("back", [(0.0, 0.0, 0.0), (70.0, 0.0, 1.0)])
def test_poses_that_begin_anew_are_no_motion_and_the_one_before_goes_on(alone, back):
    robot = alone()
    for k in range(20):
        robot.odometry_pose(Decimal(k) / 10, 0.05 * k, 0.0, 0.0)
    with pytest.warns(DriverWarning, match=r"odometry's pose jumps by \S+ m at 2\.000 s: a reset"):
        robot.odometry_pose(2.0, *back)
    robot.odometry_pose(2.1, back[0], back[1], back[2] + 0.01)
    *_, before, at, after = messages(robot)
    steps = [floats(each.increment, "increment").tolist() for each in (before, at, after)]
    assert steps[0] == pytest.approx(steps[1])
    assert steps[2] == pytest.approx([0.0, 0.0, 0.01])


def drive(robot, ticks, *, poses=False):
    for k in ticks:
        t = Decimal(k) / 10
        if poses:
            robot.odometry_pose(t, 0.05 * k, 0.01 * k, 0.02 * k)
        else:
            robot.odometry(t, 0.5, 0.1)
        if k % 3 == 0:
            robot.observe(t, [k], [1.0], [0.0])


@pytest.mark.parametrize("poses", [False, True])
@pytest.mark.parametrize("died_at", [1, 2, 6, 11])
def test_a_program_that_is_killed_may_hand_over_all_once_more(tmp_path, alone, poses, died_at):
    whole = alone(file=tmp_path / "whole.stream", latency_s=0.2)
    drive(whole, range(12), poses=poses)
    dead = alone(latency_s=0.2)
    drive(dead, range(died_at), poses=poses)
    dead._link.close()
    dead._journal.close()  # as the kernel does: the file has no last record
    dead._closed = True
    again = alone(latency_s=0.2)
    drive(again, range(12), poses=poses)
    assert [encoded(each) for each in messages(again)] == [encoded(e) for e in messages(whole)]


def test_what_differs_from_the_file_is_time_that_goes_back(alone):
    robot = alone()
    drive(robot, range(5))
    robot.close()
    again = alone()
    again.odometry(Decimal(0), 0.5, 0.1)
    with pytest.raises(MeasurementError, match=r"time goes back.*go on behind `last_time`"):
        again.odometry(Decimal("0.1"), 0.7, 0.1)
    assert again.last_time == pytest.approx(0.4)


def test_a_difference_of_poses_covers_the_time_in_which_a_driver_was_away(alone):
    robot = alone()
    drive(robot, range(3), poses=True)
    robot.close()
    again = alone()
    again.odometry_pose(4.2, 2.1, 0.0, 0.0)
    *_, last = messages(again)
    assert isinstance(last, m.Increment)
    assert last.duration_ns == 4_000_000_000
    ahead, left, turn = floats(last.increment, "increment")
    assert (ahead, left, turn) == pytest.approx((1.998, -0.1, -0.04), abs=2e-3)


class Listener:
    def __init__(self, endpoint):
        self.bus = ZenohBus("lab", endpoint)
        for channel in ch.SENSORS:
            self.bus.subscribe(channel, "r1")
        self.bus.subscribe(ch.HEAD, "r1")
        self.bus.declare_alive("robot/r1")
        self.got, self.heads = {}, []

    def take(self, payload):
        message = decoded(payload)
        self.got[message.incarnation, message.number] = message

    def look(self):
        for sample in self.bus.receive(0.02):
            _, _, message = opened(sample)
            if isinstance(message, m.StreamHead):
                self.heads.append(message)
            else:
                self.got[message.incarnation, message.number] = message

    def ask(self, first, last=-1):
        wanted = build.measurements_request(first=first, last=last)
        for reply in self.bus.ask(ch.MEASUREMENTS, "r1", wanted, 30.0):
            self.take(reply)

    def say(self):
        numbers = {n for i, n in self.got if i == 1}
        whole = next(n for n in count() if n not in numbers)
        progress = build.progress(measurements=whole)
        self.bus.publish(Outgoing(ch.ROBOT_PROGRESS, "r1", progress))
        done = build.done(measurements=whole)
        if self.heads and self.heads[-1].state == "ended":
            self.bus.publish(Outgoing(ch.ROBOT_DONE, "r1", done))


def test_a_robot_gets_all_from_a_driver_that_was_killed_and_the_driver_waits_for_that(tmp_path):
    file = tmp_path / "r1.stream"
    with router() as endpoint:
        first = Driver("r1", team="lab", connect=endpoint, file=file)
        drive(first, range(20))
        wait_until(lambda: first._node.status().figures["published"] > 15)
        killed(first)
        robot = Listener(endpoint)
        again = Driver("r1", team="lab", connect=endpoint, file=file)
        drive(again, range(30))
        assert again.end(patience_s=0.05) is False  # not delivered yet
        assert again._closed
        wait_until(lambda: robot.look() or any(h.state == "ended" for h in robot.heads))
        last = Driver("r1", team="lab", connect=endpoint, file=file)  # it delivers

        def delivered():
            robot.ask(0)
            robot.say()
            return last.end(patience_s=0.3) if len(robot.got) == 40 else False

        wait_until(delivered)
        assert sorted(robot.got) == [(1, n) for n in range(40)]
        robot.bus.close()


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"team": "bench"}, "is of team bench, and this driver of team lab"),
        (
            {"start": (5.0, 5.0, 1.0)},
            r"begins with start \(5, 5, 1\), and this driver with start \(0, -3, 0\)",
        ),
        ({"start": None}, r"begins with no start, and this driver with start \(0, -3, 0\)"),
    ],
)
def test_a_stream_of_another_team_or_start_is_not_delivered_to_this_one(tmp_path, changed, why):
    own = {"team": "lab", "start": (0.0, -3.0, 0.0)}
    common = {"file": tmp_path / "r1.stream", "connect": "tcp/127.0.0.1:1"}
    common |= {"patience_s": 0.0, "latency_s": 0.0}
    bench = Driver("r1", **(common | own | changed))
    drive(bench, range(20))
    bench.close()
    with pytest.warns(DriverWarning, match=f"{why}: it is now .*r1.stream.1"):
        robot = Driver("r1", **common, **own)
    assert robot.last_time is None
    drive(robot, range(3))
    begun = messages(robot)
    assert begun[0].incarnation == 2
    assert floats(begun[0].pose, "pose").tolist() == [0.0, -3.0, 0.0]
    robot.close()
    assert robot.path.with_name("r1.stream.1").exists()


@pytest.mark.parametrize("second", ["first", "second"])
def test_a_stream_that_an_earlier_run_received_is_not_delivered_to_the_next(tmp_path, second):
    options = {"team": "lab", "file": tmp_path / "r1.stream", "start": (0.0, 0.0, 0.0)}
    with router() as endpoint, ZenohBus("lab", endpoint) as bus:
        bus.declare_alive("recorder")

        def records(run):
            status = build.status(node="recorder", state="recording", run=run)
            bus.publish(Outgoing(ch.STATUS, "recorder", status))

        records("first")
        dead = Driver("r1", connect=endpoint, **options)
        drive(dead, range(20))
        wait_until(lambda: dead._journal.run == "first")
        count = len(dead._journal.calls)
        killed(dead)
        records(second)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            robot = Driver("r1", connect=endpoint, **options)
        told = [str(each.message) for each in caught if each.category is DriverWarning]
        if second == "first":  # the driver alone was killed
            assert not told
            assert len(robot._journal.calls) == count
        else:
            (said,) = told
            assert "is of an earlier run of team lab: it is now" in said
            assert robot.last_time is None
            drive(robot, range(5))
            assert messages(robot)[0].incarnation == 2
            wait_until(lambda: robot._journal.run == "second")
        assert robot.path.with_name("r1.stream.1").exists() == (second == "second")
        robot.close()


def test_a_stream_that_is_continued_where_no_team_is_begins_again_in_a_later_run(tmp_path):
    options = {"team": "lab", "file": tmp_path / "r1.stream", "start": (1.0, 0.0, 0.0)}
    first = Driver("r1", connect="tcp/127.0.0.1:1", patience_s=0.0, **options)
    drive(first, range(5))
    first._journal.mark_run("first")
    first.close()
    with router() as endpoint:
        robot = Driver("r1", connect="tcp/127.0.0.1:1", **options)
        drive(robot, range(5, 8))
        earlier = robot._journal
        robot._link._connect = endpoint  # the run begins where the driver is
        with ZenohBus("lab", endpoint) as bus:
            bus.declare_alive("recorder")
            status = build.status(node="recorder", state="recording", run="second")
            bus.publish(Outgoing(ch.STATUS, "recorder", status))
            wait_until(lambda: robot._journal is not earlier)
            with pytest.warns(DriverWarning, match="of an earlier run of team lab.* unknown pose"):
                drive(robot, range(8, 12))
            wait_until(lambda: robot._journal.run == "second")
            start, *rest = messages(robot)
            assert (start.incarnation, start.pose) == (2, b""), "it has moved since its start"
            assert {each.incarnation for each in rest} == {2}
            assert robot.path.with_name("r1.stream.1").exists()
            robot.close()
            again = Driver("r1", connect=endpoint, **options)
            drive(again, range(12, 14))
            assert {each.incarnation for each in messages(again)} == {2}, "the same stream"
            again.close()


def test_without_a_centre_the_robots_own_final_map_is_the_end(tmp_path):
    driver = Driver("r1", team="lab", file=tmp_path / "r1.stream", patience_s=0.0)
    drive(driver, range(5))
    node = driver._node
    assert node.waits_for == "robot/r1 and central"
    count = driver._journal.count(1)
    node.handle(build.done(measurements=count, submaps=2))  # fmt: skip
    assert not node.is_delivered, "its submaps are in no map yet"
    node.handle(build.concluded(robot="r2", serial=1, submaps=2))
    assert not node.is_delivered
    node.handle(build.concluded(serial=1, submaps=2))
    assert node.is_delivered
    node.handle(build.set_summary(node="robot/r1", serial=1))
    assert node.waits_for == "robot/r1"
    driver.close()


def test_it_answers_for_what_was_missed_and_ends_when_the_robot_has_it(tmp_path):
    with router() as endpoint:
        driver = Driver("r1", team="lab", connect=endpoint, file=tmp_path / "r1.stream")
        drive(driver, range(30))
        wait_until(lambda: driver._node.status().figures["published"] > 20)
        robot = Listener(endpoint)  # too late for the published measurements
        wait_until(lambda: robot.look() or robot.heads)
        robot.ask(0)
        robot.say()
        drive(driver, range(30, 40))

        def complete():
            robot.look()
            robot.say()  # `Done`, once it has everything and the end
            whole = len(robot.got) == driver._journal.count(1)
            return whole and robot.heads[-1].state == "ended"

        with driver._lock:
            driver._journal.mark("ended")
        wait_until(complete)
        assert driver.end(patience_s=60.0)  # enough for a busy machine
        assert {n for _, n in robot.got} == set(range(1 + 39 + 14))
        with pytest.raises(DriverError, match="is closed"):
            driver.odometry(9.0, 0.0, 0.0)
        robot.bus.close()


def test_a_router_that_is_not_there_is_named_and_a_driver_that_goes_on_does_not_wait_for_it(
    tmp_path, caplog
):
    options = {"team": "lab", "connect": "tcp/127.0.0.1:1", "file": tmp_path / "a"}
    said = r"no router answers at tcp/127\.0\.0\.1:1.*; start `teamslam launch .* run ended\?"
    with pytest.raises(DriverError, match=said):
        Driver("r1", **options, patience_s=0.5)
    first = Driver("r1", **options, patience_s=0.0)
    first.odometry(1.0, 0.0, 0.0)
    first.close()
    again = Driver("r1", **options)  # killed and restarted without a network
    again.odometry(1.1, 0.5, 0.0)
    wait_until(lambda: caplog.text.count("no router answers at tcp/127.0.0.1:1") == 2)
    again.close()
    assert again.last_time == 1.1


def test_a_driver_of_a_team_that_is_not_there_names_those_that_are(tmp_path, caplog):
    with router() as endpoint:
        there = Driver("r1", team="lab", connect=endpoint, file=tmp_path / "a")
        mistaken = Driver("r2", team="lap", connect=endpoint, file=tmp_path / "b")
        said = f"r2: no process of team lap is at {endpoint}, but of lab: is the team's name right?"
        wait_until(lambda: said in caplog.text)
        status = run("status", "--team", "lap2", "--connect", endpoint, "--seconds", "0.5")
        assert f"no node of the team lap2 is at {endpoint}, but of lab, lap:" in status.output
        mistaken.close()
        there.close()
    assert "r1: nobody" not in caplog.text


PAGE = (ROOT / "docs" / "your_robot.md").read_text()


def test_the_pages_ten_lines_bring_a_robot_onto_its_team(tmp_path, monkeypatch):
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    with router() as endpoint:
        robot = Listener(endpoint)
        text = program.replace("tcp/127.0.0.1:7447", endpoint)
        thread = threading.Thread(target=lambda: exec(text, {}))
        thread.start()

        def done():
            robot.look()
            if robot.got:
                robot.say()
            return not thread.is_alive()

        wait_until(done)
        robot.bus.close()
    kinds = [type(robot.got[1, n]).__name__ for n in range(len(robot.got))]
    assert kinds == ["InitialPose", "Observations", "Odometry"]
    assert robot.heads[-1].state == "ended"


def test_a_fix_becomes_a_message_with_its_position_and_its_covariance_if_stated(alone):
    robot = alone()
    robot.odometry(10.0, 0.0, 0.0)
    robot.fix(10.5, 399_000.25, 5_756_000.5)
    robot.fix(10.75, 1.0, 2.0, [[0.25, 0.125], [0.125, 0.5]])
    robot.odometry(11.0, 0.1, 0.0)
    first, second = [each for each in messages(robot) if isinstance(each, m.Fix)]
    assert (first.stamp_ns, second.stamp_ns) == (10_500_000_000, 10_750_000_000)
    assert floats(first.position, "position").tolist() == [399_000.25, 5_756_000.5]
    assert first.covariance == b""
    assert floats(second.covariance, "covariance").tolist() == [0.25, 0.125, 0.5]
