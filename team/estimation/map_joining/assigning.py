"""A submap's place where it is nearly known: by joint assignment of a few landmarks.

Map matching needs many pairs, since it searches everywhere. Where the place of a submap among the
landmarks of others is known to a few metres already, the places that it may have are few, and the
joint assignments to the landmarks there weigh all of them: three pairs on which they agree are
enough, if together they have the evidence that a single uncertain pair needs.
"""

from collections.abc import Sequence

import numpy as np

from team.estimation.map_joining.associating import IslandView, union
from team.estimation.map_joining.association.closing import Closure
from team.estimation.map_joining.association.comparing import comparable
from team.estimation.map_joining.association.growing import SURE_AFTER, Grown
from team.estimation.map_joining.association.hypotheses import jointly
from team.estimation.map_joining.association.shares import matched_share

NEARLY = 2.0
"""A place is nearly known up to this standard deviation of a pair's difference, in object radii."""


def assigned(view: IslandView, submaps: Sequence[int]) -> Closure | None:
    """The first of these submaps, the newest first, whose landmarks are assigned to those of
    submaps elsewhere.

    A group has SURE_AFTER pairs or more, one of them known to no better than `near`, what `jointly`
    asks of such a group together, and the share of a closure.
    """
    profile = view.profile
    others = view.sees.copy()
    others[submaps] = False
    patch = union(view.seen_by[k] for k in submaps)
    target = union([np.flatnonzero(others.any(axis=0))])
    for k in reversed(submaps):
        own = view.unnamed(k)
        for candidates in comparable(view.joint, own, others, profile, NEARLY * profile.same):
            one, two = (each.ravel() for each in np.meshgrid(own, candidates, indexing="ij"))
            different = one != two
            found = jointly(
                view.joint, one[different], two[different], profile, NEARLY * profile.same
            )
            if not _is_group(found, profile.near):
                continue
            mean = found.joint.mean
            places = mean[[pair.second for pair in found.pairs]]
            share = matched_share(mean[patch], mean[target], places, len(places), profile)
            if share < profile.share:
                continue
            return Closure(
                pairs=found.pairs,
                llr=found.llr,
                absent=0,
                rival_pairs=0,
                rival_llr=0.0,
                share=share,
                sd=max(pair.sd for pair in found.pairs),
                motion=np.zeros(3),
                why="",
            )
    return None


def _is_group(found: Grown, near: float) -> bool:
    """Whether enough pairs agree, of which one was farther off than what is compared anyway."""
    return len(found.pairs) >= SURE_AFTER and max(pair.sd for pair in found.pairs) > near
