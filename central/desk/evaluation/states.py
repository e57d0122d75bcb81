"""State of each robot in the final map."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Literal, NamedTuple

from teamslam.central.desk.names import in_order, not_joined
from teamslam.team.config import MAP
from teamslam.team.wire import channels as ch, messages as m

if TYPE_CHECKING:  # a launch gives orders without NumPy
    from teamslam.central.desk.evaluation.log import Collected

State = Literal["joined", "not joined", "withdrawn", "lost", "alone"]
"""joined: in the team's map. not joined: its map, if any, is separate. withdrawn: by an order or a
contradiction. lost: its stream is incomplete. alone: the rule does not fuse.
"""
UNNAMED_REASON = "the log does not contain the reason"
SAVED_MAP = "the saved map "  # before the name of a saved map in a map's reasons
NO_MEMBER = "nothing of it is in the map"


class RobotState(NamedTuple):
    """State in the final map, and the reason unless joined."""

    state: State
    why: str = ""


def robot_states(log: "Collected") -> dict[str, RobotState]:
    """State of every robot, and of saved maps as `map-<name>`."""
    fused = log.final_map
    if fused is None:
        return {}
    robots = [] if log.scenario is None else [each.id for each in log.scenario.robots]
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


Pair = frozenset[m.LocalLandmark]


def _pair(judgement: m.Judgement) -> Pair:
    return frozenset((judgement.first, judgement.second))


def _name(landmark: m.LocalLandmark) -> str:
    """Format as `r1/1/12/7`: robot, incarnation, submap, local landmark."""
    return f"{landmark.robot}/{landmark.incarnation}/{landmark.sequence}/{landmark.local}"


def describe_verdict(judgement: m.Judgement) -> str:
    """Verdict as text."""
    first, second = _name(judgement.first), _name(judgement.second)
    return f"{first} and {second} are {'one landmark' if judgement.same else 'two landmarks'}"


def contradicting(
    judgement: m.Judgement, others: Collection[m.Judgement]
) -> tuple[m.Judgement, ...]:
    """Smallest set of other verdicts that contradicts a verdict; empty if consistent.

    A chain of "same" verdicts, and last the "different" one on its ends.
    """
    pair = _pair(judgement)
    same = [each for each in others if each.same and _pair(each) != pair]
    different = [each for each in others if not each.same]
    if not judgement.same:
        same += [each for each in others if each.same and _pair(each) == pair]
        return tuple(_chain(judgement.first, judgement.second, same) or ())
    found = [
        (*before, *after, each)
        for each in different
        for one, two in ((judgement.first, judgement.second), (judgement.second, judgement.first))
        if (before := _chain(each.first, one, same)) is not None
        and (after := _chain(two, each.second, same)) is not None
    ]
    return min(found, key=len, default=())


def holds(judgement: m.Judgement, verdicts: Collection[m.Judgement]) -> bool:
    """Whether an equal verdict is among others."""
    return any(_pair(x) == _pair(judgement) and x.same == judgement.same for x in verdicts)


def _chain(
    first: m.LocalLandmark, last: m.LocalLandmark, same: Collection[m.Judgement]
) -> list[m.Judgement] | None:
    chains: dict[m.LocalLandmark, list[m.Judgement]] = {first: []}
    reached = [first]
    for at in reached:  # grows during the loop
        for each in same:
            pair = _pair(each)
            for other in pair - {at} if at in pair else ():
                if other not in chains:
                    chains[other] = [*chains[at], each]
                    reached.append(other)
    return chains.get(last)


def verdicts_given(log: "Collected") -> tuple[str, ...]:
    """Describe the verdicts of a log, in order."""
    keys = [key for key in log.samples if ch.row_of(key) is ch.VERDICT]
    samples = sorted((s for key in keys for s in log.samples[key]), key=lambda s: s.sample.wall_ns)
    given = [v for v in map(log.sound, samples) if isinstance(v, m.Verdict)]
    rests_on = () if log.final_map is None else log.final_map.verdicts
    return tuple(_words(each, rests_on) for each in given)


def _words(verdict: m.Verdict, rests_on: Collection[m.Judgement]) -> str:
    judgement = verdict.judgement
    text = describe_verdict(judgement) + (f": {verdict.reason}" if verdict.reason else "")
    if verdict.withdrawn:
        return f"{text} (withdrawn)"
    if not holds(judgement, rests_on):
        return f"{text} (not in the map: withdrawn, or it does not have both)"
    chain = contradicting(judgement, rests_on)
    if judgement.same and len(chain) == 1:
        return f"{text} (without effect: another verdict has them as two)"
    if len(chain) > 1:
        return f"{text} (contradicted: {', '.join(map(describe_verdict, chain))}; two they stay)"
    return text
