"""Parts of smoothed paths that are left out, where a robot was carried off.

A window in which a robot was carried off is bent between its ends. Detections may be missing
between the jump and the window's end, so the window beside it may be bent, too. Both are left out,
with the pose between them. Where the fold cut the stream (`map_joining.tick`), the path ends at
the seam.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from teamslam.team.estimation.contribution import moment
from teamslam.team.shapes import Bool, Int64
from teamslam.team.wire import messages as m

Span = tuple[int, int]  # stamps [ns] between which the poses are left out; those at its ends stay
ALWAYS: Span = (np.iinfo(np.int64).min, np.iinfo(np.int64).max)


def spans_left_out(
    found: Iterable[m.Diagnosis], robot: str, ends_ns: Sequence[int]
) -> tuple[Span, ...]:
    """Find the spans of a robot's path that its jumps spoil; ends_ns: ends of its submaps."""
    jumps = (
        each.at_ns
        for each in found
        if each.cause == "carried_off" and each.robot == robot and not each.place
    )
    return tuple(
        (
            max((end for end in ends_ns if end < at_ns), default=ALWAYS[0]),
            min((end for end in ends_ns if end > at_ns), default=ALWAYS[1]),
        )
        for at_ns in sorted(jumps)
    )


def is_kept(stamps_ns: Int64[np.ndarray, " K"], spans: Sequence[Span]) -> Bool[np.ndarray, " K"]:
    """Whether each stamp is outside all spans."""
    kept = np.ones(len(stamps_ns), np.bool_)
    for begin, end in spans:
        kept &= (stamps_ns <= begin) | (stamps_ns >= end)
    return kept


def describe_spans(robot: str, spans: Iterable[Span]) -> list[str]:
    """Describe the parts of a robot's path that are left out."""
    notes = []
    for begin, end in spans:
        part = f" from {moment(begin)}" if begin != ALWAYS[0] else ""
        part += f" to {moment(end)}" if end != ALWAYS[1] else ""
        why = "it was carried off or slipped there"
        why += ", or its initial pose is wrong" if begin == ALWAYS[0] else ""
        notes.append(f"{robot}'s path{part} is left out: {why}")
    return notes
