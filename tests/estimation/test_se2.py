import numpy as np
from hypothesis import given, settings, strategies as st
from scipy.linalg import expm

from teamslam.team.estimation import se2

metres = st.floats(-100.0, 100.0)
angles = st.floats(-3.1, 3.1)
poses, straight = (
    st.builds(lambda x, y, t: np.array([x, y, t]), metres, metres, turns)
    for turns in (angles, st.floats(-2e-4, 2e-4))
)
quick = settings(deadline=None, max_examples=60)


def matrix(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def twist_matrix(xi):
    return np.array([[0.0, -xi[2], xi[0]], [xi[2], 0.0, xi[1]], [0.0, 0.0, 0.0]])


def assert_same_pose(actual, expected, tolerance=1e-9):
    np.testing.assert_allclose(matrix(actual), matrix(expected), atol=tolerance, rtol=1e-10)


@quick
@given(poses, poses)
def test_composition_is_the_product_of_matrices(a, b):
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)


@quick
@given(poses, poses)
def test_between_undoes_composition_and_inverse_is_between_to_zero(a, b):
    assert_same_pose(se2.between(a, se2.compose(a, b)), b)
    assert_same_pose(se2.inverse(a), se2.between(a, np.zeros(3)))


@quick
@given(poses | straight)
def test_exponential_is_that_of_the_twist_matrix_and_logarithm_its_inverse(xi):
    np.testing.assert_allclose(matrix(se2.exponential(xi)), expm(twist_matrix(xi)), atol=1e-9)
    np.testing.assert_allclose(se2.logarithm(se2.exponential(xi)), xi, atol=1e-8)


@quick
@given(poses, poses)
def test_the_adjoint_carries_a_perturbation_from_the_right_to_the_left(pose, xi):
    right = se2.compose(pose, se2.exponential(1e-3 * xi))
    left = se2.compose(se2.exponential(se2.adjoint(pose) @ (1e-3 * xi)), pose)
    assert_same_pose(right, left, tolerance=1e-7)


@quick
@given(poses, metres, metres)
def test_a_point_is_transformed_as_by_the_matrix(pose, x, y):
    np.testing.assert_allclose(
        se2.transformed(pose, np.array([x, y])), (matrix(pose) @ [x, y, 1.0])[:2], atol=1e-9
    )


@quick
@given(st.floats(-50.0, 50.0))
def test_a_wrapped_angle_is_the_same_direction_in_the_half_open_turn(angle):
    wrapped = se2.wrapped(angle)
    assert -np.pi < wrapped <= np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-12)
