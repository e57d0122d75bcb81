"""Classes of landmarks: their evidence, the gate, and votes among compatible ones."""

import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.estimation.association.classes import compare_classes, stack_classes
from teamslam.team.estimation.association.gating import Joint, evaluate_pairs, gate_pairs
from teamslam.team.estimation.association.joint_compatibility import condition_on_pair
from teamslam.team.estimation.association.voting import PointSet, propose_alignments

P = 0.99


def reported(classes: list[int], count: int = 3) -> np.ndarray:
    rows = np.full((len(classes), count), np.log((1.0 - P) / (count - 1)))
    rows[np.arange(len(classes)), classes] = np.log(P)
    return rows


def test_the_evidence_is_that_of_the_posterior_over_equally_frequent_classes() -> None:
    one, two = reported([0, 0, 2]), reported([0, 1, 2])
    q = (1.0 - P) / 2.0
    same, different = 3.0 * (P * P + 2.0 * q * q), 3.0 * (2.0 * P * q + q * q)
    assert np.allclose(compare_classes(one, two), np.log([same, different, same]))
    unknown = np.zeros((3, 3))
    assert np.allclose(compare_classes(one, unknown), 0.0)
    assert np.allclose(compare_classes(one, two), compare_classes(one + 7.0, two - 90.0))


def test_rows_without_classes_and_with_fewer_are_stacked() -> None:
    assert stack_classes([(2, None), (3, np.empty((3, 0)))]) is None
    found = stack_classes([(1, None), (1, reported([1], 2)), (1, reported([2]))])
    assert found is not None
    assert found[0].tolist() == [0.0, 0.0, 0.0]
    assert np.allclose(found[1], np.log([1.0 - P, P, 1.0 - P]))


def joint(classes: np.ndarray | None) -> Joint:
    mean = np.array([[0.0, 0.0], [0.02, 0.0], [5.0, 0.0]])
    return Joint(mean, 1e-4 * np.eye(6), np.zeros((3, 3), np.bool_), classes=classes)


def test_landmarks_of_contradicting_classes_are_not_in_the_gate() -> None:
    profile = AssociationProfile()
    pair = np.array([0]), np.array([1])
    plain = evaluate_pairs(joint(None), *pair, profile)
    alike = evaluate_pairs(joint(reported([1, 1, 0])), *pair, profile)
    assert plain.chi2 == alike.chi2
    assert alike.llr - plain.llr == pytest.approx(compare_classes(reported([1]), reported([1])))
    assert len(gate_pairs(joint(reported([1, 1, 0])), *pair, profile)[0]) == 1
    assert len(gate_pairs(joint(reported([1, 2, 0])), *pair, profile)[0]) == 0
    assert len(gate_pairs(joint(None), *pair, profile)[0]) == 1


def test_a_merged_landmark_has_the_evidence_of_both() -> None:
    before = joint(reported([1, 1, 0]))
    after = condition_on_pair(before, 0, 1, AssociationProfile())
    assert before.classes is not None
    assert after.classes is not None
    assert np.array_equal(after.classes[1], before.classes[0] + before.classes[1])
    assert np.array_equal(before.classes[1], reported([1])[0])


def test_of_two_places_of_equal_shape_the_one_of_equal_classes_gets_the_votes() -> None:
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
