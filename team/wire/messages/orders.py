"""Operators' orders: withdrawals, verdicts, nodes that are given up, the end of a team."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.team.wire.messages.base import Author, Count, Message, Name, Text


class Withdrawal(Message, frozen=True, kw_only=True, tag="withdrawal/1"):
    """Withdrawal of a robot or of a saved map, for good; a member of the set.

    The map is that of the set without the robot's submaps and inter-robot factors. by: "operator"
    or "central".
    """

    robot: Author
    by: Text
    reason: Text


class WithdrawalHeard(Message, frozen=True, kw_only=True, tag="withdrawal_heard/1"):
    """An order to withdraw `withdrawn` that `robot` repeated, in logs of earlier versions.

    No node publishes or receives it.
    """

    robot: Name
    withdrawn: Name
    by: Text
    reason: Text


class LocalLandmark(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """An unnamed landmark of submap (robot, incarnation, sequence): its number is 2³¹ + `local`."""

    robot: Author
    incarnation: Count
    sequence: Count
    local: Annotated[int, Meta(ge=0, lt=2**31)]


class Judgement(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Statement that two local landmarks are one, or two."""

    first: LocalLandmark
    second: LocalLandmark
    same: bool


class Verdict(Message, frozen=True, kw_only=True, tag="verdict/1"):
    """An operator's statement that two local landmarks are one, or two; a member of the set.

    Of contradicting verdicts "two" holds. robot: that of the first landmark. withdrawn: this
    judgement is taken back, for good.
    """

    robot: Author
    judgement: Judgement
    by: Text
    reason: Text
    withdrawn: bool = False

    def check(self) -> None:
        if self.judgement.first == self.judgement.second:
            raise ValueError("out of bounds: a verdict on one landmark and itself")
        if self.robot != self.judgement.first.robot:
            raise ValueError("out of bounds: a verdict in the name of another robot")


class GivenUp(Message, frozen=True, kw_only=True, tag="given_up/1"):
    """Order that no process waits for a node.

    The final map names a robot with missing data as lost. by: "operator", "launch" or "central".
    """

    node: Text
    by: Text
    reason: Text


class TeamEnd(Message, frozen=True, kw_only=True, tag="team_end/1"):
    """Order that ends all streams of a live team."""

    by: Text
    reason: Text
