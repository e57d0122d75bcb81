import numpy as np
import pytest
from msgspec.structs import replace

from teamslam.team import core
from teamslam.team.config import Bounds, Sensor
from teamslam.team.core import Scan, landmarks_along_paths, predicted
from teamslam.team.estimation.models import POINT, POLAR, noise_of, stream_bounds, unclaimed
from teamslam.team.rejection import BY_CORE, Rejection
from tests.estimation.hybrid_slam import one_landmark

POSE = np.array([0.5, -1.0, 0.7])
MEAN, SPREAD = np.array([3.0, 2.0]), np.array([[0.3, 0.1], [0.1, 0.2]])
CLAIM = np.array([0.05, -0.03, 0.08])
SENSOR = (0.01, 0.0, 4e-4)
IDS = np.array([7], np.uint32)


def packed(P: np.ndarray) -> np.ndarray:
    return np.array([P[0, 0], P[0, 1], P[1, 1]])


def full(p: np.ndarray) -> np.ndarray:
    return np.array([[p[0], p[1]], [p[1], p[2]]])


def turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def polar(*parts: np.ndarray) -> Scan:
    return Scan.polar(*(part.tobytes() for part in parts))


def updated(scan) -> tuple[np.ndarray, np.ndarray]:
    seen = scan.ranges, scan.bearings
    return one_landmark.updated(MEAN, packed(SPREAD), POSE, seen, SENSOR, scan.own)[:2]


def test_points_near_with_much_noise_place_a_landmark_without_a_bias():
    rng = np.random.default_rng(5)
    truth, sigma, count = np.array([0.6, 0.2]), 0.2, 4000
    points = truth + sigma * rng.standard_normal((count, 2))
    claims = np.tile([sigma**2, 0.0, sigma**2], (count, 1))
    scan = Scan.points(bytes(4 * count), points.tobytes(), claims.tobytes())
    polar = np.column_stack((scan.ranges, scan.bearings))
    found = {}
    for form in (POINT, POLAR):
        own = np.column_stack((scan.own[:, :3], np.full(count, form)))
        means, covariances = landmarks_along_paths(
            IDS, truth.reshape(1, 1, 2), np.array([[[1.0, 0.0, 1.0]]]), np.zeros((1, 1, 3)),
            np.zeros(count, np.int64), IDS.repeat(count), polar, own, noise_of(Sensor()),
        )  # fmt: skip
        error = means[0, 0] - truth
        found[form] = error @ np.linalg.inv(full(covariances[0, 0])) @ error
    assert found[POINT] < 13.8, "chi-square of two, 99.9 %"
    assert found[POLAR] > 50.0, "as range and bearing they read too far: the test has power"


@pytest.mark.parametrize("has_own", [True, False])
@pytest.mark.parametrize("whites", [(1.0, 1.0), (0.4, 1.0), (0.5, 0.3)])
def test_landmarks_along_paths_are_least_squares_with_the_windows_correlations(whites, has_own):
    rng = np.random.default_rng(2)
    path = np.column_stack((np.arange(5.0), 0.1 * np.arange(5.0), 0.2 * np.arange(5.0)))
    truth = np.array([4.0, 6.0])
    z = np.array([predicted(pose, truth) for pose in path])
    A = rng.normal(size=(5, 2, 2)) * np.array([0.2, 0.03])[:, None]
    R = A @ A.transpose(0, 2, 1) * has_own + np.diag([0.01, 4e-4])
    z = z + 0.3 * np.array([np.linalg.cholesky(each) @ rng.normal(size=2) for each in R])
    own = np.array([[*packed(each), POLAR] for each in R]) if has_own else unclaimed(5)
    sensor = Sensor(range_sigma=0.1, bearing_sigma=0.02)
    noise = noise_of(replace(sensor, range_white=whites[0], bearing_white=whites[1]))
    means, covariances = landmarks_along_paths(
        IDS, truth.reshape(1, 1, 2) + 0.02, np.array([[[1.0, 0.0, 1.0]]]), path[:, None, :],
        np.arange(5), IDS.repeat(5), z, own, noise,
    )  # fmt: skip
    share = np.sqrt(np.array(whites))
    W = np.zeros((10, 10))
    constant = (1.0 - np.array(whites)) * np.diag(R[-1])
    for i in range(5):
        for j in range(5):
            block = R[i] * np.outer(share, share) if i == j else 0.0
            W[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = block + np.diag(constant)
    W = np.linalg.inv(W)
    point = truth.copy()
    for _ in range(20):
        h = np.array([predicted(pose, point) for pose in path])
        H = np.vstack([core.predict(pose, point[None])[2][0] for pose in path])
        information = H.T @ W @ H
        point = point + np.linalg.solve(information, H.T @ W @ (z - h).ravel())
    np.testing.assert_allclose(means[0, 0], point, atol=2e-4)
    np.testing.assert_allclose(full(covariances[0, 0]), np.linalg.inv(information), rtol=5e-3)


def test_a_claim_is_carried_to_another_pose_as_the_plane_turns():
    scan = Scan.points(IDS.tobytes(), np.array([2.0, 1.0]).tobytes(), CLAIM.tobytes())
    seen = scan.ids, scan.ranges, scan.bearings
    larger = Scan(*seen, scan.own * [3.0, 3.0, 3.0, 1.0])
    back = np.array([0.3, -0.4, 0.5])
    to = back[:2] + turn(back[2]) @ [2.0, 1.0]
    reduced = core.reduce_scans([scan], back[None])
    turned = turn(back[2]) @ full(CLAIM) @ turn(back[2]).T
    expected = Scan.points(IDS.tobytes(), to.tobytes(), packed(turned).tobytes())
    assert reduced.ids.tolist() == IDS.tolist()
    for name in ("ranges", "bearings", "own"):
        np.testing.assert_allclose(getattr(reduced, name), getattr(expected, name))
    mean = core.reduce_scans([scan, larger], np.array([back, back])).own
    np.testing.assert_allclose(mean[0, :3], 2.0 * reduced.own[0, :3])
    mixed = core.reduce_scans([Scan(*seen), scan], np.array([back, back])).own
    np.testing.assert_array_equal(mixed, reduced.own, "the other scan has no covariances")


def test_claims_beyond_the_bounds_are_named():
    claims = np.array([[0.1, 0.0, 0.2], [1e-18, 0.0, 0.2], [0.1, 0.0, 1e30], [0.1, 0.0, np.nan]])
    scan = polar(np.arange(4, dtype=np.uint32), np.ones(4), np.zeros(4), claims)
    judge = core.StreamJudge(stream_bounds(Bounds()))
    assert judge.judge_scan(0, scan) == 0
    assert scan.ids.tolist() == [0]
    alone = polar(IDS, np.ones(1), np.zeros(1), claims[1])
    assert BY_CORE[judge.judge_scan(0, alone)] is Rejection.RANGE
