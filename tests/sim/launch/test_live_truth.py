import numpy as np
import pytest
from scipy.stats import chi2

from teamslam.sim.launch.live_errors import LiveErrors
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from tests import build

SECOND = 1_000_000_000
COVARIANCE = np.array([[0.09, 0.01, 0.0], [0.01, 0.04, 0.005], [0.0, 0.005, 0.01]])


def pose(at_s: float, xyt: np.ndarray) -> m.PoseEstimate:
    return build.pose_estimate(stamp_ns=round(at_s * SECOND), pose=xyt, covariance=COVARIANCE)


def truth(seconds: list[float], poses: np.ndarray) -> m.Truth:
    stamps = [round(s * SECOND) for s in seconds]
    return build.truth(stamp_ns=stamps[-1], stamps=stamps, poses=poses)


def line(seconds: list[float]) -> np.ndarray:
    return np.array([[s, 0.0, (3.0 + s + np.pi) % (2 * np.pi) - np.pi] for s in seconds])


def test_the_nees_of_poses_is_against_the_truth_between_its_samples():
    errors, rng = LiveErrors(), np.random.default_rng(1)
    seconds = [float(s) for s in range(6)]
    expected = []
    for at in (0.5, 1.75, 3.0, 4.25):
        deviation = np.linalg.cholesky(COVARIANCE) @ rng.standard_normal(3)
        errors.take(ch.OWN_POSE, pose(at, line([at])[0] + deviation))
        expected.append(deviation @ np.linalg.solve(COVARIANCE, deviation))
    errors.take(ch.TRUTH, truth(seconds[:4], line(seconds[:4])))
    assert errors.of("r1").count == 3  # the last one's truth is not there yet
    errors.take(ch.TRUTH, truth(seconds[4:], line(seconds[4:])))
    tally = errors.of("r1")
    assert tally.mean == pytest.approx(np.mean(expected) / 3)
    assert tally.coverage == np.mean(np.array(expected) <= chi2.ppf(0.95, 3))
