"""Select the robots that need a prior, since it has news from teammates (moved landmarks,
inter-robot measurements) or landmarks nearby.

A robot outside the team's map gets the landmarks alone, as if at the origin, or one message that
withdraws its earlier priors, also from a restarted centre.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from teamslam.team import core
from teamslam.team.estimation.contribution import Stream
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.shapes import Float, Int64, UInt32

EVERY = 8  # most broadcasts between two priors
NEEDED = 12  # number of landmarks nearest to a robot, which it will see next
MOVED = 0.1
"""Least root mean square of the landmarks' movements for a new prior, in standard deviations."""
SURER = 0.8  # share to which a landmark's variance must have fallen for a new prior
NEVER = -1  # stamp of no inter-robot measurement, before all team time


@dataclass(frozen=True)
class _Sent:
    """A robot's last prior, and the map that it was made of.

    encounter_ns: of the newest inter-robot measurement of or by the robot. since: later broadcasts.
    alone: without a pose.
    """

    blocks: marginals.LandmarkBlocks
    ids: UInt32[np.ndarray, " L"]
    encounter_ns: int
    since: int
    frame: Stream | None = None
    alone: bool = False


def in_main_island(fold: Fold, stream: Stream) -> bool:
    """Whether the newest part of the stream is in the team's map."""
    return fold.main_key is not None and fold.home.get(fold.latest_part(stream)) == fold.main_key


class SentPriors:
    """The last prior of each stream; depends on the broadcasts, not on the set alone."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._sent: dict[Stream, _Sent | None] = {}  # None: the stream's priors are withdrawn

    def select_worth(
        self,
        fold: Fold,
        streams: Sequence[Stream],
        shown: Sequence[int],
        alone: Collection[Stream] = (),
    ) -> list[Stream]:
        """Select the streams to which to send a prior of this fold, or of landmarks `alone`.

        Others outside the team's map are selected once, to withdraw theirs.
        """
        inside = [each for each in streams if each in alone or in_main_island(fold, each)]
        out = self._withdrawn({*streams} - {*inside})
        if not inside:
            return out
        blocks, newest = marginals.landmark_blocks(fold, shown), _newest_encounters(fold)
        return out + [
            each
            for each in inside
            if self.is_worth(
                each,
                None if each in alone else marginals.last_pose(fold, fold.latest_part(each)),
                blocks,
                newest.get(each[0], NEVER),
                fold.frame,
            )
        ]

    def select_void(self, fold: Fold, streams: Sequence[Stream]) -> list[Stream]:
        """Select the streams outside the final map, or of a prior in another frame."""
        outside = []
        for stream in streams:
            old = self._sent.get(stream)
            is_in_another_frame = old is not None and old.frame != fold.frame
            if is_in_another_frame or not in_main_island(fold, stream):
                outside.append(stream)
        return self._withdrawn(outside)

    def _withdrawn(self, streams: Iterable[Stream]) -> list[Stream]:
        new = [s for s in sorted(streams) if s not in self._sent or self._sent[s] is not None]
        self._sent |= dict.fromkeys(new)
        return new

    def is_worth(
        self,
        stream: Stream,
        pose: Float[np.ndarray, "3"] | None,
        blocks: marginals.LandmarkBlocks,
        encounter_ns: int = NEVER,
        frame: Stream | None = None,
    ) -> bool:
        """Whether to send a prior at this pose (None: of landmarks alone); if so, note it."""
        x, y = (blocks.means if pose is None else blocks.means - pose[:2]).T
        nearest = (x * x + y * y).argsort(kind="stable")
        old = self._sent.get(stream)
        if (
            old is None
            or old.since + 1 >= EVERY
            or (old.frame, old.alone) != (frame, pose is None)
            or encounter_ns > old.encounter_ns
            or _has_changed(old, blocks, nearest[:NEEDED])
        ):
            ids = np.sort(blocks.ids[nearest[: self._most]])
            self._sent[stream] = _Sent(blocks, ids, encounter_ns, 0, frame, pose is None)
            return True
        self._sent[stream] = replace(old, since=old.since + 1)
        return False


def _newest_encounters(fold: Fold) -> dict[str, int]:
    newest: dict[str, int] = {}
    for encounter in fold.main.graph.sightings:
        seen = encounter.sighting
        for robot in (seen.robot, seen.teammate):
            newest[robot] = max(newest.get(robot, NEVER), seen.stamp_ns)
    return newest


def _has_changed(
    old: _Sent, now: marginals.LandmarkBlocks, needed: Int64[np.ndarray, " k"]
) -> bool:
    ids = now.ids[needed]
    if not len(needed):
        return False
    at = old.ids.searchsorted(ids)
    if at.max() == len(old.ids) or (old.ids[at] != ids).any():
        return True
    before = old.blocks.ids.searchsorted(ids)
    x, y = (now.means[needed] - old.blocks.means[before]).T
    variances, were = (
        each[:, 0, 0] + each[:, 1, 1]
        for each in (now.covariances[needed], old.blocks.covariances[before])
    )
    share = 2.0 * (x * x + y * y) / variances
    return bool(share.sum() / len(share) > core.squared(MOVED) or (variances < SURER * were).any())
