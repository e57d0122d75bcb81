"""Which submaps the landmarks of one submap are compared with, one after the other.

The landmarks of one submap are different ones. Those of the whole map are not, while some of them
wait: fragments of one landmark are candidates for each other, and the assignments to all of them
at once do not agree on any. So the landmarks of a submap are assigned to those of one other submap
at a time, beside what is known to be different from these.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from team.association import AssociationProfile
from team.estimation.map_joining.association.growing import Indices, Joint, likelihoods

COMPARED = 6
"""Number of submaps that one submap is compared with: those with the most candidates."""
AGAIN = 8
"""Number of older submaps with undecided landmarks that a tick examines again: the newest half of
them, and for the other half the others by turns.
"""
AGAIN_WITHIN = 10.0
"""An older submap is examined again if its undecided landmarks lie within this many object radii of
a landmark that the tick brings.
"""


def comparable(
    joint: Joint,
    own: Indices,
    sees: Bool[np.ndarray, "K n"],
    profile: AssociationProfile,
    most_sd: float,
) -> list[Indices]:
    """For each submap that is worth a comparison the landmarks that `own` may be.

    Beside the submap's landmarks these are the rivals that it lacks: landmarks that one of `own`
    may be, and that are known to be none of those of the submap that it may be. Without them a
    landmark that the submap missed would be taken for its neighbour.

    sees: which landmarks each submap has. most_sd: candidates with a larger standard deviation of
        the difference are left out.
    """
    others = np.setdiff1d(np.flatnonzero(sees.any(axis=0)), own)
    one, two = (each.ravel() for each in np.meshgrid(own, others, indexing="ij"))
    at = likelihoods(joint, one, two, profile)
    open_ = (at.chi2 < profile.gate) & (at.sd <= most_sd) & ~joint.apart[one, two]
    if not open_.any():
        return []
    fits = np.zeros((len(own), len(joint.mean)), np.bool_)
    fits[np.searchsorted(own, one[open_]), two[open_]] = True
    common = fits.astype(np.float32) @ sees.T.astype(np.float32)  # exact: sums of ones
    candidates = (common > 0.0).sum(axis=0)
    best = sorted(np.flatnonzero(candidates).tolist(), key=lambda k: (-int(candidates[k]), -k))
    found = []
    for k in best[:COMPARED]:
        theirs = np.flatnonzero(sees[k])
        rivals = np.zeros(len(joint.mean), np.bool_)
        for row in fits:
            mine = theirs[row[theirs]]
            if len(mine):
                rivals |= row & joint.apart[:, mine].all(axis=1)
        found.append(np.union1d(np.setdiff1d(theirs, own), np.flatnonzero(rivals)))
    return found


def undecided(joint: Joint, around: Indices, profile: AssociationProfile) -> Indices:
    """Those of some landmarks that may be one with another one of them."""
    one, two = (around[each] for each in np.triu_indices(len(around), 1))
    at = likelihoods(joint, one, two, profile)
    open_ = (at.chi2 < profile.gate) & (at.sd <= profile.near) & ~joint.apart[one, two]
    return np.unique(np.concatenate([one[open_], two[open_]]))


def by_turns(submaps: Sequence[int], turn: int) -> list[int]:
    """Of these submaps the newest AGAIN / 2, and as many of the older ones, others at each turn."""
    half = AGAIN // 2
    if len(submaps) <= AGAIN:
        return list(submaps)
    older = submaps[:-half]
    step = len(older) // half
    chosen = {older[(turn + k * step) % len(older)] for k in range(half)}
    return [*sorted(chosen), *submaps[-half:]]
