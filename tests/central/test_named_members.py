"""A running map names a few members of each unnamed landmark, the final one all of them."""

import numpy as np

from central.unnamed_landmarks import SHOWN, memberships_of
from team.estimation.map_joining.association.landmarks import Landmarks, LocalLandmark
from team.wire.arrays import ids


def landmarks(submaps: int) -> Landmarks:
    """Two landmarks that one robot sees in every submap, as one set each."""
    number, sets = {}, {}
    for local in range(2):
        members = tuple(LocalLandmark("r1", 1, k, local) for k in range(submaps))
        sets[2**31 + local] = members
        number |= dict.fromkeys(members, 2**31 + local)
    return Landmarks(number, sets)


def test_what_a_running_map_names_does_not_grow_with_the_run() -> None:
    for submaps in (100, 1000):
        (few,) = memberships_of(landmarks(submaps), SHOWN)
        (every,) = memberships_of(landmarks(submaps))
        assert len(ids(few.sequences, "sequences")) == 2 * SHOWN
        assert len(ids(every.sequences, "sequences")) == 2 * submaps
        sequences = np.unique(ids(few.sequences, "sequences")).tolist()
        assert sequences == [0, *range(submaps - SHOWN + 1, submaps)]
        assert len(few.figures) == 3 * 8 * len(few.steps)


def test_a_landmark_of_few_submaps_is_named_as_in_the_final_map() -> None:
    for submaps in (1, 2, SHOWN):
        assert memberships_of(landmarks(submaps), SHOWN) == memberships_of(landmarks(submaps))
