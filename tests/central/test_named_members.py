"""A running map names a few members of each unnamed landmark, the final one all of them."""

import numpy as np

from teamslam.central.unnamed_landmarks import SHOWN, memberships_of
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.landmark_sets import (
    NO_LANDMARKS,
    Landmarks,
    add_landmarks,
    merge_sets,
)
from teamslam.team.estimation.association.member_log import MergeRecord
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.wire.arrays import ids


def landmarks(submaps: int) -> Landmarks:
    """Two landmarks that one robot sees in every submap, as one set each."""
    ids = (UNNAMED + np.arange(2)).astype(np.uint32)
    local = LocalMap(ids, np.zeros(7), np.eye(7))
    found = NO_LANDMARKS
    for k in range(submaps):
        each = Contribution("r1", 1, k, k, local)
        found, numbers = add_landmarks(found, [each])
        if not k:
            first = numbers[each.key]
            continue
        pairs = zip(numbers[each.key], first, strict=True)
        found, _ = merge_sets(
            found, [(own, MergeRecord("track", into, 5.0, k, 0.1, k)) for own, into in pairs]
        )
    return found


def test_what_a_running_map_names_does_not_grow_with_the_run() -> None:
    for submaps in (100, 1000):
        (few,) = memberships_of(landmarks(submaps), every=False)
        (every,) = memberships_of(landmarks(submaps))
        assert len(ids(few.sequences, "sequences")) == 2 * SHOWN
        assert len(ids(every.sequences, "sequences")) == 2 * submaps
        sequences = np.unique(ids(few.sequences, "sequences")).tolist()
        assert sequences == [0, *range(submaps - SHOWN + 1, submaps)]
        assert len(few.figures) == 3 * 8 * len(few.steps)


def test_a_landmark_of_few_submaps_is_named_as_in_the_final_map() -> None:
    for submaps in (1, 2, SHOWN):
        assert memberships_of(landmarks(submaps), every=False) == memberships_of(landmarks(submaps))
