"""Landmarks of one side where the other side observed and has none."""

import numpy as np

from teamslam.team.estimation.association.visibility import (
    mark_missed,
    mark_visible,
    pad_views,
    renumber_views,
)
from teamslam.team.estimation.submap import Unnamed


def test_a_point_in_the_polygon_that_one_keyframe_saw_is_covered_and_one_outside_is_not() -> None:
    rng = np.random.default_rng(3)
    own = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [2.0, 1.0], [9.0, 9.0]])
    views = pad_views([np.array([0, 1, 2, 3, 4]), np.array([2, 5, 4])])
    points = rng.uniform(-1.0, 6.0, (400, 2))
    inside = ((points > 0.0) & (points < [4.0, 3.0])).all(axis=1)
    triangle = own[[2, 5, 4]]
    sides = [_left(triangle[k], triangle[(k + 1) % 3], points) for k in range(3)]
    inside |= np.all(sides, axis=0) | ~np.any(sides, axis=0)
    assert mark_visible(points, own, views).tolist() == inside.tolist()
    assert 50 < inside.sum() < 350


def _left(one: np.ndarray, two: np.ndarray, points: np.ndarray) -> np.ndarray:
    along, to = two - one, points - one
    return along[0] * to[:, 1] - along[1] * to[:, 0] > 0.0


def test_the_views_of_a_window_are_the_largest_sets_of_three_or_more() -> None:
    seen = np.array([[1, 1, 0, 1], [1, 1, 0, 1], [1, 0, 1, 1], [1, 0, 1, 0]], np.bool_)
    found = Unnamed(np.full(4, 3, np.uint32), seen).views
    assert [each.tolist() for each in found] == [[0, 1, 2, 3]]


def test_views_lose_landmarks_that_are_left_out_and_views_of_fewer_than_three_go() -> None:
    views = pad_views([np.array([0, 1, 2, 3]), np.array([1, 2, 4])])
    to = np.array([10, 11, 12, -1, -1])
    assert renumber_views(views, to).tolist() == [[10, 11, 12, -1]]


def test_a_landmark_that_later_submaps_miss_is_missed_and_a_new_one_is_not() -> None:
    """All but the last submap look at landmarks 0 and 1; 2 is false, 3 elsewhere, 4 new."""
    sees = np.zeros((7, 5), np.bool_)
    sees[:6, :2] = True
    sees[1, 2] = sees[6, 3] = sees[5, 4] = True
    assert mark_missed(sees).tolist() == [False, False, True, False, False]
    assert not mark_missed(sees[:3]).any(), "three submaps are no evidence"
    assert mark_missed(np.zeros((0, 3), np.bool_)).tolist() == [False] * 3
