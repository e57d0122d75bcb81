"""Parts of streams cut at seams (`continuity`), each a stream of its own in the fold.

The later part has no initial pose; a submap inside which the robot was carried off is refused.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.contribution import Contribution, Stream, part_of
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.continuity import Seam
from teamslam.team.estimation.map_joining.joining import Tick

SPOILT = "the robot was carried off or slipped in it"

Member = TypeVar("Member", Contribution, InterRobotFactor)


def cut_tick(tick: Tick, cuts: Sequence[Seam]) -> Tick:
    """Assign the members of a tick to the parts of cut streams; refuse spoilt submaps."""
    submaps = cut_members(tick.contributions, cuts)
    spoilt = {each.key: SPOILT for each in submaps if _is_spoilt(each, cuts)}
    return replace(
        tick,
        contributions=submaps,
        sightings=cut_members(tick.sightings, cuts),
        outside={**tick.outside, **spoilt},
        verdicts=tuple(_cut_verdict(each, cuts) for each in tick.verdicts),
    )


def cut_members(members: Sequence[Member], cuts: Sequence[Seam]) -> list[Member]:
    """Assign submaps or inter-robot measurements to the parts of cut streams."""
    parts = [find_part(each.stream, each.sequence, cuts) for each in members]
    return [
        each if part == each.stream else replace(each, incarnation=part[1])
        for each, part in zip(members, parts, strict=True)
    ]


def find_part(stream: Stream, sequence: int, cuts: Sequence[Seam]) -> Stream:
    """Find the part of a stream that contains a submap."""
    for cut in cuts:
        if cut.stream == stream and sequence >= cut.after:
            stream = part_of(stream, cut.after)
    return stream


def _is_spoilt(submap: Contribution, cuts: Sequence[Seam]) -> bool:
    return any(cut.stream == submap.stream and submap.sequence > cut.before for cut in cuts)


def _cut_verdict(verdict: Verdict, cuts: Sequence[Seam]) -> Verdict:
    def cut(each: LocalLandmark) -> LocalLandmark:
        return LocalLandmark(*find_part(each[:2], each.sequence, cuts), *each[2:])

    return verdict._replace(first=cut(verdict.first), second=cut(verdict.second))
