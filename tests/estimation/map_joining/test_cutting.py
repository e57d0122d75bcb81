"""Parts of cut streams: names, members, verdicts, and submaps that a seam has spoilt."""

import numpy as np

from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.contribution import (
    Contribution,
    first_of,
    named,
    part_of,
    whole_of,
)
from teamslam.team.estimation.map_joining.continuity import Seam
from teamslam.team.estimation.map_joining.cutting import SPOILT, cut_tick, find_part
from teamslam.team.estimation.map_joining.joining import Tick
from teamslam.team.estimation.submap import LocalMap

R1 = ("r1", 3)
PART = part_of(R1, 5)
CUTS = (Seam(R1, 3, 5, 40, 50, 9.0), Seam(PART, 7, 8, 80, 80, 9.0))


def submap(sequence: int) -> Contribution:
    local = LocalMap(np.zeros(0, np.uint32), np.zeros(3), np.eye(3))
    return Contribution("r1", 3, sequence, 10 * (sequence + 1), local)


def test_a_part_is_named_and_lies_behind_its_stream() -> None:
    assert whole_of(PART) == R1 < PART
    assert (first_of(R1), first_of(PART)) == (0, 5)
    assert named(PART) == "r1 (incarnation 3, from submap 5 on)"


def test_a_part_that_is_cut_again_has_the_submaps_between_its_seams() -> None:
    parts = [find_part(R1, sequence, CUTS) for sequence in (0, 4, 5, 7, 8, 20)]
    last = part_of(R1, 8)
    assert parts == [R1, R1, PART, PART, last, last]
    assert find_part(("r2", 3), 20, CUTS) == ("r2", 3)


def test_members_of_a_tick_go_to_the_parts_and_a_spoilt_submap_is_refused() -> None:
    verdict = Verdict(LocalLandmark("r1", 3, 2, 0), LocalLandmark("r1", 3, 6, 1), True)
    tick = Tick([submap(sequence) for sequence in (3, 4, 5, 8)], verdicts=(verdict,))
    found = cut_tick(tick, CUTS)
    assert [each.stream for each in found.contributions] == [R1, R1, PART, part_of(R1, 8)]
    assert [each.sequence for each in found.contributions] == [3, 4, 5, 8]
    assert found.outside == {submap(4).key: SPOILT}
    ((one, two, _),) = found.verdicts
    assert (one[:2], two[:2]) == (R1, PART)
    assert cut_tick(tick, ()) is tick
