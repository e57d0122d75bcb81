"""The gates: distances, scans of detections, and pairs of landmarks."""

import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation.association.gating import (
    Joint,
    compute_mahalanobis,
    evaluate_pairs,
    match_best_first,
    match_scan,
)
from teamslam.team.estimation.association.scans import UNASSIGNED


def test_distances_and_determinants_are_those_of_the_matrix_inverse():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(4, 3, 2, 2))
    S = roots @ roots.transpose(0, 1, 3, 2) + 0.1 * np.eye(2)
    d = rng.normal(size=(4, 3, 2))
    squared, determinants = compute_mahalanobis(d, S)
    assert np.allclose(squared, np.einsum("abi,abij,abj->ab", d, np.linalg.inv(S), d))
    assert np.allclose(determinants, np.linalg.det(S))


def test_the_best_pair_comes_first_and_each_is_matched_once():
    squared = np.array([[1.0, 0.5], [2.0, 0.1], [30.0, 40.0]])
    assert match_best_first(squared < 13.8, squared).tolist() == [0, 1, UNASSIGNED]


def test_a_name_matches_at_any_distance_and_only_its_own_landmark():
    points = np.array([(9.0, 0.0), (0.0, 0.0), (5.0, 0.0)])
    names, mapped = np.array([7, 8, UNASSIGNED]), np.array([UNASSIGNED, 7, UNASSIGNED])
    seen = np.array([(0.0, 0.0), (1.0, 0.0), (5.0, 0.1)])
    small = np.tile(0.01 * np.eye(2), (3, 1, 1))
    found = match_scan(points, small, names, (seen, small), mapped, AssociationSettings())
    assert found.tolist() == [1, UNASSIGNED, 2]


def test_a_pairs_likelihood_is_that_of_its_difference_against_a_stray_landmark():
    profile = AssociationProfile(slack=0.0)
    points = np.array([(0.0, 0.0), (0.1, -0.05)])
    joint = Joint(points, 0.01 * np.eye(4), np.zeros((2, 2), np.bool_))
    at = evaluate_pairs(joint, np.array([0]), np.array([1]), profile)
    S = 0.02 * np.eye(2)
    d = np.array([-0.1, 0.05])
    chi2 = d @ np.linalg.solve(S, d)
    density = np.exp(-0.5 * chi2) / (2.0 * np.pi * np.sqrt(np.linalg.det(S)))
    assert at.chi2[0] == pytest.approx(chi2)
    assert at.llr[0] == pytest.approx(np.log(density / profile.density))
    assert at.sd[0] == pytest.approx(np.sqrt(0.02))
