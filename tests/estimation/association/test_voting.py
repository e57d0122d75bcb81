import numpy as np
import pytest

from teamslam.team.estimation.association import voting
from teamslam.team.estimation.association.voting import PointSet, apply_motion, propose_alignments


def _points(mean: np.ndarray) -> PointSet:
    return PointSet(mean, np.full(len(mean), 0.1))


def test_the_motion_between_two_sets_is_found_among_points_that_only_one_of_them_has():
    rng = np.random.default_rng(1)
    shared = rng.uniform(0.0, 20.0, (15, 2))
    motion = np.array([4.0, -7.0, 2.2])
    a = np.concatenate([shared, rng.uniform(0.0, 20.0, (10, 2))])
    centre = a.mean(axis=0)
    b = np.concatenate([rng.uniform(-30.0, 30.0, (60, 2)), apply_motion(motion, shared - centre)])
    best = propose_alignments(_points(a), _points(b), 0.3, 15.0)[0]
    pairs = set(zip(best.first.tolist(), best.second.tolist(), strict=True))
    assert {(k, 60 + k) for k in range(15)} <= pairs
    assert np.abs(best.motion - motion).max() < 0.05


def test_a_pattern_that_stands_twice_gives_two_alignments_of_equal_size():
    rng = np.random.default_rng(2)
    room = rng.uniform(0.0, 8.0, (10, 2))
    twice = np.concatenate([room, room + np.array([30.0, 0.0])])
    first, second = propose_alignments(_points(room), _points(twice), 0.3, 15.0)[:2]
    assert len(first.first) == len(second.first) == 10
    assert abs(first.motion[0] - second.motion[0]) > 29.0


def test_two_maps_of_one_point_have_no_alignment():
    assert propose_alignments(_points(np.zeros((1, 2))), _points(np.zeros((5, 2))), 0.3, 15.0) == []


def test_votes_that_are_counted_cell_by_cell_and_sorted_votes_give_the_same_alignments(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = np.random.default_rng(4).uniform(0.0, 9.0, (30, 2))
    counted = propose_alignments(_points(points[:20]), _points(points), 0.3, 15.0)
    monkeypatch.setattr(voting, "MOST_COUNTED", 0)
    ordered = propose_alignments(_points(points[:20]), _points(points), 0.3, 15.0)
    assert len(counted) == len(ordered) > 0
    for one, two in zip(counted, ordered, strict=True):
        np.testing.assert_array_equal(one.motion, two.motion)
        np.testing.assert_array_equal(one.second, two.second)
