"""What an operator has said of pairs of landmarks without names, and what came of it."""

from collections.abc import Collection

from central.desk.evaluation.log import Collected
from team.wire import channels as ch
from team.wire import messages as m

Pair = frozenset[m.LocalLandmark]


def pair_of(judgement: m.Judgement) -> Pair:
    """The two landmarks, in whichever order they were named."""
    return frozenset((judgement.first, judgement.second))


def name_of(landmark: m.LocalLandmark) -> str:
    """As `r1/1/12/7`: robot, incarnation, submap, local landmark."""
    return f"{landmark.robot}/{landmark.incarnation}/{landmark.sequence}/{landmark.local}"


def contradicted(judgement: m.Judgement, others: Collection[m.Judgement]) -> bool:
    """Whether one of the others says the opposite of the same pair."""
    pair = pair_of(judgement)
    return any(pair_of(each) == pair and each.same != judgement.same for each in others)


def verdicts_given(log: Collected) -> tuple[str, ...]:
    """Each verdict of a log in words, in the order in which they were given."""
    keys = [key for key in log.samples if ch.VERDICT.owner(key) is not None]
    samples = sorted((s for key in keys for s in log.samples[key]), key=lambda s: s.wall_ns)
    given = [v for v in map(log.sound, samples) if isinstance(v, m.Verdict)]
    final = log.sound(log.last(ch.FINAL_MAP))
    rests_on = final.verdicts if isinstance(final, m.FusedMap) else ()
    return tuple(_words(each, rests_on) for each in given)


def _words(verdict: m.Verdict, rests_on: Collection[m.Judgement]) -> str:
    judgement = verdict.judgement
    first, second = name_of(judgement.first), name_of(judgement.second)
    text = f"{first} and {second} are {'one landmark' if judgement.same else 'two landmarks'}"
    text += f": {verdict.reason}" if verdict.reason else ""
    if verdict.withdrawn:
        return f"{text} (withdrawn)"
    holds = any(
        pair_of(each) == pair_of(judgement) and each.same == judgement.same for each in rests_on
    )
    if not holds:
        return f"{text} (not in the map: withdrawn, or it does not have both)"
    if judgement.same and contradicted(judgement, rests_on):
        return f"{text} (without effect: they were said to be two, too)"
    return text
