from itertools import permutations

import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.landmark_sets import (
    NO_LANDMARKS,
    add_landmarks,
    merge_sets,
    number_of,
)
from teamslam.team.estimation.association.member_log import LocalLandmark, MergeRecord
from tests.estimation.association.unnamed_worlds import circle, drive

WORLD = np.array([[8.0, 1.0], [9.0, -2.0], [7.0, 3.0]])


def _tie(into: int) -> MergeRecord:
    return MergeRecord("track", into, 5.0, 0.0, 0.1, 0)


def test_each_unnamed_landmark_is_a_set_of_its_own_with_a_number_derived_from_its_name():
    (submap,), _ = drive("r1", circle((0.0, 0.0), 5.0, 1, 0.05), WORLD, np.random.default_rng(1))
    landmarks, numbers = add_landmarks(NO_LANDMARKS, [submap])
    assert numbers[submap.key] == [number_of(LocalLandmark("r1", 1, 0, k)) for k in range(3)]
    assert all(number >= UNNAMED for number in numbers[submap.key])
    assert [landmarks.sets[number] for number in numbers[submap.key]] == [
        (LocalLandmark("r1", 1, 0, k),) for k in range(3)
    ]


def test_submaps_whose_landmarks_all_have_names_add_no_set():
    path = circle((0.0, 0.0), 5.0, 1, 0.05)
    (submap,), _ = drive("r1", path, WORLD, np.random.default_rng(1), named=True)
    landmarks, numbers = add_landmarks(NO_LANDMARKS, [submap])
    assert landmarks is NO_LANDMARKS
    assert not numbers


def test_a_set_has_the_number_of_its_smallest_member_in_any_order_of_merges():
    path = circle((0.0, 0.0), 5.0, 1, 0.05)
    submaps = [drive(robot, path, WORLD, np.random.default_rng(1))[0][0] for robot in ("r1", "r2")]
    landmarks, numbers = add_landmarks(NO_LANDMARKS, submaps)
    one, two, three = numbers[submaps[0].key][0], *numbers[submaps[1].key][:2]
    for a, b, c in permutations((one, two, three)):
        found, becomes = merge_sets(landmarks, [(a, _tie(b)), (b, _tie(c))])
        assert {found.identity(member) for member in found.sets[one]} == {one}
        assert becomes == {two: one, three: one}


def test_a_set_with_a_name_keeps_the_name():
    (submap,), _ = drive("r1", circle((0.0, 0.0), 5.0, 1, 0.05), WORLD, np.random.default_rng(1))
    landmarks, numbers = add_landmarks(NO_LANDMARKS, [submap])
    number = numbers[submap.key][0]
    for ties in ([(7, _tie(number))], [(number, _tie(7))]):
        found, becomes = merge_sets(landmarks, ties)
        assert becomes == {number: 7}
        assert found.sets[7] == (LocalLandmark("r1", 1, 0, 0),)
