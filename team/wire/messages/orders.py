"""What operators say: who is left out, what is one landmark, when a live team ends."""

from typing import Annotated

import msgspec
from msgspec import Meta

from team.wire.messages.base import Count, Message, Name, Text


class Withdrawal(Message, frozen=True, kw_only=True, tag="withdrawal/1"):
    """The team goes on without a robot: the map is that of the set without its submaps, and without
    the inter-robot measurements by it or of it. A member of the set like a submap: there is no way
    back.

    by: who ordered it, "operator" or "central". reason: in words.
    """

    robot: Name
    by: Text
    reason: Text


class WithdrawalHeard(Message, frozen=True, kw_only=True, tag="withdrawal_heard/1"):
    """In logs of earlier versions: a robot repeats an order to withdraw `withdrawn`.

    Now a centre that is started again reads the order from its own file, or from the router, which
    stores it as its operator published it. robot: the one that repeats it. by, reason: as in the
    order.
    """

    robot: Name
    withdrawn: Name
    by: Text
    reason: Text


class LocalLandmark(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """An unnamed landmark of submap (robot, incarnation, sequence): its number is 2³¹ + `local`."""

    robot: Name
    incarnation: Count
    sequence: Count
    local: Annotated[int, Meta(ge=0, lt=2**31)]


class Judgement(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """That two local landmarks are one landmark, or are two."""

    first: LocalLandmark
    second: LocalLandmark
    same: bool


class Verdict(Message, frozen=True, kw_only=True, tag="verdict/1"):
    """An operator says of two local landmarks that they are one, or two. A member of the set like a
    submap; of a pair of which both were said they are two.

    robot: that of the first landmark. by: who says so. reason: in words. withdrawn: this very
    judgement holds no more, whenever it was said, and for good.
    """

    robot: Name
    judgement: Judgement
    by: Text
    reason: Text
    withdrawn: bool = False

    def check(self) -> None:  # noqa: D102
        if self.judgement.first == self.judgement.second:
            raise ValueError("out of bounds: a verdict on one landmark and itself")
        if self.robot != self.judgement.first.robot:
            raise ValueError("out of bounds: a verdict in the name of another robot")


class GivenUp(Message, frozen=True, kw_only=True, tag="given_up/1"):
    """Nobody waits for a node any more: what has come of a robot is in the map, what has not is
    missing, and the final map names it as lost.

    by: "operator", "launch" or "central". reason: in words.
    """

    node: Text
    by: Text
    reason: Text


class TeamEnd(Message, frozen=True, kw_only=True, tag="team_end/1"):
    """An operator's order to a live team: whoever measures ends now.

    by: who ordered it. reason: in words.
    """

    by: Text
    reason: Text
