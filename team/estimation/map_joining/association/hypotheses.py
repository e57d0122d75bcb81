"""Joint data association where each single pair has a rival: all joint assignments are weighed.

Two neighbouring landmarks, each of which may be either of two known ones, are distinguished by each
other: their relative position is known far better than their absolute ones. The landmarks are
assigned one after the other; each is one of the known landmarks, given the pairs before it, or a
new one. An assignment has the weight exp(Σ LLR) of its pairs (`growing`), and a pair is accepted
when the assignments that contain it outweigh all others. Neira and Tardós (2001, IEEE T-RA 17(6))
accept the assignment with the most pairs; here it also has to be the only likely one.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from team.association import AssociationProfile
from team.estimation import elementwise
from team.estimation.map_joining.association.growing import (
    Grown,
    Indices,
    Joint,
    Pair,
    conditioned,
    likelihoods,
    needed,
)

MOST_ASSIGNED = 10
"""Number of landmarks that are assigned together: those with the best known candidates."""
BEAM = 100
"""Number of assignments that are continued from landmark to landmark."""
HOPELESS = 12.0
"""An assignment is dropped whose log weight is below the best one's by more than this [nat]."""


class _Assignment(NamedTuple):
    """The pairs so far, their log weight, and the joint Gaussian given them."""

    weight: float
    pairs: tuple[Pair, ...]
    joint: Joint


def jointly(
    joint: Joint, first: Indices, second: Indices, profile: AssociationProfile, most_sd: float
) -> Grown:
    """The pairs of candidates on which nearly all of the weight of joint assignments agrees.

    A pair needs log odds of `odds` against all assignments without it. Where the standard deviation
    of one of these pairs exceeds `tight`, all of them together need a log-likelihood ratio of
    `llr_loose`, as a single such pair does (`growing.needed`): where little is known, a few
    landmarks fit others by chance. Where it exceeds `tight` but for pairs of the assignment that
    are not accepted, the assignment as a whole needs it.
    most_sd: candidates with a larger standard deviation are left out.
    """
    first, second, sd = candidates(joint, first, second, profile, most_sd)
    if not len(first):
        return Grown((), joint, 0)
    order = _order(first, sd)
    taken = np.isin(first, order)
    involved = np.unique(np.concatenate((first[taken], second[taken])))
    in_window = joint.apart_in_window
    part = Joint(
        joint.mean[involved],
        joint.covariance.reshape(len(joint.mean), 2, -1, 2)[involved][:, :, involved].reshape(
            2 * len(involved), -1
        ),
        joint.apart[np.ix_(involved, involved)],
        joint.crowd,
        None if joint.unseen is None else joint.unseen[involved],
        None if in_window is None else in_window[np.ix_(involved, involved)],
    )
    place = {int(each): k for k, each in enumerate(involved)}
    assigned, lost = [_Assignment(0.0, (), part)], 0.0
    for each in order:
        own = place[each]
        others = _of_each(part, own, [place[int(k)] for k in second[first == each]], profile)
        longer = [more for one in assigned for more in _with(one, own, others, profile, most_sd)]
        longer.sort(key=lambda one: -one.weight)
        best = longer[0].weight
        lost += sum(float(elementwise.exp(one.weight - best)) for one in longer[BEAM:])
        assigned = [one for one in longer[:BEAM] if one.weight > best - HOPELESS]
    return _agreed((joint, part), assigned, involved, profile, lost)


def candidates(
    joint: Joint, first: Indices, second: Indices, profile: AssociationProfile, most_sd: float
) -> tuple[Indices, Indices, Float[np.ndarray, " k"]]:
    """The pairs that can be one landmark and whose difference is known to `most_sd` [m], with its
    standard deviations.
    """
    at = likelihoods(joint, first, second, profile)
    open_ = (at.chi2 < profile.gate) & (at.sd <= most_sd) & ~joint.apart[first, second]
    return first[open_], second[open_], at.sd[open_]


def _order(first: Indices, sd: Float[np.ndarray, " k"]) -> list[int]:
    """The order of assignment: the landmark with the surest candidates first."""
    surest: dict[int, float] = {}
    for each, own in zip(first.tolist(), sd.tolist(), strict=True):
        surest[each] = min(own, surest.get(each, np.inf))
    return sorted(surest, key=lambda each: (surest[each], each))[:MOST_ASSIGNED]


def _of_each(joint: Joint, first: int, others: list[int], profile: AssociationProfile) -> Indices:
    """The candidates of a landmark, of which those that are likely to be one count as their
    likeliest one.
    """
    at = likelihoods(joint, np.full(len(others), first), np.array(others), profile)
    distinct: list[int] = []
    for k in np.argsort(-at.llr, kind="stable").tolist():
        if not _fragments(joint, others[k], profile).intersection(distinct):
            distinct.append(others[k])
    return np.array(distinct, np.int64)


def _with(
    one: _Assignment, first: int, others: Indices, profile: AssociationProfile, most_sd: float
) -> list[_Assignment]:
    """The continuations of an assignment by one landmark: as a new one, and as each one that
    fits.
    """
    found = [one]
    others = others[~one.joint.apart[first, others]]
    if not len(others):
        return found
    at = likelihoods(one.joint, np.full(len(others), first), others, profile)
    for k in np.flatnonzero((at.chi2 < profile.gate) & (at.sd <= most_sd)).tolist():
        other, llr = int(others[k]), float(at.llr[k])
        joint = conditioned(one.joint, first, other, profile)
        pair = Pair(first, other, llr, float(at.sd[k]), -np.inf)
        found.append(_Assignment(one.weight + llr, (*one.pairs, pair), joint))
    return found


def _fragments(joint: Joint, landmark: int, profile: AssociationProfile) -> set[int]:
    """The landmark and its likely fragments: two parts of one landmark are no rivals."""
    n = len(joint.mean)
    at = likelihoods(joint, np.full(n, landmark), np.arange(n), profile)
    near = elementwise.hypot(*(joint.mean - joint.mean[landmark]).T) < profile.same
    least = needed(joint, np.full(n, landmark), np.arange(n), np.zeros(n), profile)
    one = (at.llr >= least) & near & ~joint.apart[landmark]
    return {landmark, *np.flatnonzero(one).tolist()}


def _agreed(
    joints: tuple[Joint, Joint],
    assigned: list[_Assignment],
    involved: Indices,
    profile: AssociationProfile,
    lost: float,
) -> Grown:
    """The pairs of the best assignment that the others contain as well, by weight.

    joints: of all landmarks, and of those that are involved, before any pair is taken.
    lost: the weight of the dropped assignments, relative to the best one's.
    """
    joint, part = joints
    best = assigned[0]
    weights = elementwise.exp(np.array([one.weight - best.weight for one in assigned]))
    others = [{pair.first: pair.second for pair in one.pairs} for one in assigned]
    sure = []
    for pair in best.pairs:
        same = _fragments(best.joint, pair.second, profile)
        having = np.array([each.get(pair.first, -1) in same for each in others])
        against = float(weights[~having].sum()) + lost
        odds = (
            float(elementwise.log(weights[having].sum() / against)) if against > 0.0 else HOPELESS
        )
        if odds >= profile.odds:
            sure.append(pair._replace(rival=pair.llr - odds))
    alone = sure if len(sure) == len(best.pairs) else _without_the_others(part, sure, profile)
    if _loose(sure, profile) and sum(pair.llr for pair in sure) < profile.llr_loose:
        alone = []
    if _loose(alone, profile) and best.weight < profile.llr_loose:
        alone = []
    pairs = []
    for pair in alone:
        own = pair._replace(first=int(involved[pair.first]), second=int(involved[pair.second]))
        joint = conditioned(joint, own.first, own.second, profile)
        pairs.append(own)
    return Grown(tuple(pairs), joint, 0)


def _loose(pairs: list[Pair], profile: AssociationProfile) -> bool:
    """Whether the difference of one of these pairs is poorly known."""
    return any(pair.sd > profile.tight for pair in pairs)


def _without_the_others(part: Joint, sure: list[Pair], profile: AssociationProfile) -> list[Pair]:
    """The sure pairs with their figures given each other alone; none where one does not fit then.

    In its assignment each was weighed given all pairs before it. What is known well only if a pair
    is right that is not accepted is not known well.
    """
    found = []
    for pair in sure:
        at = likelihoods(part, np.array([pair.first]), np.array([pair.second]), profile)
        if at.chi2[0] > profile.gate:
            return []
        llr = float(at.llr[0])
        found.append(pair._replace(llr=llr, sd=float(at.sd[0]), rival=llr - pair.llr + pair.rival))
        part = conditioned(part, pair.first, pair.second, profile)
    return found
