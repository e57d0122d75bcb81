from itertools import permutations

import numpy as np
import pytest
from jaxtyping import Bool, Float

from teamslam.team.association import AssociationProfile
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association import voting
from teamslam.team.estimation.association.gating import Joint, list_pairs
from teamslam.team.estimation.association.island_view import (
    REEXAMINED,
    IslandView,
    find_undecided,
    select_by_turns,
    select_comparisons,
)
from teamslam.team.estimation.association.joint_compatibility import assign_jointly
from teamslam.team.estimation.association.landmark_sets import (
    NO_LANDMARKS,
    add_landmarks,
    merge_sets,
)
from teamslam.team.estimation.association.member_log import MergeRecord
from teamslam.team.estimation.association.voting import PointSet, apply_motion, propose_alignments
from teamslam.team.estimation.map_joining.fold_association import view_island
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Contribution,
    JoinSettings,
    Tick,
)
from teamslam.team.estimation.map_joining.tick import fold_tick
from teamslam.team.estimation.submap import LocalMap, Unnamed
from tests.estimation.association.unnamed_worlds import circle, drive

OWN = 0.01
PROFILE = AssociationProfile(slack=0.0, density=1.0)
TWINS = np.array([(0.0, 0.0), (0.2, 0.0), (3.0, 1.0), (3.0, 1.2)])


def _seen(submaps: list[list[int]], common: float) -> tuple[Joint, list[np.ndarray]]:
    """Twins as several submaps saw them; sigmas of each submap's error and of each landmark's."""
    rng = np.random.default_rng(1)
    owner = np.repeat(np.arange(len(submaps)), [len(each) for each in submaps])
    together: Bool[np.ndarray, "n n"] = owner[:, None] == owner[None]
    shared = common**2 * np.kron(together, np.eye(2))
    covariance: Float[np.ndarray, "m m"] = OWN**2 * np.eye(2 * len(owner)) + shared
    apart = together & ~np.eye(len(owner), dtype=np.bool_)
    points = TWINS[[k for each in submaps for k in each]]
    points = points + common * rng.normal(size=(len(submaps), 2))[owner]
    points = points + OWN * rng.normal(size=points.shape)
    return Joint(points, covariance, apart, PROFILE), [
        np.flatnonzero(owner == k) for k in range(len(submaps))
    ]


def _rows(submaps: list[np.ndarray], joint: Joint) -> Bool[np.ndarray, "K n"]:
    return np.array([np.isin(np.arange(len(joint.mean)), each) for each in submaps])


def _pairs(joint: Joint, own: np.ndarray, candidates: np.ndarray) -> list[tuple[int, int]]:
    found = assign_jointly(joint, *list_pairs(own, candidates), 0.5)
    return sorted((pair.first, pair.second) for pair in found.pairs)


def test_unmerged_fragments_do_not_keep_a_submap_from_being_associated():
    joint, (own, *others) = _seen([[0, 1, 2, 3]] * 5, common=0.15)
    assert not _pairs(joint, own, np.concatenate(others))
    found = set()
    for candidates in select_comparisons(joint, own, _rows(others, joint), 0.5):
        found |= {(one, two % 4) for one, two in _pairs(joint, own, candidates)}
    assert found == {(k, k) for k in range(4)}


def test_a_landmark_that_the_other_submap_missed_is_a_rival_of_those_that_it_has():
    joint, (own, other, whole) = _seen([[1], [0], [0, 1]], common=0.04)
    fits = select_comparisons(joint, own, _rows([other], joint), 0.5)
    assert [each.tolist() for each in fits] == [other.tolist()]
    apart = joint.apart.copy()
    apart[other, whole[1]] = apart[whole[1], other] = True  # one keyframe saw the two together
    with_rival = select_comparisons(joint._replace(apart=apart), own, _rows([other], joint), 0.5)
    assert [each.tolist() for each in with_rival] == [other.tolist()]
    both = select_comparisons(joint._replace(apart=apart), own, _rows([other, whole], joint), 0.5)
    assert [other[0], whole[1]] in [each.tolist() for each in both]


def test_landmarks_that_may_be_one_are_undecided():
    joint, (one, two) = _seen([[0, 1], [0, 2]], common=0.15)
    assert find_undecided(joint, np.arange(4)).tolist() == [one[0], one[1], two[0]]


def test_every_older_submap_is_examined_again_by_turns():
    submaps = list(range(100, 130))
    seen = [select_by_turns(submaps, turn) for turn in range(len(submaps))]
    assert set().union(*seen) == set(submaps)
    assert all(len(each) == len(set(each)) <= REEXAMINED for each in seen)
    assert select_by_turns(submaps[:REEXAMINED], 3) == submaps[:REEXAMINED]


KNOWN = np.array([[0.0, 0.0], [0.0, 0.3], [0.0, 0.52]])
"""Three landmarks of the map; a robot sees the first two again."""
AWAY = np.array([20.0, 0.0])
LOCAL_SD, SHIFT_SD = 0.01, 0.06


def view_of_a_group_shifted_by(shift: float) -> IslandView:
    places = np.concatenate([KNOWN, KNOWN[:2] + AWAY])
    count = len(places)
    local = LocalMap(
        (UNNAMED + np.arange(count)).astype(np.uint32),
        np.concatenate([np.zeros(3), places.ravel()]),
        np.diag(np.full(3 + 2 * count, LOCAL_SD**2)),
        unnamed=Unnamed(np.full(count, 5, np.uint32), np.zeros((count, 0), np.bool_)),
    )
    fold = fold_tick(EMPTY_FOLD, Tick([Contribution("r1", 1, 0, 10**10, local)]), JoinSettings())
    view = view_island(fold.main, fold.landmarks)
    order = np.argsort(view.joint.mean[:, 0] * 10.0 + view.joint.mean[:, 1])
    mean = view.joint.mean.copy()
    mean[order[3:]] += [0.0, shift] - AWAY
    covariance = LOCAL_SD**2 * np.eye(2 * count)
    group = np.array([2 * k + axis for k in order[3:].tolist() for axis in (0, 1)])
    covariance[np.ix_(group, group)] += SHIFT_SD**2 * np.kron(np.ones((2, 2)), np.eye(2))
    view.joint = view.joint._replace(
        mean=mean,
        covariance=covariance,
        apart=np.zeros((count, count), np.bool_),
        apart_in_window=None,
        density=None,
    )
    return view


@pytest.mark.parametrize(("shift", "merged"), [(0.0, 2), (0.22, 0)])
def test_a_group_that_fits_at_two_places_is_not_swept(shift, merged):
    view = view_of_a_group_shifted_by(shift)
    view.sweep()
    assert len(view.ties) == merged


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


@pytest.mark.parametrize("seed", range(6))
def test_mutual_neighbours_are_those_of_all_distances_also_where_distances_are_equal(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(-3, 4, (12, 2)) / 2.0, rng.integers(-3, 4, (20, 2)) / 2.0
    motions = np.column_stack([rng.integers(-2, 3, (5, 2)), rng.integers(0, 2, 5) * np.pi])
    fits = rng.random((12, 20)) < 0.8 if seed % 2 else None
    to, mutual = voting._find_neighbours(motions, a, b, 0.6, fits)
    assert mutual.any()
    for motion, partner, agree in zip(motions, to, mutual, strict=True):
        off = ((apply_motion(motion, a)[:, None] - b) ** 2).sum(axis=2)
        off = np.where(off < 0.6**2, off, np.inf)
        off = off if fits is None else np.where(fits, off, np.inf)
        nearest, back = off.argmin(axis=1), off.argmin(axis=0)
        expected = np.isfinite(off.min(axis=1)) & (back[nearest] == np.arange(12))
        np.testing.assert_array_equal(agree, expected)
        np.testing.assert_array_equal(partner[agree], nearest[agree])


WORLD = np.array([[8.0, 1.0], [9.0, -2.0], [7.0, 3.0]])


def _tie(into: int) -> MergeRecord:
    return MergeRecord("track", into, 5.0, 0.0, 0.1, 0)


def test_a_set_has_the_number_of_its_smallest_member_in_any_order_of_merges():
    path = circle((0.0, 0.0), 5.0, 1, 0.05)
    submaps = [drive(robot, path, WORLD, np.random.default_rng(1))[0][0] for robot in ("r1", "r2")]
    landmarks, numbers = add_landmarks(NO_LANDMARKS, submaps)
    one, two, three = numbers[submaps[0].key][0], *numbers[submaps[1].key][:2]
    for a, b, c in permutations((one, two, three)):
        found, becomes = merge_sets(landmarks, [(a, _tie(b)), (b, _tie(c))])
        assert {found.identity(member) for member in found.sets[one]} == {one}
        assert becomes == {two: one, three: one}
