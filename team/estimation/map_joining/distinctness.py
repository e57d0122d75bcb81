"""Which landmarks of a map are known to be different ones.

Association merges two landmarks only where no rival comes near, and otherwise waits. Until it is
decided they may be one: a map that shows both may show one landmark twice.
"""

from collections.abc import Collection

import numpy as np

from team.estimation.map_joining.associating import IslandView
from team.estimation.map_joining.association.growing import Indices, likelihoods


def maybe_the_same(view: IslandView, ids: Collection[int]) -> dict[int, int]:
    """Of these landmarks, those that may be one with another one, each with the likeliest other
    one, which stays.

    They may be one with the log-likelihood ratio (`growing`) with which a pair is merged that has
    no rival. The landmark that more submaps have observed stays; of equal ones the one with fewer
    such pairs, then that with the smaller identity.
    """
    profile, joint = view.profile, view.joint
    own: Indices = np.array([view.place_of[id_] for id_ in sorted(ids)], np.int64)
    one, two = (own[each] for each in np.triu_indices(len(own), 1))
    at = likelihoods(joint, one, two, profile)
    maybe = (at.chi2 < profile.gate) & (at.llr >= profile.llr_tight) & ~joint.apart[one, two]
    llr: dict[int, dict[int, float]] = {}
    for a, b, ratio in zip(
        one[maybe].tolist(), two[maybe].tolist(), at.llr[maybe].tolist(), strict=True
    ):
        llr.setdefault(a, {})[b] = llr.setdefault(b, {})[a] = ratio
    counts = np.bincount(np.concatenate(view.seen_by), minlength=len(view.ids))
    stays: set[int] = set()
    out: dict[int, int] = {}
    for each in sorted(llr, key=lambda k: (-int(counts[k]), len(llr[k]), view.ids[k])):
        others = [other for other in llr[each] if other in stays]
        if others:
            likeliest = max(others, key=lambda other: (llr[each][other], -view.ids[other]))
            out[view.ids[each]] = view.ids[likeliest]
        else:
            stays.add(each)
    return out
