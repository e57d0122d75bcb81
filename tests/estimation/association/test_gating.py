"""The gate of detections: distances, best pair first, and names."""

import numpy as np

from team.config import AssociationSettings
from team.estimation.association.gating import compute_mahalanobis, match_best_first, match_scan
from team.estimation.association.scans import UNASSIGNED


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
