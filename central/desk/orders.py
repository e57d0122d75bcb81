"""An operator's orders to a running team: go on without a robot, or end without it."""

import time

from central.desk.names import in_order
from team.peers.members import Member, about
from team.peers.proofs import Signs, signed_order
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Bus, Outgoing, sound
from team.wire.codec import encoded

CENTRE_S = 10.0
"""Time [s] within which a running centre or robot is noticed."""
LOOK_S = 0.05
NO_CENTRE = "no centre and no peer answers; is the team running there? see --team, --connect"
PEERS = (ch.TEAM_CONFIG, ch.TEAM_MAP, ch.TEAM_FINAL)
"""The channels of peers' own folds."""
_PEER = "*"
"""Stands in the set of reporters once a peer has announced its own fold."""


class WithdrawError(RuntimeError):
    """The order could not be given, or was not followed; the text says why and what to do."""


class NoRobotError(WithdrawError):
    """The team has no such robot."""


def ordered(bus: Bus, order: Outgoing, signer: Signs | None) -> None:
    """Publish an order; with keys its signature after it, for peers that receive it over others."""
    bus.publish(order)
    if signer is not None:
        member = Member(order.key, encoded(order.message), order.message)
        robot = about(order.message)
        if robot:
            bus.publish(Outgoing(ch.ORDER_SIGNATURE, robot, signed_order(signer, member)))


def withdraw(
    bus: Bus, robot: str, reason: str, patience_s: float, signer: Signs | None = None
) -> m.FusedMap:
    """Order a robot's withdrawal and wait for the first map without it, a centre's or a peer's.

    signer: the operator's, where there are keys. Raises WithdrawError where there is no centre and
    no peer, no such robot, no rule that can withdraw, or no such map within the time.
    """
    for channel in (ch.ROBOT_CONFIG, ch.FUSED_MAP, ch.FINAL_MAP, *PEERS):
        bus.subscribe(channel)
    bus.watch_alive()
    robots: set[str] = set()
    await_team(bus, robot, robots)
    order = m.Withdrawal(stamp_ns=0, robot=robot, by="operator", reason=reason)
    ordered(bus, Outgoing(ch.ORDER, robot, order), signer)
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        for fused in _maps(bus, robots):
            if robot in fused.withdrawn:
                return fused
            if fused.rule != "join":
                raise WithdrawError(f"the rule {fused.rule} can not withdraw; only join can")
            if fused.final:
                raise WithdrawError("the final map was out before the order; run the log again")
    raise WithdrawError(f"no map without {robot} within {patience_s:g} s; the order stands")


def give_up(
    bus: Bus, robot: str, reason: str, patience_s: float, signer: Signs | None = None
) -> None:
    """Order that nobody waits for a robot any more, and wait until a centre or a peer confirms it.

    signer: the operator's, where there are keys. Raises WithdrawError where there is no centre and
    no peer, no such robot, or no confirmation within the time.
    """
    for channel in (ch.ROBOT_CONFIG, ch.STATUS, ch.FUSED_MAP, ch.FINAL_MAP, *PEERS):
        bus.subscribe(channel)
    bus.watch_alive()
    await_team(bus, robot, set())
    node = ch.robot_node(robot)
    order = m.GivenUp(stamp_ns=0, node=node, by="operator", reason=reason)
    ordered(bus, Outgoing(ch.GIVEN_UP, node, order), signer)
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        for _, name, message in sound(bus.receive(LOOK_S)):
            if isinstance(message, m.FusedMap) and message.final:
                return
            folds = name == "central" or name.startswith("robot/")
            warnings = message.warnings if isinstance(message, m.Status) and folds else ()
            if any(warning.startswith(f"{robot} is given up") for warning in warnings):
                return
    raise WithdrawError(f"nobody has followed within {patience_s:g} s; the order stands")


def end_team(bus: Bus, reason: str, patience_s: float) -> None:
    """Order a live team to end, and wait until the centre repeats the order, or a peer follows.

    Raises WithdrawError where there is neither, the team has a world, or no confirmation within the
    time.
    """
    for channel in (ch.TEAM_END, ch.FINAL_MAP):
        bus.subscribe(channel)
    bus.watch_alive()
    await_fold(bus)
    if bus.is_alive("world"):
        raise WithdrawError(
            "this team has a world, which ends by itself; `teamslam end --without ROBOT` lets it "
            "end without a robot that is lost"
        )
    order = m.TeamEnd(stamp_ns=0, by="operator", reason=reason)
    bus.publish(Outgoing(ch.END_ORDER, "", order))
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        for sample in bus.receive(LOOK_S):
            found = ch.channel_of(sample.key)
            if found is not None and found[0] in (ch.TEAM_END, ch.FINAL_MAP, ch.TEAM_FINAL):
                return
    raise WithdrawError(f"the centre has not followed within {patience_s:g} s; the order stands")


def await_fold(bus: Bus) -> None:
    """Wait until a centre is alive or a peer has announced its fold; raises WithdrawError where
    none has within CENTRE_S.
    """
    until, reporters = time.monotonic() + CENTRE_S, set[str]()
    for channel in PEERS:
        bus.subscribe(channel)
    while not (bus.is_alive("central") or _PEER in reporters):
        if time.monotonic() > until:
            raise WithdrawError(NO_CENTRE)
        _maps(bus, reporters)


def await_team(bus: Bus, robot: str, robots: set[str]) -> None:
    """Wait until a centre, or a peer, is there, and a message of the robot has arrived.

    robots: those of whom something has arrived; they are added. Raises WithdrawError where there is
    neither, NoRobotError where there is no such robot.
    """
    until = time.monotonic() + CENTRE_S
    folds = False
    while time.monotonic() < until:
        folds = bool(_maps(bus, robots)) or bus.is_alive("central") or _PEER in robots
        if folds and robot in robots - {_PEER}:
            return
    if not folds:
        raise WithdrawError(NO_CENTRE)
    robots.discard(_PEER)
    known = ", ".join(in_order(robots)) or "none"
    raise NoRobotError(f"the team has no robot {robot}; its robots: {known}")


def _maps(bus: Bus, robots: set[str]) -> list[m.FusedMap]:
    """The maps that have arrived; the names of all robots in arrived messages are added to
    `robots`.
    """
    found = []
    for channel, name, message in sound(bus.receive(LOOK_S)):
        if channel is ch.ROBOT_CONFIG:
            robots.add(name)
        elif channel is ch.TEAM_CONFIG:
            robots.add(_PEER)
        elif isinstance(message, m.FusedMap):
            robots |= {member.robot for member in message.members} | set(message.withdrawn)
            found.append(message)
    return found
