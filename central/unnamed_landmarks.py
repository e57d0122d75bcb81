"""Conversion of associations of unnamed landmarks, and of verdicts, to and from messages."""

from collections.abc import Iterable
from itertools import groupby

import numpy as np

from teamslam.team.estimation.association import member_log
from teamslam.team.estimation.association.landmark_sets import Landmarks, Verdict
from teamslam.team.estimation.contribution import PART
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids

STEPS = ("", *member_log.KINDS)
"""The step that merged an unnamed landmark into a set, by its number on the wire."""
DECISIONS = 100  # most accepted decisions in a map, and most deferred ones
LARGEST = 1e300  # bound of the figures of a merge on the wire, which are finite there
SHOWN = 1 + member_log.LAST  # most members of a landmark in a running map; all are in the final one


def memberships_of(landmarks: Landmarks, every: bool = True) -> tuple[m.Membership, ...]:
    """Tabulate the unnamed landmarks; every: all members, else the first and last."""
    members: Iterable[tuple[member_log.MemberRecord, int]]
    if every:
        identities = landmarks.identities()
        members = (
            (member_log.record_of(stream, sequence, row), identities[row[1]])
            for stream, sequence, rows in landmarks.log.all_rows()
            for row in rows.tolist()
        )
    else:
        members = (
            (each, id_)
            for id_, found in landmarks.present.items()
            for each in (found.first, *found.last)
        )
    entries = sorted(_make_entry(*each) for each in members)
    table = []
    for (robot, incarnation), group in groupby(entries, key=lambda entry: entry[0][:2]):
        of = list(group)
        figures = [figures for *_, figures in of]
        table.append(
            m.Membership(
                robot=robot,
                incarnation=incarnation % PART,
                sequences=from_ids(np.array([each.sequence for each, *_ in of], np.uint32)),
                locals=from_ids(np.array([each.local for each, *_ in of], np.uint32)),
                identities=from_ids(np.array([id_ for _, id_, *_ in of], np.uint32)),
                steps=bytes(step for _, _, step, _ in of),
                figures=from_floats(np.clip(np.array(figures), -LARGEST, LARGEST)),
            )
        )
    return tuple(table)


Entry = tuple[member_log.LocalLandmark, int, int, tuple[float, float, float]]
"""A member, its identity, the index of its step in STEPS, and the figures of that step."""


def _make_entry(member: member_log.MemberRecord, id_: int) -> Entry:
    name, tie = member
    if tie is None:
        return name, id_, 0, (0.0, 0.0, 0.0)
    return name, id_, STEPS.index(tie.kind), (tie.llr, tie.rival, tie.sd)


def decisions_of(landmarks: Landmarks) -> tuple[m.AssociationDecision, ...]:
    """List the newest closures and merges, then the deferred ones."""
    waits = [landmarks.waits[of] for of in sorted(landmarks.waits)][-DECISIONS:]
    return tuple(
        m.AssociationDecision(**each._asdict())
        for each in (*landmarks.decisions[-DECISIONS:], *waits)
    )


def verdict_of(judgement: m.Judgement) -> Verdict:
    """Convert an operator's judgement to the fold's verdict."""
    first, second = (
        member_log.LocalLandmark(each.robot, each.incarnation, each.sequence, each.local)
        for each in sorted(
            (judgement.first, judgement.second),
            key=lambda x: (x.robot, x.incarnation, x.sequence, x.local),
        )
    )
    return Verdict(first, second, judgement.same)


def judgement_of(verdict: Verdict) -> m.Judgement:
    """Convert the fold's verdict to the judgement of a map."""
    first, second = (
        m.LocalLandmark(**each._replace(incarnation=each.incarnation % PART)._asdict())
        for each in verdict[:2]
    )
    return m.Judgement(first=first, second=second, same=verdict.same)
