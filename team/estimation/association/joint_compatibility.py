"""Joint compatibility: which pairs of landmarks of a joint Gaussian are merged together.

A merged pair conditions the joint Gaussian for the pairs after it, so the sum of the log-likelihood
ratios is the ratio of all of them together.

`grow_pairs` merges the likeliest pair first, while it has no rival. `assign_jointly`, for
neighbouring landmarks, weighs an assignment by exp(Σ LLR) of its pairs and accepts a pair if the
assignments with it outweigh all others; joint compatibility branch and bound (Neira and Tardós
2001, IEEE T-RA 17(6)) accepts the assignment with the most pairs.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.gating import (
    Indices,
    Joint,
    Likelihoods,
    Pair,
)
from teamslam.team.shapes import Float

PREGATE = 4.0  # multiple of the gate beyond which a pair is excluded for good
SURE_AFTER = 3
"""Number of pairs after which an alignment grows only by pairs of small standard deviation; others
connect landmarks one spacing off.
"""
MOST_ASSIGNED = 10
"""Most landmarks that are assigned together, those with the most certain candidates."""
BEAM = 100  # most assignments that are extended by the next landmark
HOPELESS = 12.0  # log weight below the best assignment's [nat] at which another is dropped


class MergedPairs(NamedTuple):
    """Pairs in the order of their merges, and the joint Gaussian given them."""

    pairs: tuple[Pair, ...]
    joint: Joint


class Alignment(NamedTuple):
    """Pairs in the order of their merges, and the positions [m] of all landmarks given them."""

    pairs: tuple[Pair, ...]
    mean: Float[np.ndarray, "n 2"]

    @property
    def llr(self) -> float:
        """Log-likelihood ratio of all pairs together."""
        return sum(pair.llr for pair in self.pairs)


def merge_in_order(joint: Joint, pairs: Iterable[tuple[int, int]]) -> MergedPairs | None:
    """Merge pairs in this order; None if one is apart or fails its gate given those before it."""
    merged: list[Pair] = []
    for one, two in pairs:
        if joint.apart[one, two]:
            return None
        at = joint.evaluate(np.array([one]), np.array([two]))
        if at.chi2[0] > joint.profile.gate:
            return None
        merged.append(Pair(one, two, float(at.llr[0]), float(at.sd[0]), -np.inf))
        joint = joint.condition(one, two)
    return MergedPairs(tuple(merged), joint)


def grow_alignment(
    joint: Joint,
    candidates: tuple[Indices, Indices],
    seeds: Sequence[tuple[int, int]],
    sure_sd: float,
) -> Alignment | None:
    """Merge the seeds, whatever their rivals, then as `grow_pairs`; None if one fails its gate."""
    begun = merge_in_order(joint, seeds)
    if begun is None:
        return None
    first, second = candidates
    left = ~np.isin(first, [pair.first for pair in begun.pairs])
    first, second = _select_near(begun.joint, first[left], second[left])
    involved = np.unique(np.concatenate((first, second)))
    grown = _grow(
        MergedPairs(begun.pairs, begun.joint.select(involved)),
        (np.searchsorted(involved, first), np.searchsorted(involved, second)),
        (np.inf, sure_sd),
    )
    pairs = (*begun.pairs, *_renumber(grown.pairs[len(begun.pairs) :], involved))
    return Alignment(pairs, _condition_mean(joint, pairs))


def _renumber(pairs: Iterable[Pair], to: Indices) -> list[Pair]:
    return [pair._replace(first=int(to[pair.first]), second=int(to[pair.second])) for pair in pairs]


def _condition_mean(joint: Joint, pairs: Sequence[Pair]) -> Float[np.ndarray, "n 2"]:
    """Condition the mean on all pairs at once: m − PHᵀ (HPHᵀ + s₀²I)⁻¹ Hm."""
    n = len(joint.mean)
    first, second = (np.array(each) for each in zip(*(pair[:2] for pair in pairs), strict=True))
    P = joint.covariance.reshape(n, 2, n, 2)
    gain = (P[:, :, first] - P[:, :, second]).reshape(2 * n, -1)
    rows = gain.reshape(n, 2, -1)
    S = (rows[first] - rows[second]).reshape(-1, gain.shape[1])
    S = S + core.squared(joint.profile.slack) * np.eye(len(S))
    difference = (joint.mean[first] - joint.mean[second]).ravel()
    by = dense.product(gain, dense.solve(S, difference))
    return np.asarray(joint.mean - by.reshape(n, 2))


def grow_pairs(
    joint: Joint,
    candidates: tuple[Indices, Indices],
    *,
    most_sd: float = np.inf,
    sure_sd: float = np.inf,
) -> MergedPairs:
    """Merge pairs one by one, the likeliest first.

    candidates: two lists of landmarks, pair by pair. most_sd: largest standard deviation of a
    merged pair; sure_sd: the same after SURE_AFTER pairs.
    """
    near = _select_near(joint, *candidates)
    return _grow(MergedPairs((), joint), near, (most_sd, min(most_sd, sure_sd)))


def _select_near(joint: Joint, first: Indices, second: Indices) -> tuple[Indices, Indices]:
    open_ = ~joint.apart[first, second]
    first, second = first[open_], second[open_]
    near = joint.evaluate(first, second).chi2 < PREGATE * joint.profile.gate
    return first[near], second[near]


def _grow(
    begun: MergedPairs, candidates: tuple[Indices, Indices], limits: tuple[float, float]
) -> MergedPairs:
    (*merged,), joint = begun
    first, second = candidates
    profile = joint.profile
    while len(first):
        at = joint.evaluate(first, second)
        least = joint.required_llr(first, second, at.sd)
        limit = limits[len(merged) >= SURE_AFTER]
        fits = (at.chi2 < profile.gate) & (at.llr >= least) & (at.sd <= limit)
        if not fits.any():
            break
        rival = _find_rivals(joint, first, second, at)
        clear = fits & (at.llr - rival >= profile.odds)
        if not clear.any():
            break
        best = int(np.argmax(np.where(clear, at.llr, -np.inf)))
        one, two = int(first[best]), int(second[best])
        merged.append(Pair(one, two, float(at.llr[best]), float(at.sd[best]), float(rival[best])))
        joint = joint.condition(one, two)
        open_ = (first != one) & (second != one) & ~joint.apart[first, second]
        first, second = first[open_], second[open_]
    return MergedPairs(tuple(merged), joint)


def _find_rivals(
    joint: Joint, first: Indices, second: Indices, at: Likelihoods
) -> Float[np.ndarray, " k"]:
    """Find the best LLR of each pair's rivals, which share one of its landmarks and are no
    fragments.
    """
    rival = np.full(len(first), -np.inf)
    for mine, other in ((first, second), (second, first)):
        each, against = _list_common(mine)
        p, q = other[each], other[against]
        x, y = (joint.mean[p] - joint.mean[q]).T
        differ = (x * x + y * y >= core.squared(joint.profile.same)) | joint.apart[p, q]
        np.maximum.at(rival, each[differ], at.llr[against[differ]])
    return rival


def _list_common(landmarks: Indices) -> tuple[Indices, Indices]:
    order = np.argsort(landmarks, kind="stable")
    ordered = landmarks[order]
    begin = np.searchsorted(ordered, ordered, side="left")
    count = np.searchsorted(ordered, ordered, side="right") - begin
    each = np.repeat(np.arange(len(order)), count)
    against = np.arange(len(each)) - np.repeat(np.cumsum(count) - count - begin, count)
    two = each != against
    return order[each[two]], order[against[two]]


class _Assignment(NamedTuple):
    """Pairs so far, their log weight, and the joint Gaussian given them."""

    weight: float
    pairs: tuple[Pair, ...]
    joint: Joint


def assign_jointly(joint: Joint, first: Indices, second: Indices, most_sd: float) -> MergedPairs:
    """Merge the pairs on which nearly all of the weight of joint assignments agrees.

    A pair needs log odds of `odds` against all assignments without it. If one of these pairs has a
    standard deviation above `tight`, all together need a log-likelihood ratio of `llr_loose`; if it
    would without pairs that are not accepted, the assignment as a whole needs it. most_sd: largest
    standard deviation of a pair given those before it, so that far landmarks with a common heading
    error become certain.
    """
    first, second, sd = joint.gate(first, second)
    if not (sd <= most_sd).any():
        return MergedPairs((), joint)
    order = _order_landmarks(first, sd)
    assigned = np.isin(first, order)
    involved = np.unique(np.concatenate((first[assigned], second[assigned])))
    part = joint.select(involved)
    place = {int(each): k for k, each in enumerate(involved)}
    beam, lost = [_Assignment(0.0, (), part)], 0.0
    for each in order:
        own = place[each]
        partners = [place[int(k)] for k in second[first == each]]
        others = _select_partners(part, own, partners)
        longer = [more for one in beam for more in _extend(one, own, others, most_sd)]
        longer.sort(key=lambda one: -one.weight)
        best = longer[0].weight
        lost += sum(core.exp(one.weight - best) for one in longer[BEAM:])
        beam = [one for one in longer[:BEAM] if one.weight > best - HOPELESS]
    pairs = _renumber(_accept_agreed(part, beam, lost), involved)
    for pair in pairs:
        joint = joint.condition(pair.first, pair.second)
    return MergedPairs(tuple(pairs), joint)


def _order_landmarks(first: Indices, sd: Float[np.ndarray, " k"]) -> list[int]:
    surest: dict[int, float] = {}
    for each, own in zip(first.tolist(), sd.tolist(), strict=True):
        surest[each] = min(own, surest.get(each, np.inf))
    return sorted(surest, key=lambda each: (surest[each], each))[:MOST_ASSIGNED]


def _select_partners(joint: Joint, first: int, others: list[int]) -> Indices:
    at = joint.evaluate(np.full(len(others), first), np.array(others))
    distinct: list[int] = []
    for k in np.argsort(-at.llr, kind="stable").tolist():
        if not _find_fragments(joint, others[k]).intersection(distinct):
            distinct.append(others[k])
    return np.array(distinct, np.int64)


def _extend(one: _Assignment, first: int, others: Indices, most_sd: float) -> list[_Assignment]:
    found = [one]
    others = others[~one.joint.apart[first, others]]
    if not len(others):
        return found
    at = one.joint.evaluate(np.full(len(others), first), others)
    for k in np.flatnonzero((at.chi2 < one.joint.profile.gate) & (at.sd <= most_sd)).tolist():
        other, llr = int(others[k]), float(at.llr[k])
        joint = one.joint.condition(first, other)
        pair = Pair(first, other, llr, float(at.sd[k]), -np.inf)
        found.append(_Assignment(one.weight + llr, (*one.pairs, pair), joint))
    return found


def _find_fragments(joint: Joint, landmark: int) -> set[int]:
    away = core.hypot(*(joint.mean - joint.mean[landmark]).T)
    near = np.flatnonzero((away < joint.profile.same) & ~joint.apart[landmark])
    own = np.full(len(near), landmark)
    at = joint.evaluate(own, near)
    least = joint.required_llr(own, near, np.zeros(len(near)))
    return {landmark, *near[at.llr >= least].tolist()}


def _accept_agreed(part: Joint, beam: list[_Assignment], lost: float) -> list[Pair]:
    """Accept the pairs of the best assignment that the others contain as well, by weight.

    part: landmarks before any merge. lost: relative weight of the dropped assignments. Pairs are
    evaluated without those that are not accepted; none is accepted if one then fails its gate.
    """
    best, profile = beam[0], part.profile
    weights = core.exp(np.array([one.weight - best.weight for one in beam]))
    others = [{pair.first: pair.second for pair in one.pairs} for one in beam]
    sure = []
    for pair in best.pairs:
        same = _find_fragments(best.joint, pair.second)
        having = np.array([each.get(pair.first, -1) in same for each in others])
        against = float(weights[~having].sum()) + lost
        odds = core.log(weights[having].sum() / against) if against > 0.0 else HOPELESS
        if odds >= profile.odds:
            sure.append(pair._replace(rival=pair.llr - odds))
    alone = sure
    if len(sure) < len(best.pairs):
        found = merge_in_order(part, [(pair.first, pair.second) for pair in sure])
        if found is None:
            return []
        alone = [
            each._replace(rival=each.llr - pair.llr + pair.rival)
            for each, pair in zip(found.pairs, sure, strict=True)
        ]
    for pairs, llr in ((sure, sum(pair.llr for pair in sure)), (alone, best.weight)):
        if any(pair.sd > profile.tight for pair in pairs) and llr < profile.llr_loose:
            return []
    return alone
