"""State of each robot in the final map."""

from collections.abc import Collection, Mapping
from typing import Literal, NamedTuple

from teamslam.central.desk.evaluation.log import Collected
from teamslam.central.desk.names import in_order, not_joined
from teamslam.team.config import MAP
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m

State = Literal["joined", "not joined", "withdrawn", "lost", "alone"]
"""joined: in the team's map. not joined: its map, if any, is separate. withdrawn: by an order or a
contradiction. lost: its stream is incomplete. alone: the rule does not fuse.
"""
UNNAMED_REASON = "the log does not contain the reason"
SAVED_MAP = "the saved map "
"""Before the name of a saved map in a map's reasons."""
NO_MEMBER = "nothing of it is in the map"


class RobotState(NamedTuple):
    """State in the final map, and the reason unless joined."""

    state: State
    why: str = ""


def robot_states(
    log: Collected, fused: m.FusedMap | None, robots: Collection[str]
) -> dict[str, RobotState]:
    """State of every robot, and of every saved map as `map-<name>`."""
    if fused is None:
        return {}
    members = {member.robot for member in fused.members}
    team = {*robots, *log.robots, *fused.withdrawn, *fused.lost, *members}
    if not members and fused.rule != "join":
        return {name: RobotState("alone") for name in in_order(team)}
    apart = {
        name.replace(SAVED_MAP, MAP): why
        for who, why in not_joined(fused.reasons)
        for name in who.split(", ")
    }
    orders = (each for of in (ch.WITHDRAWAL, ch.ORDER) for each in log.of_all(of, m.Withdrawal))
    because = {each.robot: f"by {each.by}: {each.reason}" for each in orders}  # orders prevail
    reason_of = {who: why for who, _, why in (r.partition(": ") for r in fused.reasons[::-1])}

    def state_of(name: str) -> RobotState:
        if name in fused.withdrawn:
            return RobotState("withdrawn", because.get(name, UNNAMED_REASON))
        if name in fused.lost:
            return RobotState("lost", "its stream is incomplete in the map")
        if name in apart:
            return RobotState("not joined", apart[name])
        if name in members:
            return RobotState("joined")
        return RobotState("not joined", reason_of.get(name) or NO_MEMBER)

    return {name: state_of(name) for name in in_order(team)}


NO_LANDMARK = (
    "the final map has no landmark: no robot measured one within its sensor's range "
    "(sensor.min_range, max_range; of a simulated world visible_from_m, visible_to_m)"
)


def not_in_the_map(states: Mapping[str, RobotState]) -> tuple[str, ...]:
    """Describe robots not or incompletely in the map."""
    return tuple(
        f"{name} {of.state}{': ' if of.why else ''}{of.why}"
        for name, of in states.items()
        if of.state not in {"joined", "alone"} and not name.startswith(MAP)
    )
