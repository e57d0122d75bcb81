"""Hands many odometry intervals to a robot's node: at once where they only move the robot."""

from collections.abc import Callable

from team.robot.node import RobotNode
from team.stream.odometry_block import OdometryBlock
from team.wire import messages as m
from team.wire.bus import Outgoing


def driven(
    node: RobotNode, block: OdometryBlock, give: Callable[[m.Odometry], list[Outgoing]]
) -> list[Outgoing]:
    """The node's answers to a block, equal to those to its messages one by one.

    give: hands one message to the node, as its shell does.
    """
    out: list[Outgoing] = []
    at = 0
    while at < block.size:
        count, answer = node.drive_on(block.part(at, block.size))
        out += answer
        at += count
        if at < block.size:  # the next one leads to more
            out += give(block.message(at))
            at += 1
    return out
