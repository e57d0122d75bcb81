"""Converts the associations of landmarks without names, and an operator's verdicts, to messages and
back.
"""

import numpy as np

from team.estimation.map_joining.association.landmarks import Landmarks, LocalLandmark, Verdict
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids

STEPS = ("", "track", "near", "sweep", "closure", "merge", "verdict")
"""The step that associated an unnamed landmark with a set, by its number on the wire."""
DECISIONS = 100
"""Most decisions in a map, and most that wait."""
LARGEST = 1e300
SHOWN = 12
"""Most members of a landmark in a running map; it may have as many as the run has submaps."""


def memberships_of(landmarks: Landmarks, most: int | None = None) -> tuple[m.Membership, ...]:
    """The table of unnamed landmarks: member, identity, step; of each landmark at most so many
    members, its first and its last ones.
    """
    streams: dict[tuple[str, int], list[LocalLandmark]] = {}
    named = landmarks.number if most is None else _few(landmarks, most)
    for member in sorted(named):
        streams.setdefault((member.robot, member.incarnation), []).append(member)
    table = []
    for (robot, incarnation), members in streams.items():
        ties = [landmarks.ties.get(landmarks.number[member]) for member in members]
        figures = [(0.0, 0.0, 0.0) if t is None else (t.llr, t.rival, t.sd) for t in ties]
        table.append(
            m.Membership(
                robot=robot,
                incarnation=incarnation,
                sequences=from_ids(np.array([x.sequence for x in members], np.uint32)),
                locals=from_ids(np.array([x.local for x in members], np.uint32)),
                identities=from_ids(
                    np.array([landmarks.identity(x) or 0 for x in members], np.uint32)
                ),
                steps=bytes(0 if t is None else STEPS.index(t.kind) for t in ties),
                figures=from_floats(np.clip(np.array(figures), -LARGEST, LARGEST)),
            )
        )
    return tuple(table)


def _few(landmarks: Landmarks, most: int) -> list[LocalLandmark]:
    """The first and the last members of each landmark, `most` in all."""
    return [
        member
        for members in landmarks.sets.values()
        for member in (*members[:1], *members[1:][1 - most :])
    ]


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
