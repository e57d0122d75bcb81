"""The certainty of associations, against all joint associations one by one, and in windows."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from teamslam.team.config import AssociationSettings
from teamslam.team.estimation.association.certainty import estimate_view, marginals
from teamslam.team.estimation.association.clustering import associate_window
from teamslam.team.estimation.association.scans import UNASSIGNED
from tests.estimation.association.test_clustering import pairs, window


def exact(weights: np.ndarray) -> np.ndarray:
    """The marginals over every joint association, each with the product of its odds."""
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


def test_the_marginals_of_one_detection_or_one_landmark_are_exact():
    for shape in ((1, 4), (4, 1)):
        weights = np.exp(np.random.default_rng(5).normal(0.0, 2.0, shape))
        assert np.allclose(marginals(weights), exact(weights))


def test_the_density_of_a_view_is_that_of_its_detections():
    scans, _ = window(0)
    view = estimate_view(scans)
    per_scan = len(scans.points) / len(np.unique(scans.keyframes))
    assert view.farthest == pytest.approx(6.0, rel=0.1)
    assert view.density == pytest.approx(per_scan / (np.pi * 36.0), rel=0.2)


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
