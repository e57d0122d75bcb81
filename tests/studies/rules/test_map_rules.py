import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.sim.studies.rules.map_fusion import covariance_intersection, kalman
from teamslam.team import translate
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.codec import encoded
from tests import build
from tests.estimation.submap_world import correlated
from tests.support import packed, spd

END = build.end(r1=9, r2=9)
ALIVE = [build.liveliness(node=f"robot/{name}") for name in ("r1", "r2")]


def start(robot, *, known=True):
    return build.initial_pose(robot=robot, pose=from_floats(np.zeros(3)) if known else b"")


def estimate(robot, sequence, ids=(1, 2), at=0.0, *, joint=True):
    n = 2 * len(ids)
    content = packed(spd(n)) if joint else from_floats([2.0, 0.5, 1.0] * len(ids))
    means = from_floats(at + np.arange(n))
    stamp_ns = sequence * 10**9
    return build.map_estimate(
        stamp_ns=stamp_ns,
        robot=robot,
        sequence=sequence,
        joint=joint,
        ids=ids,
        means=means,
        covariance=content,
    )


def done(robot, last_map):
    return build.done(stamp_ns=9, robot=robot, measurements=9, steps=3, last_map=last_map)


def value(message):
    return LandmarkGaussian(
        *translate.landmarks_of(message), translate.landmark_covariance_of(message)
    )


def heard(rule, messages, robots=("r1", "r2"), **options):
    node, out = make_centre(CentralConfig(fusion=rule, **options), robots), []
    for message in messages:
        out += node.handle(message)
    return node, out


LAST = [estimate("r1", 4, at=1.0), estimate("r2", 6, (2, 3), at=5.0)]
TEAM = [
    *(start(x) for x in ("r1", "r2")),
    *ALIVE,
    estimate("r1", 2),
    estimate("r2", 3, (3,)),
    *LAST,
    done("r1", 4),
    done("r2", 6),
    END,
]


@settings(deadline=None, max_examples=40)
@given(st.permutations(range(len(TEAM))))
def test_the_final_map_is_kalmans_of_the_last_maps_in_whatever_order_they_come(order):
    node, _ = heard("latest", [TEAM[i] for i in order])
    expected = kalman([value(x) for x in LAST])
    np.testing.assert_array_equal(translate.landmarks_of(node.final)[0], expected.ids)
    np.testing.assert_array_equal(translate.landmarks_of(node.final)[1], expected.means)
    covariance = translate.landmark_covariance_of(node.final)
    np.testing.assert_allclose(covariance, expected.covariance, rtol=1e-12)
    assert node.final.members == build.version(r1=4, r2=6)
    assert encoded(node.final) == encoded(heard("latest", TEAM)[0].final)


@pytest.mark.parametrize("rule", ["latest", "alone"])
def test_a_robot_that_is_lost_leaves_the_map_that_it_has_sent(rule):
    messages = [x for x in TEAM if x != LAST[1] and x != done("r2", 6)]
    node, _ = heard(rule, messages)
    assert not node.finished
    node.handle(build.liveliness(node="robot/r2", alive=False))
    assert not node.finished
    node.handle(build.given_up(node="robot/r2", reason="it fell into the water"))
    assert (node.final.lost, node.final.provisional) == (("r2",), True)
    assert node.final.members[1] == m.VersionEntry(robot="r2", incarnation=1, sequence=3)


def test_a_map_in_a_frame_of_its_own_is_left_out_and_named():
    free = [start("r2", known=False) if x == start("r2") else x for x in TEAM]
    node, _ = heard("latest", free)
    assert node.final.members == build.version(r1=4)
    assert node.final.means == LAST[0].means
    assert node.final.reasons == ("r2: its start pose is not known",)


def one(x, variance, id_=1):
    return LandmarkGaussian(
        np.array([id_], np.uint32), np.array([[x, 0.0]]), np.diag([variance, 1.0])
    )


def random_map(ids, seed, sigma=1.0):
    rng = np.random.default_rng(seed)
    n = 2 * len(ids)
    return LandmarkGaussian(
        np.array(ids, np.uint32), rng.normal(size=(len(ids), 2)), correlated(np.full(n, sigma), rng)
    )


def test_the_intersection_of_crossed_ellipses_meets_in_the_middle():
    a = LandmarkGaussian(np.array([1], np.uint32), np.array([[1.0, 0.0]]), np.diag([1.0, 4.0]))
    b = LandmarkGaussian(np.array([1], np.uint32), np.array([[0.0, 1.0]]), np.diag([4.0, 1.0]))
    fused = covariance_intersection([a, b])
    np.testing.assert_allclose(fused.covariance, 1.6 * np.eye(2), atol=1e-6)
    np.testing.assert_allclose(fused.means, [[0.8, 0.8]], atol=1e-6)


def test_kalman_equals_the_sum_of_the_information_of_maps_that_overlap():
    a, b, c = random_map([1, 2, 5], 2), random_map([2, 3, 5], 3, 0.5), random_map([3, 4], 4)
    information, vector = np.zeros((10, 10)), np.zeros(10)
    for each in (a, b, c):
        place = np.concatenate([2 * (id_ - 1) + np.arange(2) for id_ in each.ids.astype(int)])
        own = np.linalg.inv(each.covariance)
        information[np.ix_(place, place)] += own
        vector[place] += own @ each.means.ravel()
    fused = kalman([a, b, c])
    covariance = np.linalg.inv(information)
    np.testing.assert_array_equal(fused.ids, [1, 2, 3, 4, 5])
    np.testing.assert_allclose(fused.covariance, covariance, atol=1e-10)
    np.testing.assert_allclose(fused.means.ravel(), covariance @ vector, atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32))
def test_the_intersection_holds_for_inputs_that_share_their_error(seed):
    """For any joint error with these marginals, the claimed covariance is at least the true one."""
    rng = np.random.default_rng(seed)
    n = 4
    joint = correlated(rng.uniform(0.5, 2.0, 2 * n), rng)
    shared = rng.normal(size=(2 * n, 2))
    joint += shared @ shared.T
    P_a, P_b = joint[:n, :n], joint[n:, n:]
    ids = np.array([1, 2], np.uint32)
    x = rng.normal(size=2 * n)

    def fused_mean(errors):
        return covariance_intersection(
            [
                LandmarkGaussian(ids, errors[:n].reshape(-1, 2), P_a),
                LandmarkGaussian(ids, errors[n:].reshape(-1, 2), P_b),
            ]
        )

    claimed = fused_mean(x).covariance
    weights = np.array([fused_mean(unit).means.ravel() for unit in np.eye(2 * n)]).T
    true = weights @ joint @ weights.T
    assert np.linalg.eigvalsh(claimed - true)[0] > -1e-8
