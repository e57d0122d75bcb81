"""Add the members of a tick to a fold; refuse those that allow no solution, with a reason.

If a tick as a whole has no solution, its members are added in canonical order without those that
make the normal equations unsolvable. A refused submap is reduced to its motion; where that fails
too, the robot's chain ends. An unsolvable initial pose becomes unknown; an inter-robot measurement
is left out.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from teamslam.team.estimation.contribution import (
    Contribution,
    InitialPoseFactor,
    Key,
    Stream,
    named,
)
from teamslam.team.estimation.gaussian import UNSOLVABLE
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.fold_association import associate_tick
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, is_solvable
from teamslam.team.estimation.map_joining.joining import Fold, Tick, add_start, fold_submaps

T = TypeVar("T")


def add_members(fold: Fold, tick: Tick, settings: JoinSettings) -> Fold:
    """Add the tick's members; record exceptions in `refused`, `motion_only`, `left_out`,
    `set_aside`.
    """
    fold = replace(fold, set_aside=(*fold.set_aside, *tick.set_aside))
    fold, members = _select_reachable(fold, tick.contributions, tick.outside)
    streams = {each.stream for each in members}
    starts = [start for start in tick.starts if start.stream in streams]
    sightings = _of_members(tick.sightings, fold)
    whole = _attempt(fold, members, starts, sightings, settings)
    if whole is not None:
        return whole
    selection = _Selection(fold, settings, {start.stream: start for start in starts})
    return selection.add_solvable(members, sightings)


def describe_refusals(fold: Fold) -> list[str]:
    """Describe where each chain ended and how many submaps follow, then other refusals."""
    ended: dict[Stream, list[int]] = {}
    for _, robot, incarnation, sequence in fold.refused:
        ended.setdefault((robot, incarnation), []).append(sequence)
    words = []
    for stream in sorted(ended):
        first, behind = min(ended[stream]), len(ended[stream]) - 1
        why = next(w for k, w in fold.refused.items() if (*k[1:3], k[3]) == (*stream, first))
        tail = f"; the {behind} behind it are not in the map either" if behind else ""
        words.append(f"submap {first} of {named(stream)} refused: {why}{tail}")
    return [*words, *fold.set_aside]


def _select_reachable(
    fold: Fold, contributions: Sequence[Contribution], outside: Mapping[Key, str]
) -> tuple[Fold, list[Contribution]]:
    refused = dict(fold.refused)
    ended = {(robot, incarnation) for _, robot, incarnation, _ in refused}
    members = []
    for each in contributions:
        why = "the chain ended before it" if each.stream in ended else outside.get(each.key)
        if why is None:
            members.append(each)
        else:
            refused[each.key] = why
            ended.add(each.stream)
    return replace(fold, refused=refused), members


def _of_members(sightings: Iterable[InterRobotFactor], fold: Fold) -> list[InterRobotFactor]:
    gone = {key[1:] for key in fold.refused}
    return [each for each in sightings if (*each.stream, each.sequence) not in gone]


def _attempt(
    fold: Fold,
    members: Sequence[Contribution],
    starts: Iterable[InitialPoseFactor],
    sightings: Sequence[InterRobotFactor],
    settings: JoinSettings,
) -> Fold | None:
    for start in starts:
        fold = add_start(fold, start)
    try:
        with np.errstate(all="ignore"):
            after = fold_submaps(fold, members, settings, sightings)
            if after.has_unnamed:
                after = associate_tick(after, members)
    except UNSOLVABLE:
        return None
    changed = (
        island
        for key, island in after.islands.items()
        if key not in fold.islands or island.state is not fold.islands[key].state
    )
    return after if all(is_solvable(island) for island in changed) else None


class _Selection:
    """Selection of a tick's solvable members, one by one in canonical order."""

    def __init__(
        self, fold: Fold, settings: JoinSettings, starts: Mapping[Stream, InitialPoseFactor]
    ) -> None:
        self._fold = fold
        self._settings = settings
        self._starts = dict(starts)
        self._members: list[Contribution] = []
        self._refused = dict(fold.refused)
        self._motion_only = set(fold.motion_only)
        self._set_aside = list(fold.set_aside)

    def add_solvable(
        self, members: Sequence[Contribution], sightings: Sequence[InterRobotFactor]
    ) -> Fold:
        unseen = replace(self._fold, waiting=())
        self._grow(unseen, members)
        base = replace(
            unseen,
            refused=dict(sorted(self._refused.items())),
            motion_only=frozenset(self._motion_only),
        )
        waiting = [*self._fold.waiting, *_of_members(sightings, base)]
        candidates = sorted(waiting, key=lambda each: each.key)

        def after(some: Sequence[InterRobotFactor]) -> Fold | None:
            return _attempt(base, self._members, self._of(self._members), some, self._settings)

        accepted, bad = _select_greatest(candidates, lambda some: after(some) is not None)
        self._set_aside += [
            f"an inter-robot measurement of {each.teammate} by {named(each.stream)} at "
            f"{each.stamp_ns * 1e-9:.1f} s refused: with it the map has no solution"
            for each in bad
        ]
        found = after(accepted)
        if found is None:  # none of the members: the fold as it was, with its measurements
            found = replace(base, waiting=tuple(accepted))
        left_out = self._fold.left_out.union(each.key for each in bad)
        return replace(found, left_out=left_out, set_aside=tuple(self._set_aside))

    def _of(self, members: Sequence[Contribution]) -> list[InitialPoseFactor]:
        streams = {each.stream for each in members}
        return [start for stream, start in self._starts.items() if stream in streams]

    def _solves(self, fold: Fold, members: Sequence[Contribution]) -> bool:
        return _attempt(fold, members, self._of(members), (), self._settings) is not None

    def _grow(self, fold: Fold, block: Sequence[Contribution]) -> None:
        """Add a block of submaps, or its halves, or refuse a single submap."""
        ended = {(robot, incarnation) for _, robot, incarnation, _ in self._refused}
        for each in block:
            if each.stream in ended:
                self._refused[each.key] = "the chain ended before it"
        block = [each for each in block if each.stream not in ended]
        if not block:
            return
        if self._solves(fold, [*self._members, *block]):
            self._members += block
        elif len(block) > 1:
            half = len(block) // 2
            self._grow(fold, block[:half])
            self._grow(fold, block[half:])
        else:
            self._grow_by_less(fold, block[0])

    def _grow_by_less(self, fold: Fold, whole: Contribution) -> None:
        """Add a submap without its initial pose, its motion alone, or none."""
        start = self._starts.pop(whole.stream, None) if whole.sequence == 0 else None
        if start is not None and self._solves(fold, [*self._members, whole]):
            self._members.append(whole)
            self._set_aside.append(
                f"the initial pose of {named(whole.stream)} refused, taken as unknown: "
                "with it the map has no solution"
            )
            return
        if start is not None:
            self._starts[whole.stream] = start
        motion = replace(whole, local=whole.local.motion)
        if self._solves(fold, [*self._members, motion]):
            self._members.append(motion)
            self._motion_only.add(whole.key)
            self._set_aside.append(
                f"of submap {whole.sequence} of {named(whole.stream)} only the motion is in the "
                "map: with its landmarks it has no solution"
            )
            return
        self._refused[whole.key] = "with it the map has no solution"


def _select_greatest(
    items: Sequence[T], works: Callable[[Sequence[T]], bool]
) -> tuple[list[T], list[T]]:
    accepted: list[T] = []
    bad: list[T] = []

    def add(block: Sequence[T]) -> None:
        if not block or works([*accepted, *block]):
            accepted.extend(block)
        elif len(block) == 1:
            bad.extend(block)
        else:
            half = len(block) // 2
            add(block[:half])
            add(block[half:])

    add(items)
    return accepted, bad
