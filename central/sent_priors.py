"""Which priors a robot needs: those that say something that it can not know by itself.

A robot joins its last prior with its own submaps since, so a new prior is worth its bytes only for
what teammates have said, or for landmarks that it comes near to. Priors are nearly all that the
centre sends; in a map that stands still most of them say nothing new.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.estimation.contribution import Stream
from team.estimation.map_joining.marginals import LandmarkBlocks

EVERY = 8
"""Of so many broadcasts one brings a prior at least: a robot has no more submaps of its own to
join, and who has missed one does not wait for long."""
NEEDED = 12
"""The landmarks nearest to a robot, which it will see next."""
MOVED = 0.1
"""Root of the mean square of how far they moved, in standard deviations."""
SURER = 0.8
"""… or their variance has become this part of what it was."""


@dataclass(frozen=True)
class _Sent:
    """The map that a robot was told of, and its nearest landmarks that it was told; since:
    broadcasts since then.
    """

    blocks: LandmarkBlocks
    ids: UInt32[np.ndarray, " L"]
    since: int


class SentPriors:
    """What each stream was told last. A function of the broadcasts before, not of the set."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._sent: dict[Stream, _Sent] = {}

    def is_worth(
        self, stream: Stream, pose: Float[np.ndarray, "3"], blocks: LandmarkBlocks
    ) -> bool:
        """Whether a prior at this pose in this map is to be sent; it counts as told then."""
        offsets = blocks.means - pose[:2]
        nearest = np.argsort((offsets * offsets).sum(axis=1), kind="stable")
        old = self._sent.get(stream)
        if old is None or old.since + 1 >= EVERY or _has_changed(old, blocks, nearest[:NEEDED]):
            self._sent[stream] = _Sent(blocks, np.sort(blocks.ids[nearest[: self._most]]), 0)
            return True
        self._sent[stream] = replace(old, since=old.since + 1)
        return False


def _has_changed(old: _Sent, now: LandmarkBlocks, needed: Int64[np.ndarray, " k"]) -> bool:
    ids = now.ids[needed]
    if not np.isin(ids, old.ids).all():
        return True
    if not len(needed):
        return False
    before = np.searchsorted(old.blocks.ids, ids)
    moved = now.means[needed] - old.blocks.means[before]
    variances, were = (
        np.trace(each, axis1=1, axis2=2)
        for each in (now.covariances[needed], old.blocks.covariances[before])
    )
    share = 2.0 * (moved * moved).sum(axis=1) / variances
    return bool(share.mean() > MOVED**2 or (variances < SURER * were).any())
