"""The part of a landmark's error that stays the same within a window."""

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.core import landmarks_along_paths
from teamslam.team.estimation.hybrid_slam.fastslam import Noise
from teamslam.team.estimation.models import predicted
from teamslam.team.estimation.scans import unclaimed

PATH = np.array([[0.0, 0.0, 0.1], [0.5, 0.2, 0.3], [1.1, 0.3, -0.2], [1.4, 0.9, 0.5]])
LANDMARK = np.array([4.0, 2.5])
IDS = np.array([7], np.uint32)


def measurements(rng: np.random.Generator) -> np.ndarray:
    seen = np.array([predicted(pose, LANDMARK) for pose in PATH])
    return seen + rng.normal(size=(4, 2)) * [0.05, 0.01] + rng.normal(size=2) * [0.1, 0.02]


def dense(noise: Noise, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Generalised least squares with the full correlation matrix of the window's measurements."""
    n = len(PATH)
    shared = np.ones((n, n))
    R = np.zeros((2 * n, 2 * n))
    r, b = noise.range_variance, noise.bearing_variance
    R[::2, ::2] = r * (noise.range_white * np.eye(n) + (1 - noise.range_white) * shared)
    R[1::2, 1::2] = b * (noise.bearing_white * np.eye(n) + (1 - noise.bearing_white) * shared)
    W = np.linalg.inv(R)
    point = LANDMARK.copy()
    for _ in range(20):
        expected = [predicted(pose, point) for pose in PATH]
        H = np.vstack([core.predict(pose, point[None])[2][0] for pose in PATH])
        information = H.T @ W @ H
        point = point + np.linalg.solve(information, H.T @ W @ (seen - expected).ravel())
    return point, np.linalg.inv(information)


@pytest.mark.parametrize(("range_white", "bearing_white"), [(1.0, 1.0), (0.2, 0.5), (1.0, 0.3)])
def test_a_constant_error_within_a_window_equals_least_squares_with_its_correlation_matrix(
    range_white: float, bearing_white: float
) -> None:
    noise = Noise(0.0125, 0.0, range_white, 5e-4, bearing_white)
    seen = measurements(np.random.default_rng(3))
    means, covariances = landmarks_along_paths(
        IDS,
        LANDMARK.reshape(1, 1, 2) + 0.05,
        np.array([[[1.0, 0.0, 1.0]]]),
        PATH[:, None, :],
        np.arange(4),
        IDS.repeat(4),
        seen,
        unclaimed(4),
        noise,
    )
    point, covariance = dense(noise, seen)
    np.testing.assert_allclose(means[0, 0], point, atol=1e-4)
    expected = covariance[[0, 0, 1], [0, 1, 1]]
    np.testing.assert_allclose(covariances[0, 0], expected, rtol=2e-3, atol=1e-7)


def test_repeating_a_measurement_leaves_the_constant_part_of_its_error() -> None:
    sizes = []
    for repeats in (1, 1000):
        _, covariances = landmarks_along_paths(
            IDS,
            LANDMARK.reshape(1, 1, 2),
            np.array([[[1.0, 0.0, 1.0]]]),
            PATH[:1, None, :],
            np.zeros(repeats, dtype=np.int64),
            IDS.repeat(repeats),
            np.tile(predicted(PATH[0], LANDMARK), (repeats, 1)),
            unclaimed(repeats),
            Noise(0.0125, 0.0, 0.2, 5e-4, 0.5),
        )
        xx, xy, yy = covariances[0, 0]
        sizes.append(xx * yy - xy * xy)
    assert sizes[1] / sizes[0] == pytest.approx(0.8 * 0.5, rel=2e-3)
