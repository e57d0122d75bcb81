"""An operator's verdict on two unnamed landmarks of a running team: one landmark, or two."""

import re
import time

from central.desk.evaluation.verdicts import pair_of
from central.desk.orders import LOOK_S, PEERS, WithdrawError, await_team, ordered
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
    there are keys. Raises NoRobotError where the team does not have one of the robots,
    WithdrawError where there is neither centre nor peer, or no such map within the time.
    """
    for channel in (ch.ROBOT_CONFIG, ch.FUSED_MAP, ch.FINAL_MAP, *PEERS):
        bus.subscribe(channel)
    bus.watch_alive()
    robot, known = judgement.first.robot, set[str]()
    for each in (robot, judgement.second.robot):
        await_team(bus, each, known)
    verdict = m.Verdict(
        stamp_ns=0,
        robot=robot,
        judgement=judgement,
        by="operator",
        reason=reason,
        withdrawn=withdrawn,
    )
    ordered(bus, Outgoing(ch.VERDICT, robot, verdict), signer)
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        for _, _, message in sound(bus.receive(LOOK_S)):
            if not isinstance(message, m.FusedMap):
                continue
            holds = any(
                pair_of(each) == pair_of(judgement) and each.same == judgement.same
                for each in message.verdicts
            )
            if holds is not withdrawn:
                return message
            if message.final:
                raise WithdrawError("the final map was out before the verdict; run the log again")
    if withdrawn:
        raise WithdrawError(
            f"no map without it within {patience_s:g} s; its withdrawal is recorded, and stands"
        )
    raise WithdrawError(
        f"no map rests on it within {patience_s:g} s; the verdict is recorded, and holds once a "
        "map has both landmarks: if none ever does, a submap or a landmark is not as named"
    )
