"""The consistency shown during a launch equals figures computed independently."""

import numpy as np
import pytest
from scipy.stats import chi2

from teamslam.sim.launch.truth import LiveErrors
from teamslam.team import translate
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Outgoing
from tests import build
from tests.sim.logs import samples
from tests.support import fused_map

SECOND = 1_000_000_000
COVARIANCE = np.array([[0.09, 0.01, 0.0], [0.01, 0.04, 0.005], [0.0, 0.005, 0.01]])


def pose(at_s: float, xyt: np.ndarray) -> m.PoseEstimate:
    return build.pose_estimate(
        stamp_ns=round(at_s * SECOND), pose=from_floats(xyt), covariance=from_floats(COVARIANCE)
    )


def truth(seconds: list[float], poses: np.ndarray) -> m.Truth:
    stamps = [round(s * SECOND) for s in seconds]
    return build.truth(stamp_ns=stamps[-1], stamps=from_stamps(stamps), poses=from_floats(poses))


def line(seconds: list[float]) -> np.ndarray:
    """Drives along x with 1 m/s and turns by 1 rad/s through the cut of the circle."""
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


def test_poses_given_the_map_replace_those_of_the_robot_alone():
    errors, far = LiveErrors(), np.array([9.0, 9.0, 0.0])
    seconds = [float(s) for s in range(6)]
    errors.take(ch.TRUTH, truth(seconds, line(seconds)))
    errors.take(ch.OWN_POSE, pose(1.0, line([1.0])[0] + far))
    assert errors.of("r1").mean > 100.0
    (given,) = samples([Outgoing(ch.TEAM_POSE, "r1", pose(1.0, far))])
    assert errors.wants(ch.TEAM_POSE, "r1", given)  # though it is of the same moment
    errors.take(ch.TEAM_POSE, pose(2.0, line([2.0])[0]))
    assert errors.of("r1").mean == pytest.approx(0.0, abs=1e-12)
    (sample,) = samples([Outgoing(ch.OWN_POSE, "r1", pose(5.0, far))])
    assert not errors.wants(ch.OWN_POSE, "r1", sample)


@pytest.mark.parametrize("joint", [True, False])
def test_the_newest_map_is_judged_by_its_joint_covariance_if_there_is_one(joint):
    errors, ids = LiveErrors(), [2, 5, 7]
    positions = np.array([[0.0, 0.0], [4.0, 1.0], [2.0, 6.0]])
    errors.take(
        ch.TRUTH_LANDMARKS,
        m.TruthLandmarks(stamp_ns=0, ids=from_ids(ids), positions=from_floats(positions)),
    )
    root = np.random.default_rng(3).normal(size=(6, 6)) * 0.1
    P = root @ root.T + 0.01 * np.eye(6)
    content = translate.covariance_bytes(P, joint=joint)
    for deviation in (np.array([5.0, 5.0]), np.array([0.1, -0.2])):
        fused = fused_map(
            stamp_ns=9,
            joint=joint,
            ids=from_ids(ids),
            means=from_floats(positions + deviation),
            covariance=content,
            chi2=3.0,
            dof=2,
        )
        errors.take(ch.FUSED_MAP, fused)
    whole = np.tile(deviation, 3)
    blocks = [P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(3)]
    alone = [deviation @ np.linalg.solve(block, deviation) for block in blocks]
    expected = whole @ np.linalg.solve(P, whole) / 6 if joint else np.mean(alone) / 2
    assert errors.landmarks.mean == pytest.approx(expected)
    assert errors.landmarks.count == 3
