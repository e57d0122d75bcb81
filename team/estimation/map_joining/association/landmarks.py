"""The landmarks as sets of (submap, local landmark), with the evidence for each union.

A submap adds each of its unnamed landmarks as a new one, with a number derived from the submap's
name; association unites them to sets. A set has the number of its smallest member, so that its
identity lasts while members are added; a set with a named landmark has that name. Everything here
depends only on the order in which submaps are added.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from team.config import UNNAMED
from team.estimation.contribution import Contribution, Key, Stream, named

OPEN = 2**62
"""The last submap of a side that all later submaps belong to."""
MOST_DECISIONS = 400
"""Number of newest decisions that are stored."""


class LocalLandmark(NamedTuple):
    """One local landmark of one submap."""

    robot: str
    incarnation: int
    sequence: int
    local: int

    def __str__(self) -> str:
        """`r1/1/12/7`: robot, incarnation, sequence of the submap, local landmark."""
        return f"{self.robot}/{self.incarnation}/{self.sequence}/{self.local}"


class MergeRecord(NamedTuple):
    """Why the set with this number was united with another: by which step and with which figures.

    rival: the best log-likelihood ratio of a pair that excludes it.
    stamp_ns: the last end of a submap in the tick.
    """

    kind: str
    into: int
    llr: float
    rival: float
    sd: float
    stamp_ns: int


class Decision(NamedTuple):
    """A closure, or a merge of robots, that was accepted, undone or deferred.

    kind: "closure", "merge", "undone", "waits".
    about: in words, between which robots.
    why: the test that failed; empty where it was accepted.
    absent: number of landmarks that one side has where the other side observed and has none.
    rival_llr: the evidence for the best other alignment.
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
    """An operator's decision on two local landmarks: that they are one landmark, or two."""

    first: LocalLandmark
    second: LocalLandmark
    same: bool


class Opened(NamedTuple):
    """An accepted closure: its pairs by their smallest members, and its newer side.

    newer: the streams of that side, with the first and the last submap of each that belongs to it.
    """

    decision: Decision
    pairs: tuple[tuple[LocalLandmark, LocalLandmark], ...]
    newer: tuple[tuple[Stream, int, int], ...]


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The sets of unnamed landmarks.

    number: of each member, given when its submap was added.
    sets: the members of each identity, ascending.
    ties: the unions, by the number that was given up.
    waits: the last failed attempt of each stream.
    opened: the closures of the last tick.
    undone: closures that are not accepted again.
    """

    number: Mapping[LocalLandmark, int] = field(default_factory=dict)
    sets: Mapping[int, tuple[LocalLandmark, ...]] = field(default_factory=dict)
    ties: Mapping[int, MergeRecord] = field(default_factory=dict)
    decisions: tuple[Decision, ...] = ()
    waits: Mapping[tuple[Stream, Stream], Decision] = field(default_factory=dict)
    verdicts: tuple[Verdict, ...] = ()
    opened: tuple[Opened, ...] = ()
    undone: tuple[Opened, ...] = ()

    def identity(self, member: LocalLandmark) -> int | None:
        """The number of the landmark that a member belongs to; None where there is no such
        member.
        """
        number = self.number.get(member)
        while number is not None and number in self.ties:
            number = self.ties[number].into
        return number

    def decided(self, *decisions: Decision) -> "Landmarks":
        """The landmarks with further decisions, of which the newest are stored."""
        return replace(self, decisions=(*self.decisions, *decisions)[-MOST_DECISIONS:])

    def was_undone(self, pairs: Sequence[tuple[int, int]]) -> bool:
        """Whether a closure was undone that has a third or more of these pairs of identities."""
        proposed = {frozenset(pair) for pair in pairs}
        for each in self.undone:
            old = {frozenset((self.identity(one), self.identity(two))) for one, two in each.pairs}
            if 3 * len(proposed & old) >= len(proposed):
                return True
        return False


NO_LANDMARKS = Landmarks()


def members_of(contribution: Contribution) -> list[LocalLandmark | None]:
    """The member for each landmark of a submap; None for a named one."""
    of = contribution
    return [
        LocalLandmark(of.robot, of.incarnation, of.sequence, id_ - UNNAMED)
        if id_ >= UNNAMED
        else None
        for id_ in of.local.ids.tolist()
    ]


def founded(
    landmarks: Landmarks, contributions: Iterable[Contribution]
) -> tuple[Landmarks, dict[Key, list[int]]]:
    """Adds each unnamed landmark of the submaps as a set of its own; returns also the numbers, per
    submap.
    """
    numbers: dict[Key, list[int]] = {}
    number, sets = None, None
    for contribution in contributions:
        ids = contribution.local.ids
        if not len(ids) or ids[-1] < UNNAMED:
            continue
        if number is None or sets is None:
            number, sets = dict(landmarks.number), dict(landmarks.sets)
        given = []
        for id_, member in zip(ids.tolist(), members_of(contribution), strict=True):
            if member is None:
                given.append(id_)
                continue
            own = number_of(member)
            while own in sets or own in landmarks.ties:  # each number ever given is in either
                own = UNNAMED | (own + 1) % UNNAMED
            number[member] = own
            sets[own] = (member,)
            given.append(own)
        numbers[contribution.key] = given
    if number is None or sets is None:
        return landmarks, numbers
    return replace(landmarks, number=number, sets=sets), numbers


def number_of(member: LocalLandmark) -> int:
    """2³¹ | 31 bits of the BLAKE2b digest of a member's name."""
    digest = hashlib.blake2b(str(member).encode(), digest_size=4).digest()
    return UNNAMED | int.from_bytes(digest, "little") & (UNNAMED - 1)


def united(
    landmarks: Landmarks, ties: Sequence[tuple[int, MergeRecord]]
) -> tuple[Landmarks, dict[int, int]]:
    """Unites sets; returns them with the new number of each identity that was renumbered.

    ties: each identity that is united with `tie.into`. A union has the name of a named set, else
        the number of its smallest member; where that is the identity to be given up, the tie is
        recorded in the other direction.
    """
    sets, all_ties = dict(landmarks.sets), dict(landmarks.ties)
    becomes: dict[int, int] = {}

    def now(number: int) -> int:
        while number in becomes:
            number = becomes[number]
        return number

    for number, tie in ties:
        one, two = now(number), now(tie.into)
        if one == two:
            continue
        stays, goes = sorted((one, two), key=lambda each: (each >= UNNAMED, sets.get(each, ())))
        sets[stays] = tuple(sorted((*sets.get(stays, ()), *sets.pop(goes, ()))))
        becomes[goes] = stays
        all_ties[goes] = tie._replace(into=stays)
    return replace(landmarks, sets=sets, ties=all_ties), {each: now(each) for each in becomes}


def between(one: Stream, two: Stream) -> str:
    """Names the two sides of a decision, in words."""
    return named(one) if one == two else f"{named(one)} and {named(two)}"
