"""An operator's verdict on two unnamed landmarks of a running team: one landmark, or two."""

import re
import time

from central.desk.orders import LOOK_S, PEERS, WithdrawError, await_fold, ordered
from team.keys.roster import ROBOT
from team.peers.proofs import Signs
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Bus, Outgoing, sound

_NAME = re.compile(rf"({ROBOT.pattern})/(\d+)/(\d+)/(\d+)")


def local_landmark(text: str) -> m.LocalLandmark:
    """`r1/1/12/7`: robot, incarnation, sequence of the submap, local landmark; ValueError."""
    found = _NAME.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r} is no local landmark: robot/incarnation/submap/landmark")
    robot, *numbers = found.groups()
    incarnation, sequence, local = (int(each) for each in numbers)
    return m.LocalLandmark(robot=robot, incarnation=incarnation, sequence=sequence, local=local)


def judge(
    bus: Bus,
    judgement: m.Judgement,
    reason: str,
    patience_s: float,
    signer: Signs | None = None,
    *,
    withdrawn: bool = False,
) -> m.FusedMap:
    """Publish the verdict and wait for the first map that takes it into account, a centre's or a
    peer's.

    withdrawn: withdraw the verdict, and wait for a map without it. signer: the operator's, where
    there are keys. Raises WithdrawError where there is neither, or no such map within the time.
    """
    for channel in (ch.FUSED_MAP, ch.FINAL_MAP, *PEERS):
        bus.subscribe(channel)
    bus.watch_alive()
    await_fold(bus)
    robot = judgement.first.robot
    verdict = m.Verdict(
        stamp_ns=0,
        robot=robot,
        judgement=judgement,
        by="operator",
        reason=reason,
        withdrawn=withdrawn,
    )
    ordered(bus, Outgoing(ch.VERDICT, robot, verdict), signer)
    pair = {judgement.first, judgement.second}
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        for _, _, message in sound(bus.receive(LOOK_S)):
            if not isinstance(message, m.FusedMap):
                continue
            holds = any(
                {each.first, each.second} == pair and each.same == judgement.same
                for each in message.verdicts
            )
            if holds is not withdrawn:
                return message
            if message.final:
                raise WithdrawError("the final map was out before the verdict; run the log again")
    what = "its withdrawal" if withdrawn else "the verdict"
    raise WithdrawError(f"no map that rests on it within {patience_s:g} s; {what} stands")
