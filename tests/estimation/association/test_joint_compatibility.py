"""Joint compatibility: pairs merged one after the other, and pairs with rivals weighed together."""

import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.estimation.association.gating import SPLIT, Joint, evaluate_pairs
from teamslam.team.estimation.association.joint_compatibility import (
    assign_jointly,
    condition_on_pair,
    grow_pairs,
)

PROFILE = AssociationProfile(slack=0.0)


def _joint(points: list[tuple[float, float]], sd: float, common: float = 0.0) -> Joint:
    """Independent errors; the second half of the points has one error in common besides."""
    n = len(points)
    covariance = sd**2 * np.eye(2 * n)
    half = np.zeros((2 * n, 2))
    half[n - n % 2 :: 2, 0] = half[n - n % 2 + 1 :: 2, 1] = common
    return Joint(np.array(points), covariance + half @ half.T, np.zeros((n, n), np.bool_))


def test_conditioning_on_a_pair_is_the_kalman_filters_measurement_of_no_difference():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(8, 8))
    joint = Joint(rng.normal(size=(4, 2)), root @ root.T, np.zeros((4, 4), np.bool_))
    H = np.zeros((2, 8))
    H[:, 2:4], H[:, 6:8] = np.eye(2), -np.eye(2)
    S = H @ joint.covariance @ H.T
    K = joint.covariance @ H.T @ np.linalg.inv(S)
    found = condition_on_pair(joint, 1, 3, PROFILE)
    assert found.mean.ravel() == pytest.approx(joint.mean.ravel() - K @ H @ joint.mean.ravel())
    assert found.covariance == pytest.approx(joint.covariance - K @ S @ K.T)


def test_a_common_error_is_estimated_by_the_first_pair_and_the_others_follow():
    shift = 2.0
    old = [(0.0, 0.0), (5.0, 1.0), (9.0, 4.0)]
    new = [(x + shift, y) for x, y in old]
    joint = _joint([*old, *new], sd=0.02, common=3.0)
    one, two = (each.ravel() for each in np.meshgrid([3, 4, 5], [0, 1, 2], indexing="ij"))
    found = grow_pairs(joint, (one, two), PROFILE, seeds=[(3, 0)])
    assert found is not None
    assert {(pair.first, pair.second) for pair in found.pairs} == {(3, 0), (4, 1), (5, 2)}
    assert found.pairs[0].sd > 1.0 > found.pairs[1].sd


def test_two_equal_partners_block_each_other_and_fragments_of_one_landmark_do_not():
    joint = _joint([(0.0, 0.0), (0.14, 0.0), (-0.14, 0.0)], sd=0.05)
    one, two = np.array([0, 0]), np.array([1, 2])
    rivals = joint._replace(apart=joint.apart.copy())
    rivals.apart[1, 2] = rivals.apart[2, 1] = True
    waits = grow_pairs(rivals, (one, two), PROFILE)
    assert waits is not None
    assert not waits.pairs
    fragments = grow_pairs(joint, (one, two), PROFILE)
    assert fragments is not None
    assert len(fragments.pairs) == 1


def test_landmarks_of_one_scan_are_never_merged_and_merged_ones_inherit_this():
    joint = _joint([(0.0, 0.0), (0.02, 0.0), (0.01, 0.0)], sd=0.05)
    joint.apart[0, 1] = joint.apart[1, 0] = True
    found = grow_pairs(joint, (np.array([0, 1, 0]), np.array([2, 2, 1])), PROFILE)
    assert found is not None
    assert len(found.pairs) <= 1
    after = condition_on_pair(joint, 0, 2, PROFILE)
    assert after.apart[2, 1]
    assert after.apart[1, 2]


def test_landmarks_of_one_window_need_more_evidence_and_merged_ones_inherit_this():
    joint = _joint([(0.0, 0.0), (0.2, 0.0), (0.4, 0.0)], sd=0.08)
    one, two = np.array([0]), np.array([1])
    llr = evaluate_pairs(joint, one, two, PROFILE).llr[0]
    assert PROFILE.llr_tight < llr < PROFILE.llr_tight + SPLIT
    split = np.zeros((3, 3), np.bool_)
    split[0, 1] = split[1, 0] = True
    for beside, pairs in ((None, 1), (split, 0)):
        found = grow_pairs(joint._replace(apart_in_window=beside), (one, two), PROFILE)
        assert found is not None
        assert len(found.pairs) == pairs
    after = condition_on_pair(joint._replace(apart_in_window=split), 1, 2, PROFILE).apart_in_window
    assert after is not None
    assert after[0, 2]
    assert after[2, 0]


DENSE = AssociationProfile(slack=0.0, density=1.0)
TWINS = [(0.0, 0.0), (0.2, 0.0), (3.0, 1.0), (3.0, 1.2)]


def _twins(seen: list[int], common: float) -> tuple[Joint, np.ndarray, np.ndarray]:
    """Known landmarks in twos, and some of them seen again with an error that they share."""
    n, m = len(TWINS), len(seen)
    points = np.array([*TWINS, *(TWINS[k] for k in seen)])
    covariance = 0.01**2 * np.eye(2 * (n + m))
    both = np.zeros((2 * (n + m), 2))
    both[2 * n :: 2, 0] = both[2 * n + 1 :: 2, 1] = common
    apart = np.zeros((n + m, n + m), np.bool_)
    apart[:n, :n] = apart[n:, n:] = True
    np.fill_diagonal(apart, False)
    one, two = np.meshgrid(np.arange(n, n + m), np.arange(n), indexing="ij")
    return Joint(points, covariance + both @ both.T, apart), one.ravel(), two.ravel()


def test_neighbours_are_distinguished_jointly_where_each_by_itself_is_not():
    joint, one, two = _twins([0, 1, 2, 3], common=0.15)
    alone = grow_pairs(joint, (one, two), DENSE)
    assert alone is not None
    assert not alone.pairs
    found = assign_jointly(joint, one, two, DENSE, 0.5)
    assert sorted((p.first, p.second) for p in found.pairs) == [(4, 0), (5, 1), (6, 2), (7, 3)]


def test_one_of_two_neighbours_alone_is_not_merged():
    joint, one, two = _twins([0], common=0.15)
    assert not assign_jointly(joint, one, two, DENSE, 0.5).pairs


def test_a_few_uncertain_landmarks_that_fit_others_by_chance_are_not_merged() -> None:
    known = np.array([(0.0, 0.0), (4.0, 1.0), (1.0, 5.0)])
    profile = AssociationProfile(slack=0.0, density=0.006, same=1.0)
    for count, sd, pairs in ((2, 0.3, 0), (2, 0.05, 2), (3, 0.3, 3)):
        points = np.concatenate([known, known[:count] + np.array([1.0, -0.5])])
        n = len(points)
        shift = np.zeros((2 * n, 2))  # an error of 1 m that all that is seen again has in common
        shift[6::2, 0] = shift[7::2, 1] = 1.0
        seen = np.arange(n) >= len(known)
        apart = (seen[:, None] == seen) & ~np.eye(n, dtype=np.bool_)
        joint = Joint(points, sd**2 * np.eye(2 * n) + shift @ shift.T, apart)
        one, two = (each.ravel() for each in np.meshgrid(np.arange(3, n), np.arange(3)))
        found = assign_jointly(joint, one, two, profile, 2.0)
        assert [(p.first, p.second) for p in found.pairs] == [(3 + k, k) for k in range(pairs)]


def test_a_pair_that_only_a_doubtful_pair_makes_certain_is_evaluated_without_it() -> None:
    twins_and_another = [(0.0, 0.0), (0.25, 0.0), (3.0, 1.0)]
    points = np.array([*twins_and_another, (0.12, 0.0), (3.0, 1.0)])  # the first is either twin
    shift = np.zeros((10, 2))  # an error of 1 m that what is seen again has in common
    shift[6::2, 0] = shift[7::2, 1] = 1.0
    seen = np.arange(5) >= 3
    apart = (seen[:, None] == seen) & ~np.eye(5, dtype=np.bool_)
    joint = Joint(points, 0.05**2 * np.eye(10) + shift @ shift.T, apart)
    one, two = (each.ravel() for each in np.meshgrid([3, 4], [0, 1, 2], indexing="ij"))
    for density, pairs in ((0.05, []), (0.006, [(4, 2)])):
        profile = AssociationProfile(slack=0.0, density=density, same=0.1)
        found = assign_jointly(joint, one, two, profile, 2.0)
        assert [(p.first, p.second) for p in found.pairs] == pairs
        assert all(p.sd > 1.0 for p in found.pairs), "it is known to a metre, whatever the first is"
