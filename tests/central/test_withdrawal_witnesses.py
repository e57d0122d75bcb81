"""Withdrawals that robots repeat: a restarted centre believes a majority, never one teammate."""

import pytest

from central.config import CentralConfig
from central.node import CentralNode
from team.wire import channels as ch
from team.wire import messages as m

TEAM = ("r1", "r2", "r3", "r4")


def heard(robot: str, withdrawn: str = "r2") -> m.WithdrawalHeard:
    return m.WithdrawalHeard(
        stamp_ns=7, robot=robot, withdrawn=withdrawn, by="operator", reason="a flat wheel"
    )


def centre(robots: tuple[str, ...] = TEAM) -> CentralNode:
    return CentralNode(CentralConfig(), robots)


def withdrawn(node: CentralNode, *messages: m.Message) -> list[str]:
    out = [o for message in messages for o in node.handle(message, 0)]
    return [o.name for o in out if o.channel is ch.WITHDRAWAL]


def test_what_more_than_half_of_the_others_heard_is_followed_once_and_told_on() -> None:
    node = centre()
    assert withdrawn(node, heard("r1")) == []
    assert withdrawn(node, heard("r1")) == [], "the same robot twice is one witness"
    (told,) = node.handle(heard("r3"), 0)
    assert told.key == "central/withdrawal/r2"
    assert told.message == m.Withdrawal(
        stamp_ns=7, robot="r2", by="operator", reason="a flat wheel"
    )
    assert withdrawn(node, heard("r4")) == []
    assert node.warnings == ["r2 withdrawn by operator: a flat wheel"]


@pytest.mark.parametrize("robots", [("r1", "r2"), ("r1", "r2", "r3"), TEAM])
def test_one_robot_alone_withdraws_no_teammate_and_the_remedy_is_named(
    robots: tuple[str, ...],
) -> None:
    node = centre(robots)
    assert withdrawn(node, heard("r1"), heard("stranger"), heard("intruder")) == []
    (warning,) = node.status().warnings
    assert warning == (
        "r1 report that r2 is withdrawn, too few to be believed: if it is, order it again by "
        "`teamslam withdraw r2`"
    )
    assert withdrawn(
        node, m.Withdrawal(stamp_ns=8, robot="r2", by="operator", reason="a flat wheel")
    ) == ["r2"]
    assert "too few" not in " ".join(node.status().warnings)


def test_half_of_the_others_are_not_enough() -> None:
    node = centre(("r1", "r2", "r3", "r4", "r5"))
    assert withdrawn(node, heard("r1"), heard("r3")) == []
    assert withdrawn(node, heard("r4")) == ["r2"]


def test_a_robot_is_believed_about_itself() -> None:
    assert withdrawn(centre(("r1", "r2")), heard("r2")) == ["r2"]


def test_an_operators_order_is_told_on_so_that_who_joins_later_hears_of_it() -> None:
    node = centre()
    order = m.Withdrawal(stamp_ns=3, robot="r2", by="operator", reason="a flat wheel")
    assert withdrawn(node, order, order) == ["r2"]
