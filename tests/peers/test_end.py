"""When a peer that comes back alone may leave: every other robot has announced its own end."""

import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.peers.robot import PeerRobot
from teamslam.team.config import RobotConfig
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import encoded
from tests import build
from tests.peers.teams import member

ROBOTS = ("r1", "r2", "r3")
ORDERS = {
    "given up": (ch.GIVEN_UP, build.given_up(node="robot/r3", reason="lost")),
    "withdrawn": (ch.ORDER, build.withdrawal(robot="r3", reason="broken")),
}


def ended(robot: str) -> Sample:
    concluded = build.concluded(robot=robot, serial=1)
    return Sample(ch.CONCLUDED.key(robot), encoded(concluded), 0, 0, 0)


@pytest.fixture
def peer() -> PeerRobot:
    return PeerRobot(RobotConfig("r2"), CentralConfig(), ROBOTS)


def test_the_end_of_one_robot_is_not_the_end_of_the_team(peer: PeerRobot) -> None:
    assert not peer.is_left_alone
    peer.take_end([ended("r1")])
    assert not peer.is_left_alone
    peer.take_end([ended("r3")])
    assert peer.is_left_alone
    assert not peer.peer.replica.concluded, "the set grows by what peers send"


def test_an_end_in_another_robots_name_and_garbage_are_nobodys(peer: PeerRobot) -> None:
    forged = Sample(ch.CONCLUDED.key("r3"), ended("r1").payload, 0, 0, 0)
    peer.take_end([ended("r1"), forged, Sample(forged.key, b"garbage", 0, 0, 0)])
    assert not peer.is_left_alone


def test_nobody_is_left_alone_while_another_is_there(peer: PeerRobot) -> None:
    peer.take_end([ended("r1"), ended("r3")])
    peer.handle(build.liveliness(node="robot/r3"), 0)
    assert not peer.is_left_alone


@pytest.mark.parametrize("order", ORDERS)
def test_whom_an_operator_has_given_up_or_withdrawn_is_not_waited_for(
    peer: PeerRobot, order: str
) -> None:
    peer.take_end([ended("r1")])
    peer.keep([member(*ORDERS[order])])
    assert peer.is_left_alone
