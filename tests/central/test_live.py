import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from tests import build
from tests.teams import config, driven, of, published, stream

STREAMS = {name: stream(name, 9, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}


def head(robot, count, state="ended", incarnation=1):
    return m.StreamHead(
        stamp_ns=0, robot=robot, incarnation=incarnation, measurements=count, state=state
    )


def begun(robot, incarnation=1):
    return build.initial_pose(robot=robot, incarnation=incarnation)


ORDER = build.team_end(reason="it rains")


class Live:
    def __init__(self, *robots, admit=False):
        self.centre = CentralNode(CentralConfig(), robots, admit=admit)
        self.said = self.centre.begin()

    def tell(self, *messages):
        for message in messages:
            if self.centre.refusal(message) is None:
                self.said += self.centre.handle(message)
        return self

    def robot(self, name, *, state="ended"):
        measured = published(STREAMS[name])
        self.tell(build.liveliness(node=f"robot/{name}"))
        node = RobotNode(config(name))
        out = driven(node, measured, end=False)
        out += node.handle(head(name, len(measured), state))
        out += [] if state == "ended" else node.handle(ORDER)
        self.tell(measured[0], head(name, len(measured), state), *(o.message for o in out))
        return self

    @property
    def final(self):
        return self.centre.final


def test_a_driver_that_comes_back_is_waited_for_again():
    team = Live("r1", "r2").robot("r1").tell(begun("r1", 2)).robot("r2")
    assert team.final is None
    team.tell(head("r1", 1, "left", 2), ORDER)
    assert team.final is None  # the process has not confirmed this yet


def test_an_operator_ends_a_team_some_of_which_never_came():
    team = Live("r1", "r2", "r3").robot("r1").tell(ORDER)
    assert [o.channel for o in team.said if isinstance(o.message, m.TeamEnd)] == [ch.TEAM_END]
    assert team.final.lost == ()
    assert not team.final.provisional


@pytest.mark.parametrize(("state", "lost"), [("left", ()), ("open", ("r1",))])
def test_whose_driver_was_away_at_the_end_is_lost_unless_it_had_said_its_last_counter(state, lost):
    team = Live("r1").robot("r1", state=state)
    assert team.final is None
    team.tell(ORDER)
    assert team.final.lost == lost
    assert team.final.provisional == bool(lost)


def test_a_robot_that_nobody_has_named_is_admitted_only_where_the_scenario_says_so():
    closed = Live("r1").robot("r1")
    assert closed.final is not None
    refused = CentralNode(CentralConfig(), ["r1"])
    assert "not in this team" in refused.refusal(begun("r2"))
    absurd = Live("r1", admit=True).tell(begun("r2", 2**62))
    assert list(absurd.centre.robots) == ["r1"]
    team = Live("r1", admit=True).tell(begun("r2")).robot("r1")
    assert team.final is None
    assert team.centre.status().warnings == ("admitted, though not in the scenario: r2",)
    team.robot("r2")
    assert {member.robot for member in team.final.members} == {"r1", "r2"}


def test_the_map_of_a_live_team_is_that_of_the_same_streams_of_a_world():
    live = Live("r1", "r2").robot("r1").robot("r2")
    world = Live("r1", "r2")
    counts = {}
    for name, each in STREAMS.items():
        measured = published(each)
        counts[name] = len(measured)
        said = driven(RobotNode(config(name)), measured)
        world.tell(measured[0], *(o.message for o in said))
    world.tell(build.end(**counts))
    assert world.final.digest == live.final.digest
    assert world.final.means == live.final.means


def test_nothing_waits_for_a_robot_whose_driver_has_not_come_or_is_away():
    team = Live("r1", "r2", "r3").robot("r1", state="open")
    attendance = team.centre.attendance
    assert attendance.watermark_ns == attendance.robots["r1"].progress.stamp_ns
    team.tell(build.liveliness(node="source/r1", alive=False))
    assert attendance.watermark_ns == float("inf")


def robot_with(count):
    node = RobotNode(config("r1"))
    measured = published(STREAMS["r1"])
    node.handle(build.liveliness(node="source/r1"))
    for each in measured[:count]:
        node.handle(each)
    return node, measured


def test_a_robot_asks_for_what_its_driver_has_numbered_and_it_has_not():
    node, measured = robot_with(5)
    assert node.request() is None
    node.handle(head("r1", 12, "open"))
    assert (node.request().first, node.request().last) == (5, 11)
    node.handle(build.liveliness(node="source/r1", alive=False))
    assert node.request() is None
    assert "its driver is away after measurement 4" in node.status().warnings[0]
    assert len(measured) > 12


def test_a_robot_that_is_told_to_end_waits_for_its_driver_and_ends_without_one():
    node, measured = robot_with(5)
    assert of(node.handle(ORDER), ch.ROBOT_DONE) == []
    (done,) = of(node.handle(build.liveliness(node="source/r1", alive=False)), ch.ROBOT_DONE)
    assert done.measurements == 5
    node, measured = robot_with(len(STREAMS["r1"]))
    node.handle(ORDER)
    out = node.handle(head("r1", len(measured)))
    (done,) = of(out, ch.ROBOT_DONE)
    assert done.measurements == len(measured)
    assert of(out, ch.ROBOT_HEAD) == [head("r1", len(measured))]  # when its driver has gone
