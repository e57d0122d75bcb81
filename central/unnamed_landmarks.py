"""Converts the associations of landmarks without names, and an operator's verdicts, to messages and
back.
"""

from collections.abc import Iterator
from itertools import groupby

import numpy as np

from team.estimation.association.landmark_sets import Landmarks, LocalLandmark, Verdict
from team.estimation.association.member_log import (
    KINDS,
    LAST,
    MemberRecord,
    record_of,
)
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids

STEPS = ("", *KINDS)
"""The step that associated an unnamed landmark with a set, by its number on the wire."""
DECISIONS = 100
"""Most decisions in a map, and most that wait."""
LARGEST = 1e300
SHOWN = 1 + LAST
"""Most members of a landmark in a running map; it may have as many as the run has submaps."""


def memberships_of(landmarks: Landmarks, every: bool = True) -> tuple[m.Membership, ...]:
    """The table of unnamed landmarks: member, identity, step; of each landmark all members, or its
    first and its last ones.
    """
    entries = sorted(_all(landmarks) if every else _few(landmarks))
    table = []
    for (robot, incarnation), group in groupby(entries, key=lambda entry: entry[0][:2]):
        of = list(group)
        figures = [figures for *_, figures in of]
        table.append(
            m.Membership(
                robot=robot,
                incarnation=incarnation,
                sequences=from_ids(np.array([each.sequence for each, *_ in of], np.uint32)),
                locals=from_ids(np.array([each.local for each, *_ in of], np.uint32)),
                identities=from_ids(np.array([id_ for _, id_, *_ in of], np.uint32)),
                steps=bytes(step for _, _, step, _ in of),
                figures=from_floats(np.clip(np.array(figures), -LARGEST, LARGEST)),
            )
        )
    return tuple(table)


Entry = tuple[LocalLandmark, int, int, tuple[float, float, float]]
"""A member, its identity, the index in STEPS of its step, and the figures of that."""


def _few(landmarks: Landmarks) -> Iterator[Entry]:
    for id_, members in landmarks.present.items():
        for member in (members.first, *members.last):
            yield _entry(member, id_)


def _all(landmarks: Landmarks) -> Iterator[Entry]:
    identities = landmarks.identities()
    for stream, sequence, rows in landmarks.log.all_rows():
        for row in rows.tolist():
            yield _entry(record_of(stream, sequence, row), identities[row[1]])


def _entry(member: MemberRecord, id_: int) -> Entry:
    name, tie = member
    if tie is None:
        return name, id_, 0, (0.0, 0.0, 0.0)
    return name, id_, STEPS.index(tie.kind), (tie.llr, tie.rival, tie.sd)


def decisions_of(landmarks: Landmarks) -> tuple[m.AssociationDecision, ...]:
    """The newest closures and merges, then those that wait, by their streams."""
    waits = [landmarks.waits[of] for of in sorted(landmarks.waits)][-DECISIONS:]
    return tuple(
        m.AssociationDecision(**each._asdict())
        for each in (*landmarks.decisions[-DECISIONS:], *waits)
    )


def verdict_of(judgement: m.Judgement) -> Verdict:
    """An operator's judgement as the fold's verdict."""
    first, second = (
        LocalLandmark(each.robot, each.incarnation, each.sequence, each.local)
        for each in sorted(
            (judgement.first, judgement.second),
            key=lambda x: (x.robot, x.incarnation, x.sequence, x.local),
        )
    )
    return Verdict(first, second, judgement.same)


def judgement_of(verdict: Verdict) -> m.Judgement:
    """The fold's verdict as maps name it."""
    first, second = (m.LocalLandmark(**each._asdict()) for each in verdict[:2])
    return m.Judgement(first=first, second=second, same=verdict.same)
