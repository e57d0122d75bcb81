import numpy as np
import pytest

from team.association import AssociationProfile
from team.estimation.association.gating import SPLIT, Joint, evaluate_pairs
from team.estimation.association.joint_compatibility import condition_on_pair, grow_pairs

PROFILE = AssociationProfile(slack=0.0)


def _joint(points: list[tuple[float, float]], sd: float, common: float = 0.0) -> Joint:
    """Independent errors; the second half of the points has one error in common besides."""
    n = len(points)
    covariance = sd**2 * np.eye(2 * n)
    half = np.zeros((2 * n, 2))
    half[n - n % 2 :: 2, 0] = half[n - n % 2 + 1 :: 2, 1] = common
    return Joint(np.array(points), covariance + half @ half.T, np.zeros((n, n), np.bool_))


def test_a_pairs_likelihood_is_that_of_its_difference_against_a_stray_landmark():
    joint = _joint([(0.0, 0.0), (0.1, -0.05)], sd=0.1)
    at = evaluate_pairs(joint, np.array([0]), np.array([1]), PROFILE)
    S = 0.02 * np.eye(2)
    d = np.array([-0.1, 0.05])
    chi2 = d @ np.linalg.solve(S, d)
    density = np.exp(-0.5 * chi2) / (2.0 * np.pi * np.sqrt(np.linalg.det(S)))
    assert at.chi2[0] == pytest.approx(chi2)
    assert at.llr[0] == pytest.approx(np.log(density / PROFILE.density))
    assert at.sd[0] == pytest.approx(np.sqrt(0.02))


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


def test_an_error_that_all_have_in_common_is_found_with_the_first_pair_and_the_others_follow():
    shift = 2.0
    old = [(0.0, 0.0), (5.0, 1.0), (9.0, 4.0)]
    new = [(x + shift, y) for x, y in old]
    joint = _joint([*old, *new], sd=0.02, common=3.0)
    one, two = (each.ravel() for each in np.meshgrid([3, 4, 5], [0, 1, 2], indexing="ij"))
    found = grow_pairs(joint, (one, two), PROFILE, seeds=[(3, 0)])
    assert found is not None
    assert {(pair.first, pair.second) for pair in found.pairs} == {(3, 0), (4, 1), (5, 2)}
    assert found.pairs[0].sd > 1.0 > found.pairs[1].sd


def test_of_two_equal_partners_none_is_taken_and_fragments_of_one_do_not_block_each_other():
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


def test_what_one_scan_saw_as_two_is_never_one_and_this_is_passed_on_to_whom_they_join():
    joint = _joint([(0.0, 0.0), (0.02, 0.0), (0.01, 0.0)], sd=0.05)
    joint.apart[0, 1] = joint.apart[1, 0] = True
    found = grow_pairs(joint, (np.array([0, 1, 0]), np.array([2, 2, 1])), PROFILE)
    assert found is not None
    assert len(found.pairs) <= 1
    after = condition_on_pair(joint, 0, 2, PROFILE)
    assert after.apart[2, 1]
    assert after.apart[1, 2]


def test_what_one_window_has_as_two_needs_more_and_so_do_those_whom_either_joins():
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
