import numpy as np
import pytest

from teamslam.team.estimation import dense

SHAPES = [
    ((3,), (3,)),
    ((3, 4), (4,)),
    ((4,), (4, 2)),
    ((9, 11), (11, 600)),
    ((5, 2, 3), (3, 2)),
    ((2, 3), (5, 3, 2)),
    ((5, 2, 3), (5, 3, 4)),
    ((2, 1, 2, 3), (5, 3, 2)),
    ((4, 3), (5, 3, 2)),
    ((5, 2, 3), (3,)),
    ((0, 3), (3, 2)),
    ((2, 0), (0, 2)),
]


def _drawn(shape: tuple[int, ...], seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize(("one", "other"), SHAPES)
def test_a_product_is_that_of_numpy(one, other):
    a, b = _drawn(one), _drawn(other, 4)
    found = dense.product(a, b)
    assert found.shape == (a @ b).shape
    np.testing.assert_allclose(found, a @ b, rtol=1e-12, atol=1e-13)


def test_solutions_are_those_of_numpy():
    A = _drawn((6, 4, 4))
    for B in (_drawn((6, 4, 2), 5), _drawn((4, 2), 5)):
        np.testing.assert_allclose(dense.solve(A, B), np.linalg.solve(A, B), rtol=1e-9)
    b = _drawn((4,), 5)
    np.testing.assert_allclose(dense.solve(A[0], b), np.linalg.solve(A[0], b), rtol=1e-9)
    np.testing.assert_allclose(dense.inverse(A), np.linalg.inv(A), rtol=1e-9)
    needs_exchange = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert (dense.inverse(needs_exchange) == needs_exchange).all()
    with pytest.raises(np.linalg.LinAlgError):
        dense.inverse(np.zeros((2, 2)))


@pytest.mark.parametrize("n", [0, 1, 9, 31, 32, 70, 130])
def test_factors_are_those_of_numpy(n):
    P = _drawn((n, n + 21))
    P = P @ P.T
    L = dense.cholesky(P)
    np.testing.assert_allclose(L, np.linalg.cholesky(P), rtol=1e-9, atol=1e-12)
    inverse = dense.inverse_of_factored(L)
    assert (inverse == inverse.T).all()
    np.testing.assert_allclose(inverse, np.linalg.inv(P), rtol=1e-9, atol=1e-12)
    for B in (_drawn((n,), 5), _drawn((n, 2), 5), _drawn((n, 100), 5)):
        np.testing.assert_allclose(L @ dense.forward(L, B), B, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(P @ dense.solve_factored(L, B), B, rtol=1e-8, atol=1e-8)
