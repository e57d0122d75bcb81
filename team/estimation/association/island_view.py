"""The landmarks of one island as a joint Gaussian, and the steps that merge them in a tick.

The steps: *track* against the last submaps of the same robot; *near*, landmarks of older submaps
with a small standard deviation of the difference; *sweep*, landmarks that were split.

Unmerged fragments of one landmark are candidates for each other, and assignments to all of them at
once do not agree on any. A submap's landmarks are therefore assigned to those of one other submap
at a time, with landmarks certainly different from these.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.association import AssociationProfile
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.gating import (
    Classes,
    Indices,
    Joint,
    LandmarkDensity,
    Pair,
    list_pairs,
    stack_classes,
)
from teamslam.team.estimation.association.joint_compatibility import (
    MOST_ASSIGNED,
    MergedPairs,
    assign_jointly,
    grow_pairs,
)
from teamslam.team.estimation.association.landmark_sets import Landmarks
from teamslam.team.estimation.association.member_log import LocalLandmark, MergeRecord
from teamslam.team.estimation.association.visibility import mark_missed, miss_probabilities
from teamslam.team.estimation.contribution import Observation, Stream, is_map
from teamslam.team.shapes import Bool, Float, Int64

COMPARED = 6  # most submaps that one submap is compared with: those with the most candidates
REEXAMINED = 8
"""Older undecided submaps that a tick examines again: the newest half, others by turns."""
REEXAMINED_WITHIN = 10.0
"""Distance [object radii] to undecided landmarks within which a submap is examined again."""


class ViewedSubmap(NamedTuple):
    """A submap, and the index of each of its landmarks in the view; −1 for a dropped landmark."""

    observation: Observation
    landmarks: Indices

    @property
    def known(self) -> Indices:
        """Indices of its landmarks without dropped ones."""
        return self.landmarks[self.landmarks >= 0]

    @property
    def unnamed_rows(self) -> Indices:
        """Index of each unnamed landmark, in the submap's order; −1 for a dropped one."""
        return self.landmarks[self.observation.ids >= UNNAMED]

    @property
    def unnamed(self) -> Indices:
        """Indices of its unnamed landmarks, ascending."""
        found = self.unnamed_rows
        places: Indices = np.unique(found[found >= 0])
        return places

    @property
    def views(self) -> list[Indices]:
        """Indices of the unnamed landmarks that each keyframe observed together."""
        found = self.unnamed_rows
        views = (found[each] for each in self.observation.unnamed.views)
        return [view[view >= 0] for view in views]


class IslandView:
    """An island's landmarks as a joint Gaussian, with the merges so far.

    ids: identity of each landmark; place_of: its index. seen_by: landmarks of each submap. missed:
    probably false landmarks (`mark_missed`), left out of closures. saved: landmarks of saved maps.
    sees: landmarks of each submap, updated by merges. merged: landmarks merged into another. ties:
    the merges. stamp_ns: last end of a submap.
    """

    def __init__(
        self,
        ids: Sequence[int],
        mean: Float[np.ndarray, "n 2"],
        covariance: Float[np.ndarray, "m m"],
        submaps: Sequence[ViewedSubmap],
        forgotten: tuple[Int64[np.ndarray, "P 2"], Bool[np.ndarray, " P"]],
        landmarks: Landmarks,
        profile: AssociationProfile,
        stamp_ns: int,
    ) -> None:
        """View the landmarks with this mean [m] and covariance [m²].

        forgotten: pairs of landmarks of one submap not among `submaps`, and whether one keyframe
        observed both.
        """
        count = len(ids)
        self.ids = ids
        self.place_of = {id_: at for at, id_ in enumerate(ids)}
        self.submaps = submaps
        self.seen_by = [each.known for each in submaps]
        self.merged = np.zeros(count, np.bool_)
        self.sees = np.zeros((len(submaps), count), np.bool_)
        for row, places in zip(self.sees, self.seen_by, strict=True):
            row[places] = True
        self.missed = mark_missed(self.sees)
        is_saved = [is_map(each.observation.stream) for each in submaps]
        self.saved = join_indices(
            places for places, saved in zip(self.seen_by, is_saved, strict=True) if saved
        )
        self._merged_into = np.arange(count)
        self._landmarks = landmarks
        self.ties: list[tuple[int, MergeRecord]] = []
        self.stamp_ns = stamp_ns
        confirmed = mean[self.sees.sum(axis=0) > 1]
        density = LandmarkDensity((each.observation.spacings for each in submaps), confirmed)
        self.profile = density.limit_lengths(profile)
        pairs, distinct = forgotten
        self.joint = Joint(
            mean,
            covariance,
            self._mark_apart(pairs[distinct]),
            self.profile,
            density,
            miss_probabilities(mean, self.seen_by, self.profile.same),
            self._mark_apart_in_window(pairs),
            self._sum_classes(),
        )

    def _sum_classes(self) -> Classes | None:
        rows = [(len(s.unnamed_rows), s.observation.unnamed.classes) for s in self.submaps]
        stacked = stack_classes(rows)
        if stacked is None:
            return None
        at = np.concatenate([each.unnamed_rows for each in self.submaps])
        classes = np.zeros((len(self.ids), stacked.shape[1]))
        np.add.at(classes, at[at >= 0], stacked[at >= 0])
        return classes

    def _mark_apart(self, forgotten: Int64[np.ndarray, "_ 2"]) -> Bool[np.ndarray, "n n"]:
        named = np.array(self.ids) < UNNAMED
        apart = named[:, None] & named[None, :]
        for submap in self.submaps:
            known = submap.landmarks >= 0
            places = submap.landmarks[known]
            one, two = np.nonzero(submap.observation.distinct[known][:, known])
            apart[places[one], places[two]] = True
        for here, there, same in self.list_judged(self):
            if not same:
                apart[here, there] = apart[there, here] = True
        np.fill_diagonal(apart, False)
        one, two = forgotten.T
        apart[one, two] = apart[two, one] = True
        return apart

    def _mark_apart_in_window(self, forgotten: Int64[np.ndarray, "_ 2"]) -> Bool[np.ndarray, "n n"]:
        of = self.sees.astype(np.float32)
        apart = np.asarray(of.T @ of > 0.0)  # exact: sums of ones
        first, second = forgotten.T
        apart[first, second] = apart[second, first] = True
        np.fill_diagonal(apart, False)
        return apart

    def find_place(self, member: LocalLandmark) -> int | None:
        """Find the index of the landmark that a submap's landmark is part of."""
        identity = self._landmarks.identity(member)
        return None if identity is None else self.place_of.get(identity)

    def find_latest(self, stream: Stream, last: int) -> list[int]:
        """Find the stream's last `recent` submaps up to the sequence number `last`."""
        first = last - self.profile.recent
        return [
            k
            for k, each in enumerate(self.submaps)
            if each.observation.stream == stream and first < each.observation.sequence <= last
        ]

    def record_merges(self, found: MergedPairs, kind: str) -> None:
        """Record the pairs merged by a step (`kind`), and the joint Gaussian given them."""
        self.joint = found.joint
        for pair in found.pairs:
            tie = MergeRecord(
                kind, self.ids[pair.second], pair.llr, pair.rival, pair.sd, self.stamp_ns
            )
            self.ties.append((self.ids[pair.first], tie))
            self.merged[pair.first] = True
            self._merged_into[self._merged_into == pair.first] = pair.second
            self.sees[:, pair.second] |= self.sees[:, pair.first]
            self.sees[:, pair.first] = False

    def _resolve(self, places: Indices) -> Indices:
        return np.unique(self._merged_into[places])

    def list_judged(self, other: "IslandView") -> list[tuple[int, int, bool]]:
        """List the verdicts on a landmark of this view and one of another, by index."""
        return [
            (here, there, each.same)
            for each in self._landmarks.verdicts
            if (here := self.find_place(each.first)) is not None
            and (there := other.find_place(each.second)) is not None
        ]

    def find_declared(self, other: "IslandView") -> set[tuple[int, int]]:
        """Find the landmarks of two islands, by index, that an operator declared to be one and not
        two.
        """
        judged = self.list_judged(other)
        judged += [(there, here, same) for here, there, same in other.list_judged(self)]
        two = {(here, there) for here, there, same in judged if not same}
        return {(here, there) for here, there, same in judged if same} - two

    def apply_verdicts(self) -> None:
        """Merge the landmarks that an operator declared to be one, unless another verdict forbids
        it.
        """
        declared = self.list_judged(self)
        into = self._merged_into
        for first, second, same in declared:
            one, two = int(into[first]), int(into[second])
            apart = ({int(into[a]), int(into[b])} for a, b, one_ in declared if not one_)
            if not same or one == two or {one, two} in apart:
                continue
            pair = Pair(one, two, np.inf, 0.0, -np.inf)
            self.record_merges(MergedPairs((pair,), self.joint.condition(one, two)), "verdict")

    def track(self, k: int) -> None:
        """Merge landmarks of submap k with the same robot's earlier ones, then with all nearby
        ones.
        """
        of = self.submaps[k].observation
        fresh = self.submaps[k].unnamed
        before = self.find_latest(of.stream, of.sequence - 1)
        self.grow("track", fresh, join_indices(self.seen_by[at] for at in before), np.inf)
        others = np.setdiff1d(np.arange(len(self.ids)), self.seen_by[k])
        self.compare(k)
        self.grow("near", fresh, others, self.profile.near)

    def grow(self, kind: str, first: Indices, second: Indices, most_sd: float) -> None:
        """Merge pairs of two lists of landmarks, the most certain pair first."""
        first, second = first[~self.merged[first]], second[~self.merged[second]]
        if not len(first) or not len(second):
            return
        pairs = list_pairs(first, second)
        found = grow_pairs(self.joint, pairs, most_sd=most_sd, sure_sd=self.profile.near)
        self.record_merges(found, kind)

    def compare(self, k: int) -> None:
        """Merge pairs of submap k with each other submap on which all likely assignments agree."""
        own = self._resolve(self.submaps[k].unnamed)
        others = self.sees.copy()
        others[k] = False
        near = self.profile.near
        for nearby in select_comparisons(self.joint, own, others, near):
            pairs = list_pairs(own[~self.merged[own]], self._resolve(nearby))
            self.record_merges(assign_jointly(self.joint, *pairs, near), "near")

    def compare_again(self, fresh: Sequence[int], turn: int) -> None:
        """Compare older undecided submaps near the tick's (`fresh`).

        turn: selects among many such submaps.
        """
        near = np.flatnonzero(self.sees[fresh].any(axis=0))
        if not len(near):
            return
        mean = self.joint.mean
        away = np.abs(mean[:, None] - mean[near][None]).max(axis=2).min(axis=1)
        around = np.flatnonzero((away < REEXAMINED_WITHIN * self.profile.same) & ~self.merged)
        undecided = np.zeros(len(self.ids), np.bool_)
        undecided[find_undecided(self.joint, around)] = True
        found = np.setdiff1d(np.flatnonzero(self.sees[:, undecided].any(axis=1)), fresh)
        for k in select_by_turns(found.tolist(), turn):
            self.compare(k)

    def sweep(self) -> None:
        """Merge landmarks at one place, never observed together, on which all likely assignments
        agree.

        Merged pair by pair, each the likeliest by itself, they can turn a robot by a spacing.
        """
        at = np.flatnonzero(~self.merged)
        mean = self.joint.mean[at]
        away = np.abs(mean[:, None] - mean[None]).max(axis=2)
        later, earlier = np.nonzero(np.tril(away < self.profile.same, -1))
        one, two = at[later], at[earlier]
        x, y = (self.joint.mean[one] - self.joint.mean[two]).T
        close = core.hypot(x, y) < self.profile.same
        one, two, _ = self.joint.gate(one[close], two[close], self.profile.tight)
        split = np.unique(one)
        for begin in range(0, len(split), MOST_ASSIGNED):
            own = np.isin(one, split[begin : begin + MOST_ASSIGNED]) & ~self.merged[two]
            found = assign_jointly(self.joint, one[own], two[own], self.profile.tight)
            self.record_merges(found, "sweep")


def join_indices(of: Iterable[Indices]) -> Int64[np.ndarray, " _"]:
    """Join lists of indices, ascending."""
    places: Int64[np.ndarray, " _"] = np.unique(np.concatenate([np.zeros(0, np.int64), *of]))
    return places


def select_comparisons(
    joint: Joint, own: Indices, sees: Bool[np.ndarray, "K n"], most_sd: float
) -> list[Indices]:
    """Select the landmarks that `own` may be, for each submap worth a comparison.

    These are the submap's and the rivals that it lacks, without which a missed landmark would be
    associated with its neighbour. sees: landmarks of each submap. most_sd: largest standard
    deviation of a pair's difference.
    """
    others = np.setdiff1d(np.flatnonzero(sees.any(axis=0)), own)
    one, two, _ = joint.gate(*list_pairs(own, others), most_sd)
    if not len(one):
        return []
    fits = np.zeros((len(own), len(joint.mean)), np.bool_)
    fits[np.searchsorted(own, one), two] = True
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


def find_undecided(joint: Joint, around: Indices) -> Indices:
    """Find the landmarks that may be one with another of them."""
    one, two = (around[each] for each in np.triu_indices(len(around), 1))
    one, two, _ = joint.gate(one, two, joint.profile.near)
    return np.unique(np.concatenate([one, two]))


def select_by_turns(submaps: Sequence[int], turn: int) -> list[int]:
    """Select the newest REEXAMINED / 2 of these submaps, and as many older ones by turns."""
    half = REEXAMINED // 2
    if len(submaps) <= REEXAMINED:
        return list(submaps)
    older = submaps[:-half]
    step = len(older) // half
    chosen = {older[(turn + k * step) % len(older)] for k in range(half)}
    return [*sorted(chosen), *submaps[-half:]]
