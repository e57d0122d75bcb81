from dataclasses import replace

import numpy as np
import pytest

from teamslam.team.config import AssociationSettings
from teamslam.team.estimation.association.clustering import associate_window
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    Scans,
    points_of,
    relative_to,
    rotations,
)
from teamslam.team.estimation.association.smoothing import smooth_window

SETTINGS = AssociationSettings()
MOTION_NOISE = np.diag([0.02, 0.01, 0.01]) ** 2
RANGE_M, VIEW_M = 0.05, 6.0


def path_of(motions: np.ndarray) -> np.ndarray:
    headings = np.cumsum(motions[:, 2])
    before = np.concatenate(([0.0], headings[:-1]))
    steps = np.einsum("kij,kj->ki", rotations(before), motions[:, :2])
    return np.column_stack((np.cumsum(steps, axis=0), headings))


def window(seed, *, clutter=0.0, missed=0.0, spacing=2.0, steps=25, slip=None):
    """(scans, landmark of each detection) of a drive through a grid of landmarks."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(-4, 12), np.arange(-4, 5)), -1).reshape(-1, 2) * spacing
    landmarks = grid[rng.random(len(grid)) < 0.5] + 0.1 * rng.normal(size=(1, 2))
    true = np.tile([0.4, 0.0, 0.05], (steps, 1))
    poses = path_of(true)
    measured = true + rng.normal(size=true.shape) * np.sqrt(np.diag(MOTION_NOISE))
    if slip is not None:
        measured[slip[0]] += slip[1]
    keyframes, points, labels = [], [], []
    for k, pose in enumerate(poses):
        seen = relative_to(np.tile(pose, (len(landmarks), 1)), landmarks)
        near = np.hypot(*seen.T) < VIEW_M
        for label in np.nonzero(near & (rng.random(len(near)) >= missed))[0]:
            keyframes.append(k)
            points.append(seen[label] + RANGE_M * rng.normal(size=2))
            labels.append(label)
        for _ in range(rng.poisson(clutter * near.sum())):
            keyframes.append(k)
            points.append(rng.uniform(-VIEW_M, VIEW_M, 2))
            labels.append(UNASSIGNED)
    n = len(points)
    scans = Scans(
        measured,
        np.tile(MOTION_NOISE, (steps, 1, 1)),
        np.array(keyframes),
        np.array(points),
        np.tile(RANGE_M**2 * np.eye(2), (n, 1, 1)),
        np.full(n, UNASSIGNED),
    )
    return scans, np.array(labels)


def pairs(found: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    real = labels != UNASSIGNED
    found, labels = found[real], labels[real]
    same = labels[:, None] == labels[None]
    said = (found[:, None] == found[None]) & (found[:, None] != UNASSIGNED)
    np.fill_diagonal(same, False)
    np.fill_diagonal(said, False)
    return (same & said).sum() / said.sum(), (same & said).sum() / same.sum()


@pytest.mark.parametrize("seed", range(3))
def test_a_window_of_separate_landmarks_is_associated_without_an_error(seed):
    scans, labels = window(seed, clutter=0.2, missed=0.1)
    result = associate_window(scans, SETTINGS)
    precision, recall = pairs(result.landmark_of, labels)
    assert precision == 1.0
    assert recall > 0.95
    kept_clutter = (result.landmark_of != UNASSIGNED) & (labels == UNASSIGNED)
    assert kept_clutter.sum() < 0.2 * (labels == UNASSIGNED).sum()


def test_one_scan_never_sees_a_landmark_twice():
    scans, _ = window(1, clutter=0.5, spacing=0.5)
    result = associate_window(scans, SETTINGS)
    used = result.landmark_of != UNASSIGNED
    seen = list(zip(scans.keyframes[used], result.landmark_of[used], strict=True))
    assert len(seen) == len(set(seen))
    assert result.seen.sum() == len(seen)
    assert (result.counts == result.seen.sum(axis=1)).all()
    assert (result.counts >= SETTINGS.least_seen).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_place_that_is_observed_again_in_vain_is_clutter_and_no_landmark(seed):
    scans, labels = window(seed, clutter=0.45)
    result = associate_window(scans, SETTINGS)
    out = result.landmark_of == UNASSIGNED
    assert not result.clutter[~out].any()
    assert result.clutter[labels == UNASSIGNED].mean() > 0.85
    assert result.clutter[labels != UNASSIGNED].mean() < 0.02
    true = len(set(labels[labels != UNASSIGNED].tolist()))
    assert len(result.counts) <= true + 1, "matches by chance confirm no landmark"
    assert pairs(result.landmark_of, labels)[1] > 0.8


@pytest.mark.parametrize("reach", [0.0, 0.8])
def test_a_slip_of_the_odometry_is_reported_and_costs_no_landmark(reach):
    scans, labels = window(3, slip=(12, np.array([0.3, 0.25, 0.0])))
    result = associate_window(scans, AssociationSettings(slip_m=reach))
    recall = pairs(result.landmark_of, labels)[1]
    if not reach:
        assert recall < 0.9, "without the search the window falls into two halves"
        return
    assert recall > 0.95
    slip = max(result.slips, key=lambda each: float(np.hypot(*each.by[:2])))
    assert slip.keyframe == 12
    assert np.allclose(slip.by[:2], [-0.3, -0.25], atol=0.1)


def test_a_slip_among_as_many_new_landmarks_as_mapped_ones_is_found():
    known = np.array([[2.0, 0.5], [1.0, 2.0], [2.5, -2.0]])
    slip = np.array([0.15, 0.2])
    scans = [known] * 6 + [np.concatenate([known, known + np.array([0.0, 0.45])]) - slip] * 2
    n = sum(map(len, scans))
    still = Scans(
        np.zeros((8, 3)),
        np.tile(np.diag([0.01, 0.01, 0.01]) ** 2, (8, 1, 1)),
        np.repeat(np.arange(8), list(map(len, scans))),
        np.concatenate(scans),
        np.tile(0.03**2 * np.eye(2), (n, 1, 1)),
        np.full(n, UNASSIGNED),
    )
    result = associate_window(still, AssociationSettings(slip_m=0.6))
    assert [each.keyframe for each in result.slips] == [6]
    assert len(result.counts) == 6, "three before the slip, and three beside them since"


def test_points_carry_the_covariance_of_range_and_bearing():
    ranges, bearings = np.array([3.0]), np.array([0.7])
    variances = np.array([[0.04, 0.001, 0.0009]])
    points, covariances = points_of(ranges, bearings, variances)
    rng = np.random.default_rng(1)
    R = np.array([[0.04, 0.001], [0.001, 0.0009]]) / 100.0
    drawn = rng.multivariate_normal([3.0, 0.7], R, 100_000)
    cloud = np.column_stack((drawn[:, 0] * np.cos(drawn[:, 1]), drawn[:, 0] * np.sin(drawn[:, 1])))
    assert np.allclose(points[0], cloud.mean(axis=0), atol=1e-3)
    assert np.allclose(100.0 * np.cov(cloud.T), covariances[0], rtol=0.05, atol=1e-4)


def test_the_smoothed_window_is_consistent_and_one_with_a_quarter_of_the_covariance_is_not():
    ratios = []
    for claimed in (1.0, 0.25):
        squared = dof = 0.0
        for seed in range(6):
            scans, labels = window(seed, steps=15)
            scans = replace(scans, covariances=claimed * scans.covariances)
            _, landmark_of = np.unique(labels, return_inverse=True)
            poses = path_of(scans.motions)
            first = np.unique(landmark_of, return_index=True)[1]
            at = poses[scans.keyframes[first]]
            turned = np.einsum("nij,nj->ni", rotations(at[:, 2]), scans.points[first])
            landmarks = at[:, :2] + turned
            result = smooth_window(scans, landmark_of, poses, landmarks)
            squared, dof = squared + result.squared, dof + result.dof
        ratios.append(squared / dof)
    assert 0.9 < ratios[0] < 1.1
    assert ratios[1] > 2.0
