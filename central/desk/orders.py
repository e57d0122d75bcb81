"""Operator orders to a running team."""

import re
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from teamslam.central.desk.evaluation.states import holds
from teamslam.central.desk.names import in_order
from teamslam.team.keys.roster import ROBOT
from teamslam.team.peers.members import Member, about
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, Outgoing, open_valid
from teamslam.team.wire.codec import encoded

if TYPE_CHECKING:
    from teamslam.team.keys.signing import Signer

CENTRE_S = 10.0  # time [s] within which a running centre or robot is detected
LOOK_S = 0.05
PEERS = (ch.TEAM_CONFIG, ch.TEAM_MAP, ch.TEAM_FINAL)
_LANDMARK = re.compile(rf"({ROBOT.pattern})/(\d+)/(\d+)/(\d+)")


class WithdrawError(RuntimeError):
    """The order was not given or not followed."""


class NoRobotError(WithdrawError):
    """The team has no such robot."""


class _RunningTeam:
    """Robots of a running team, and its folding nodes."""

    def __init__(self, bus: Bus, *channels: ch.Channel) -> None:
        self.bus = bus
        self.robots: set[str] = set()
        self._has_peer = self._has_map = False
        for channel in (ch.ROBOT_CONFIG, ch.FUSED_MAP, ch.FINAL_MAP, *PEERS, *channels):
            bus.subscribe(channel)
        bus.watch_alive()

    @property
    def folds(self) -> bool:
        return self._has_peer or self._has_map or self.bus.is_alive("central")

    def messages(self, patience_s: float) -> Iterator[tuple[ch.Channel, m.Message]]:
        until = time.monotonic() + patience_s
        while time.monotonic() < until:
            for channel, name, message in open_valid(self.bus.receive(LOOK_S)):
                self._has_peer |= channel in PEERS
                if channel is ch.ROBOT_CONFIG:
                    self.robots.add(name)
                elif isinstance(message, m.FusedMap):
                    self._has_map = True
                    self.robots |= {each.robot for each in message.members}
                    self.robots |= set(message.withdrawn)
                yield channel, message

    def maps(self, patience_s: float) -> Iterator[m.FusedMap]:
        found = (message for _, message in self.messages(patience_s))
        yield from (each for each in found if isinstance(each, m.FusedMap))

    def await_robot(self, robot: str | None = None) -> None:
        """Raise WithdrawError or NoRobotError after CENTRE_S."""
        until = time.monotonic() + CENTRE_S
        while time.monotonic() < until:
            for _ in self.messages(LOOK_S):
                pass
            if self.folds and (robot is None or robot in self.robots):
                return
        if not self.folds:
            raise WithdrawError(
                "no centre and no peer answers; is the team running there? see --team, --connect"
            )
        known = ", ".join(in_order(self.robots)) or "none"
        raise NoRobotError(f"the team has no robot {robot}; its robots: {known}")


def publish_order(bus: Bus, order: Outgoing, signer: "Signer | None") -> None:
    """Publish an order, with keys also its signature."""
    bus.publish(order)
    if signer is not None:
        from teamslam.team.peers.proofs import sign_order

        member = Member(order.key, encoded(order.message), order.message)
        if robot := about(order.message):
            bus.publish(Outgoing(ch.ORDER_SIGNATURE, robot, sign_order(signer, member)))


def withdraw(
    bus: Bus, robot: str, reason: str, patience_s: float, signer: "Signer | None" = None
) -> m.FusedMap:
    """Order a robot's withdrawal; return the first map without it. Raises WithdrawError."""
    team = _RunningTeam(bus)
    team.await_robot(robot)
    order = m.Withdrawal(stamp_ns=0, robot=robot, by="operator", reason=reason)
    publish_order(bus, Outgoing(ch.ORDER, robot, order), signer)
    for fused in team.maps(patience_s):
        if robot in fused.withdrawn:
            return fused
        if fused.rule != "join":
            raise WithdrawError(f"the rule {fused.rule} can not withdraw; only join can")
        if fused.final:
            raise WithdrawError("the final map was out before the order; run the log again")
    raise WithdrawError(f"no map without {robot} within {patience_s:g} s; the order stands")


def give_up(
    bus: Bus, robot: str, reason: str, patience_s: float, signer: "Signer | None" = None
) -> None:
    """Order the team to go on without a lost robot; return when confirmed. Raises WithdrawError."""
    team = _RunningTeam(bus, ch.STATUS)
    team.await_robot(robot)
    node = ch.robot_node(robot)
    order = m.GivenUp(stamp_ns=0, node=node, by="operator", reason=reason)
    publish_order(bus, Outgoing(ch.GIVEN_UP, node, order), signer)
    for _, message in team.messages(patience_s):
        if isinstance(message, m.FusedMap) and message.final:
            return
        if not isinstance(message, m.Status):
            continue
        folds = message.node == "central" or message.node.startswith("robot/")
        if folds and any(text.startswith(f"{robot} is given up") for text in message.warnings):
            return
    raise WithdrawError(f"no confirmation within {patience_s:g} s; the order stands")


def end_team(bus: Bus, reason: str, patience_s: float) -> None:
    """Order a live team to end; return on confirmation. Raises WithdrawError."""
    team = _RunningTeam(bus, ch.TEAM_END)
    team.await_robot()
    if bus.is_alive("world"):
        raise WithdrawError(
            "this team has a world, which ends by itself; `teamslam end --without ROBOT` lets it "
            "end without a robot that is lost"
        )
    order = m.TeamEnd(stamp_ns=0, by="operator", reason=reason)
    bus.publish(Outgoing(ch.END_ORDER, "", order))
    # Without a centre a robot's own final map confirms the order.
    last = ch.FINAL_MAP if bus.is_alive("central") else ch.TEAM_FINAL
    for channel, _ in team.messages(patience_s):
        if channel in (ch.TEAM_END, last):
            return
    raise WithdrawError(f"the centre has not followed within {patience_s:g} s; the order stands")


def local_landmark(text: str) -> m.LocalLandmark:
    """Parse robot/incarnation/submap/landmark, such as `r1/1/12/7`. Raises ValueError."""
    found = _LANDMARK.fullmatch(text)
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
    signer: "Signer | None" = None,
    *,
    withdrawn: bool = False,
) -> m.FusedMap:
    """Publish a verdict on two unnamed landmarks, or its withdrawal; return the first map so.

    Raises NoRobotError, WithdrawError.
    """
    team = _RunningTeam(bus)
    robot = judgement.first.robot
    for each in (robot, judgement.second.robot):
        team.await_robot(each)
    verdict = m.Verdict(
        stamp_ns=0, robot=robot, judgement=judgement, by="operator", reason=reason,
        withdrawn=withdrawn,
    )  # fmt: skip
    publish_order(bus, Outgoing(ch.VERDICT, robot, verdict), signer)
    for fused in team.maps(patience_s):
        if holds(judgement, fused.verdicts) is not withdrawn:
            return fused
        if fused.final:
            raise WithdrawError("the final map was out before the verdict; run the log again")
    if withdrawn:
        raise WithdrawError(
            f"no map without it within {patience_s:g} s; its withdrawal is recorded, and stands"
        )
    raise WithdrawError(
        f"no map rests on it within {patience_s:g} s; the verdict is recorded, and holds once a "
        "map has both landmarks: if none ever does, a submap or a landmark is not as named"
    )
