from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation.association.clustering import associate_window, marginals
from teamslam.team.estimation.association.gating import (
    SPLIT,
    Joint,
    compare_classes,
)
from teamslam.team.estimation.association.joint_compatibility import (
    assign_jointly,
    grow_alignment,
    grow_pairs,
)
from teamslam.team.estimation.association.scans import UNASSIGNED, Detections, match_scan
from teamslam.team.estimation.association.voting import PointSet, propose_alignments
from tests.estimation.association.test_clustering import pairs, window


def test_a_name_matches_at_any_distance_and_only_its_own_landmark():
    points = np.array([(9.0, 0.0), (0.0, 0.0), (5.0, 0.0)])
    names, mapped = np.array([7, 8, UNASSIGNED]), np.array([UNASSIGNED, 7, UNASSIGNED])
    seen = np.array([(0.0, 0.0), (1.0, 0.0), (5.0, 0.1)])
    small = np.tile(0.01 * np.eye(2), (3, 1, 1))
    scan = Detections(points, small, names)
    found = match_scan(scan, (seen, small), mapped, AssociationSettings())
    assert found.tolist() == [1, UNASSIGNED, 2]


def test_a_pairs_likelihood_is_that_of_its_difference_against_a_stray_landmark():
    profile = AssociationProfile(slack=0.0)
    points = np.array([(0.0, 0.0), (0.1, -0.05)])
    joint = Joint(points, 0.01 * np.eye(4), np.zeros((2, 2), np.bool_), profile)
    at = joint.evaluate(np.array([0]), np.array([1]))
    S = 0.02 * np.eye(2)
    d = np.array([-0.1, 0.05])
    chi2 = d @ np.linalg.solve(S, d)
    density = np.exp(-0.5 * chi2) / (2.0 * np.pi * np.sqrt(np.linalg.det(S)))
    assert at.chi2[0] == pytest.approx(chi2)
    assert at.llr[0] == pytest.approx(np.log(density / profile.density))
    assert at.sd[0] == pytest.approx(np.sqrt(0.02))


P = 0.99


def reported(classes: list[int], count: int = 3) -> np.ndarray:
    rows = np.full((len(classes), count), np.log((1.0 - P) / (count - 1)))
    rows[np.arange(len(classes)), classes] = np.log(P)
    return rows


def joint(classes: np.ndarray | None) -> Joint:
    mean = np.array([[0.0, 0.0], [0.02, 0.0], [5.0, 0.0]])
    return Joint(
        mean, 1e-4 * np.eye(6), np.zeros((3, 3), np.bool_), AssociationProfile(), classes=classes
    )


def test_landmarks_of_contradicting_classes_are_not_in_the_gate():
    pair = np.array([0]), np.array([1])
    plain = joint(None).evaluate(*pair)
    alike = joint(reported([1, 1, 0])).evaluate(*pair)
    assert plain.chi2 == alike.chi2
    assert alike.llr - plain.llr == pytest.approx(compare_classes(reported([1]), reported([1])))
    assert len(joint(reported([1, 1, 0])).gate(*pair)[0]) == 1
    assert len(joint(reported([1, 2, 0])).gate(*pair)[0]) == 0
    assert len(joint(None).gate(*pair)[0]) == 1


def test_of_two_places_of_equal_shape_the_one_of_equal_classes_gets_the_votes():
    shape = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [-1.0, 6.0], [7.0, 5.0]])
    kinds = [0, 1, 2, 1, 0]
    target = np.concatenate((shape, shape + np.array([40.0, 0.0])))
    sd = np.full(10, 0.02)
    other = PointSet(target, sd, reported([1, 2, 0, 0, 1, *kinds]))
    votes = propose_alignments(PointSet(shape, sd[:5], reported(kinds)), other, 0.1, 20.0)
    assert (len(votes[0].first), votes[0].second.tolist()) == (5, [5, 6, 7, 8, 9])
    assert all(len(vote.first) < 5 for vote in votes[1:])
    plain = propose_alignments(PointSet(shape, sd[:5]), other._replace(classes=None), 0.1, 20.0)
    assert [len(vote.first) for vote in plain[:2]] == [5, 5]


def exact(weights: np.ndarray) -> np.ndarray:
    """Marginals over all joint associations, each weighted by the product of its odds."""
    n, count = weights.shape
    found, total = np.zeros_like(weights), 0.0
    for joint in product(range(-1, count), repeat=n):
        taken = [(i, j) for i, j in enumerate(joint) if j >= 0]
        if len({j for _, j in taken}) < len(taken):
            continue
        odds = float(np.prod([weights[pair] for pair in taken]))
        total += odds
        for pair in taken:
            found[pair] += odds
    return found / total


@pytest.mark.parametrize("seed", range(4))
def test_marginals_are_those_of_all_joint_associations(seed):
    weights = np.exp(np.random.default_rng(seed).normal(1.0, 2.0, (3, 3)))
    assert np.allclose(marginals(weights), exact(weights), atol=0.1)


def test_a_poor_sensor_gives_fewer_landmarks_and_not_wrong_ones():
    wrong, left = [], []
    for certain in (0.0, 0.95):
        precision, kept = [], []
        for seed in range(3):
            scans, labels = window(seed, spacing=2.0, missed=0.1)
            noise = np.random.default_rng(seed).normal(size=scans.points.shape) * 0.45
            poor = np.tile((0.45**2 + 0.05**2) * np.eye(2), (len(labels), 1, 1))
            scans = replace(scans, points=scans.points + noise, covariances=poor)
            result = associate_window(scans, AssociationSettings(certain=certain))
            precision.append(pairs(result.landmark_of, labels)[0])
            kept.append((result.landmark_of != UNASSIGNED).mean())
        wrong.append(1.0 - np.mean(precision))
        left.append(np.mean(kept))
    assert wrong[1] < 0.3 * wrong[0]
    assert 0.1 < left[1] < left[0]


PROFILE_JOINT_COMPATIBILITY = AssociationProfile(slack=0.0)


def _joint(points: list[tuple[float, float]], sd: float, common: float = 0.0) -> Joint:
    n = len(points)
    covariance = sd**2 * np.eye(2 * n)
    half = np.zeros((2 * n, 2))
    half[n - n % 2 :: 2, 0] = half[n - n % 2 + 1 :: 2, 1] = common
    return Joint(
        np.array(points),
        covariance + half @ half.T,
        np.zeros((n, n), np.bool_),
        PROFILE_JOINT_COMPATIBILITY,
    )


def test_conditioning_on_a_pair_is_the_kalman_filters_measurement_of_no_difference():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(8, 8))
    joint = Joint(
        rng.normal(size=(4, 2)),
        root @ root.T,
        np.zeros((4, 4), np.bool_),
        PROFILE_JOINT_COMPATIBILITY,
    )
    H = np.zeros((2, 8))
    H[:, 2:4], H[:, 6:8] = np.eye(2), -np.eye(2)
    S = H @ joint.covariance @ H.T
    K = joint.covariance @ H.T @ np.linalg.inv(S)
    found = joint.condition(1, 3)
    assert found.mean.ravel() == pytest.approx(joint.mean.ravel() - K @ H @ joint.mean.ravel())
    assert found.covariance == pytest.approx(joint.covariance - K @ S @ K.T)


def test_a_common_error_is_estimated_by_the_first_pair_and_the_others_follow():
    shift = 2.0
    old = [(0.0, 0.0), (5.0, 1.0), (9.0, 4.0)]
    new = [(x + shift, y) for x, y in old]
    joint = _joint([*old, *new], sd=0.02, common=3.0)
    one, two = (each.ravel() for each in np.meshgrid([3, 4, 5], [0, 1, 2], indexing="ij"))
    found = grow_alignment(joint, (one, two), [(3, 0)], np.inf)
    assert {(pair.first, pair.second) for pair in found.pairs} == {(3, 0), (4, 1), (5, 2)}
    assert found.pairs[0].sd > 1.0 > found.pairs[1].sd
    for pair in found.pairs:
        joint = joint.condition(pair.first, pair.second)
    assert found.mean == pytest.approx(joint.mean)


def test_two_equal_partners_block_each_other_and_fragments_of_one_landmark_do_not():
    joint = _joint([(0.0, 0.0), (0.14, 0.0), (-0.14, 0.0)], sd=0.05)
    one, two = np.array([0, 0]), np.array([1, 2])
    rivals = joint._replace(apart=joint.apart.copy())
    rivals.apart[1, 2] = rivals.apart[2, 1] = True
    waits = grow_pairs(rivals, (one, two))
    assert not waits.pairs
    fragments = grow_pairs(joint, (one, two))
    assert len(fragments.pairs) == 1


def test_landmarks_of_one_scan_are_never_merged_and_merged_ones_inherit_this():
    joint = _joint([(0.0, 0.0), (0.02, 0.0), (0.01, 0.0)], sd=0.05)
    joint.apart[0, 1] = joint.apart[1, 0] = True
    found = grow_pairs(joint, (np.array([0, 1, 0]), np.array([2, 2, 1])))
    assert len(found.pairs) <= 1
    after = joint.condition(0, 2)
    assert after.apart[2, 1]
    assert after.apart[1, 2]


def test_landmarks_of_one_window_need_more_evidence_and_merged_ones_inherit_this():
    joint = _joint([(0.0, 0.0), (0.2, 0.0), (0.4, 0.0)], sd=0.08)
    one, two = np.array([0]), np.array([1])
    llr = joint.evaluate(one, two).llr[0]
    assert (
        PROFILE_JOINT_COMPATIBILITY.llr_tight < llr < PROFILE_JOINT_COMPATIBILITY.llr_tight + SPLIT
    )
    split = np.zeros((3, 3), np.bool_)
    split[0, 1] = split[1, 0] = True
    for beside, merged in ((None, 1), (split, 0)):
        found = grow_pairs(joint._replace(apart_in_window=beside), (one, two))
        assert len(found.pairs) == merged
    after = joint._replace(apart_in_window=split).condition(1, 2).apart_in_window
    assert after[0, 2]
    assert after[2, 0]


DENSE = AssociationProfile(slack=0.0, density=1.0)
TWINS = [(0.0, 0.0), (0.2, 0.0), (3.0, 1.0), (3.0, 1.2)]


def _twins(seen: list[int], common: float) -> tuple[Joint, np.ndarray, np.ndarray]:
    n, m = len(TWINS), len(seen)
    points = np.array([*TWINS, *(TWINS[k] for k in seen)])
    covariance = 0.01**2 * np.eye(2 * (n + m))
    both = np.zeros((2 * (n + m), 2))
    both[2 * n :: 2, 0] = both[2 * n + 1 :: 2, 1] = common
    apart = np.zeros((n + m, n + m), np.bool_)
    apart[:n, :n] = apart[n:, n:] = True
    np.fill_diagonal(apart, False)
    one, two = np.meshgrid(np.arange(n, n + m), np.arange(n), indexing="ij")
    return Joint(points, covariance + both @ both.T, apart, DENSE), one.ravel(), two.ravel()


def test_neighbours_are_distinguished_jointly_where_each_by_itself_is_not():
    joint, one, two = _twins([0, 1, 2, 3], common=0.15)
    alone = grow_pairs(joint, (one, two))
    assert not alone.pairs
    found = assign_jointly(joint, one, two, 0.5)
    assert sorted((p.first, p.second) for p in found.pairs) == [(4, 0), (5, 1), (6, 2), (7, 3)]


def test_a_few_uncertain_landmarks_that_fit_others_by_chance_are_not_merged():
    known = np.array([(0.0, 0.0), (4.0, 1.0), (1.0, 5.0)])
    profile = AssociationProfile(slack=0.0, density=0.006, same=1.0)
    for count, sd, merged in ((2, 0.3, 0), (2, 0.05, 2), (3, 0.3, 3)):
        points = np.concatenate([known, known[:count] + np.array([1.0, -0.5])])
        n = len(points)
        shift = np.zeros((2 * n, 2))  # a common error of 1 m of all repeated landmarks
        shift[6::2, 0] = shift[7::2, 1] = 1.0
        seen = np.arange(n) >= len(known)
        apart = (seen[:, None] == seen) & ~np.eye(n, dtype=np.bool_)
        joint = Joint(points, sd**2 * np.eye(2 * n) + shift @ shift.T, apart, profile)
        one, two = (each.ravel() for each in np.meshgrid(np.arange(3, n), np.arange(3)))
        found = assign_jointly(joint, one, two, 2.0)
        assert [(p.first, p.second) for p in found.pairs] == [(3 + k, k) for k in range(merged)]


@pytest.mark.parametrize(("heading_sigma", "merged"), [(0.06, 3), (0.2, 0)])
def test_far_landmarks_are_merged_that_near_ones_make_certain(heading_sigma, merged):
    """Three landmarks seen again at 4, 6 and 8 m under an error of the heading. The nearest one
    alone is too little evidence; the others are uncertain by more than `most_sd` until it is
    merged.
    """
    known, most_sd = np.array([(4.0, 0.0), (0.0, 6.0), (-8.0, 0.0)]), 0.35
    profile = AssociationProfile(slack=0.03, density=0.05, same=0.5)
    turned = np.zeros((12, 1))  # by one standard deviation of the heading
    turned[6:, 0] = (heading_sigma * known[:, ::-1] * [-1.0, 1.0]).ravel()
    points = np.concatenate([known, known + turned[6:].reshape(-1, 2)])
    seen = np.arange(6) >= 3
    apart = (seen[:, None] == seen) & ~np.eye(6, dtype=np.bool_)
    joint = Joint(points, 0.08**2 * np.eye(12) + turned @ turned.T, apart, profile)
    one, two = (each.ravel() for each in np.meshgrid(np.arange(3, 6), np.arange(3)))
    at = joint.evaluate(np.arange(3, 6), np.arange(3))
    assert at.llr[0] < profile.llr_loose
    assert at.sd[1:].min() > most_sd
    found = assign_jointly(joint, one, two, most_sd)
    assert [(p.first, p.second) for p in found.pairs] == [(3 + k, k) for k in range(merged)]


def test_a_pair_that_only_a_doubtful_pair_makes_certain_is_evaluated_without_it():
    twins_and_another = [(0.0, 0.0), (0.25, 0.0), (3.0, 1.0)]
    points = np.array([*twins_and_another, (0.12, 0.0), (3.0, 1.0)])  # the first is either twin
    shift = np.zeros((10, 2))  # a common error of 1 m of all repeated landmarks
    shift[6::2, 0] = shift[7::2, 1] = 1.0
    seen = np.arange(5) >= 3
    apart = (seen[:, None] == seen) & ~np.eye(5, dtype=np.bool_)
    covariance = 0.05**2 * np.eye(10) + shift @ shift.T
    one, two = (each.ravel() for each in np.meshgrid([3, 4], [0, 1, 2], indexing="ij"))
    for density, merged in ((0.05, []), (0.006, [(4, 2)])):
        profile = AssociationProfile(slack=0.0, density=density, same=0.1)
        joint = Joint(points, covariance, apart, profile)
        found = assign_jointly(joint, one, two, 2.0)
        assert [(p.first, p.second) for p in found.pairs] == merged
        assert all(p.sd > 1.0 for p in found.pairs), "it is known to a metre, whatever the first is"
