"""Unnamed landmarks as sets of (submap, local landmark), with the evidence for each merge.

A submap adds each of its unnamed landmarks as a set; association merges sets. A set has the number
of its smallest member, or the name of a named landmark. All of this depends only on the order in
which submaps are added.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.core import blake2b
from teamslam.team.estimation.association.member_log import (
    LocalLandmark,
    MemberLog,
    MemberRecord,
    MemberSummary,
    MergeRecord,
    record_of,
)
from teamslam.team.estimation.contribution import Contribution, Key, Stream, named

OPEN = 2**62  # last sequence number of a side that includes all later submaps
MOST_DECISIONS = 400  # newest decisions that are stored


class Decision(NamedTuple):
    """An accepted, undone or deferred closure or merge of robots.

    kind: "closure", "merge", "undone", "waits". about: the robots, in words. Figures as in
    `verification.Closure`.
    """

    stamp_ns: int
    kind: str
    about: str
    pairs: int
    llr: float
    rival_pairs: int
    rival_llr: float
    share: float
    sd: float
    why: str
    absent: int = 0


class Verdict(NamedTuple):
    """An operator's decision that two local landmarks are one, or two."""

    first: LocalLandmark
    second: LocalLandmark
    same: bool


class Opened(NamedTuple):
    """An accepted closure: its pairs by their smallest members.

    newer: streams of its newer side, each with its first and last submap.
    """

    decision: Decision
    pairs: tuple[tuple[LocalLandmark, LocalLandmark], ...]
    newer: tuple[tuple[Stream, int, int], ...]


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The sets of unnamed landmarks.

    present: members of each landmark of the map, by identity. log: all members, also of dropped
    landmarks. names: names declared to be another one. waits: last failed attempt of each stream.
    opened: closures of the last tick. undone: closures not accepted again.
    """

    present: Mapping[int, MemberSummary] = field(default_factory=dict)
    log: MemberLog = field(default_factory=MemberLog)
    names: Mapping[int, int] = field(default_factory=dict)
    decisions: tuple[Decision, ...] = ()
    waits: Mapping[tuple[Stream, Stream], Decision] = field(default_factory=dict)
    verdicts: tuple[Verdict, ...] = ()
    opened: tuple[Opened, ...] = ()
    undone: tuple[Opened, ...] = ()

    @cached_property
    def sets(self) -> Mapping[int, tuple[LocalLandmark, ...]]:
        """All members of each identity, ascending; O(members of the run)."""
        sets: dict[int, list[LocalLandmark]] = {}
        identities = self.identities()
        for stream, sequence, rows in self.log.all_rows():
            for local, number in zip(rows["local"].tolist(), rows["number"].tolist(), strict=True):
                member = LocalLandmark(*stream, sequence, local)
                sets.setdefault(identities[number], []).append(member)
        return {id_: tuple(sets[id_]) for id_ in sorted(sets)}

    def identities(self) -> Mapping[int, int]:
        """Tabulate the identity of each number ever given; O(members of the run)."""
        return {number: self._resolve_name(id_) for number, id_ in self.log.identities().items()}

    def identity(self, member: LocalLandmark) -> int | None:
        """Look up the identity of a member's landmark; None for an unknown member."""
        found = self.log.identity(member)
        return None if found is None else self._resolve_name(found)

    def judged(self) -> set[int]:
        """Return the identities that an operator has judged."""
        members = (member for verdict in self.verdicts for member in verdict[:2])
        return {id_ for member in members if (id_ := self.identity(member)) is not None}

    def _resolve_name(self, number: int) -> int:
        while number in self.names:
            number = self.names[number]
        return number

    def without(self, ids: Collection[int]) -> "Landmarks":
        """Remove landmarks that the map drops."""
        present = {id_: of for id_, of in self.present.items() if id_ not in ids}
        return replace(self, present=present)

    def restore(
        self, contributions: Iterable[Contribution]
    ) -> tuple["Landmarks", dict[Key, list[int]]]:
        """Restore the dropped landmarks of these submaps; return also the present identities of
        each submap's landmarks.
        """
        identities, numbers = self.identities(), {}
        back: dict[int, MemberSummary] = {}
        for each in contributions:
            found = each.local.ids.tolist()
            at = len(found)
            for row in reversed(self.log.rows(each.stream, each.sequence).tolist()):
                at -= 1
                id_ = found[at] = identities[row[1]]
                if id_ not in self.present:
                    one = MemberSummary(1, record_of(each.stream, each.sequence, row))
                    back[id_] = back[id_].merge(one) if id_ in back else one
            numbers[each.key] = found
        return replace(self, present={**self.present, **back}), numbers

    def add_decisions(self, *decisions: Decision) -> "Landmarks":
        """Add decisions; the newest are stored."""
        return replace(self, decisions=(*self.decisions, *decisions)[-MOST_DECISIONS:])

    def was_undone(self, pairs: Sequence[tuple[int, int]]) -> bool:
        """Return whether a closure with a third or more of these pairs was undone."""
        proposed = {frozenset(pair) for pair in pairs}
        for each in self.undone:
            old = {frozenset((self.identity(one), self.identity(two))) for one, two in each.pairs}
            if 3 * len(proposed & old) >= len(proposed):
                return True
        return False


NO_LANDMARKS = Landmarks()


def add_landmarks(
    landmarks: Landmarks, contributions: Sequence[Contribution]
) -> tuple[Landmarks, dict[Key, list[int]]]:
    """Add each unnamed landmark of the submaps as a set; return also the numbers by submap."""
    present, log = dict(landmarks.present), landmarks.log
    numbers: dict[Key, list[int]] = {}
    for each in contributions:
        ids = each.local.ids.tolist()  # ascending: those with a name come first
        members = [
            LocalLandmark(*each.stream, each.sequence, id_ - UNNAMED)
            for id_ in ids
            if id_ >= UNNAMED
        ]
        if not members:
            continue
        own = _choose_numbers(log, members)
        log = log.add_submap(each.stream, each.sequence, [one.local for one in members], own)
        for number, member in zip(own, members, strict=True):
            present[number] = MemberSummary(1, MemberRecord(member))
        numbers[each.key] = [*ids[: -len(own)], *own]
    return (replace(landmarks, present=present, log=log), numbers) if numbers else (landmarks, {})


def _choose_numbers(log: MemberLog, members: Sequence[LocalLandmark]) -> list[int]:
    numbers = [number_of(each) for each in members]
    if len(set(numbers)) == len(numbers) and not log.mark_given(np.array(numbers, np.uint32)).any():
        return numbers
    used = set[int]()
    for k, own in enumerate(numbers):
        while own in used or log.mark_given(np.array([own], np.uint32))[0]:
            own = UNNAMED | (own + 1) % UNNAMED
        used.add(own)
        numbers[k] = own
    return numbers


def number_of(member: LocalLandmark) -> int:
    """Hash a member's name: 2³¹ | 31 bits of its BLAKE2b digest."""
    digest = blake2b(str(member).encode(), 4)
    return UNNAMED | int.from_bytes(digest, "little") & (UNNAMED - 1)


def merge_sets(
    landmarks: Landmarks, ties: Sequence[tuple[int, MergeRecord]]
) -> tuple[Landmarks, dict[int, int]]:
    """Merge sets; return also the new number of each renumbered identity.

    ties: each identity to merge with `tie.into`. The result has the name of a named set, else the
    number of its smallest member; a tie in the other direction is reversed.
    """
    present, log, names = dict(landmarks.present), landmarks.log, dict(landmarks.names)
    becomes: dict[int, int] = {}

    def resolve(number: int) -> int:
        while number in becomes:
            number = becomes[number]
        return number

    def order(number: int) -> tuple[bool, tuple[LocalLandmark, ...]]:
        return number >= UNNAMED, (present[number].first.name,) if number in present else ()

    for number, tie in ties:
        one, two = resolve(number), resolve(tie.into)
        if one == two:
            continue
        stays, goes = sorted((one, two), key=order)
        tie = tie._replace(into=stays)
        left = present.pop(goes, None)
        if goes < UNNAMED:
            names[goes] = stays
        elif left is not None:
            into = present[stays].first.name if stays >= UNNAMED else None
            log = log.record_merge(left.first.name, tie, into)
            left = left._replace(first=left.first._replace(tie=tie))
        if left is not None:
            present[stays] = present[stays].merge(left) if stays in present else left
        becomes[goes] = stays
    after = replace(landmarks, present=present, log=log, names=names)
    return after, {each: resolve(each) for each in becomes}


def name_sides(one: Stream, two: Stream) -> str:
    """Name the two sides of a decision."""
    return named(one) if one == two else f"{named(one)} and {named(two)}"
