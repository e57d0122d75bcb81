import json
import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.estimation import dense
from tests.across import CLASSES
from tests.estimation import arithmetic

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


def test_a_packed_covariance_is_its_upper_triangle():
    for n in (0, 1, 4):
        P = _drawn((n, n + 2))
        P = P @ P.T
        triangle = core.packed(P)
        np.testing.assert_array_equal(triangle, P[np.triu_indices(n)])
        np.testing.assert_array_equal(core.unpacked(triangle, n), np.triu(P) + np.triu(P, 1).T)
        np.testing.assert_array_equal(core.packed(P[::-1, ::-1]), P[::-1, ::-1][np.triu_indices(n)])
    assert not np.signbit(core.unpacked(np.array([-0.0]), 1)).any()
    for n in (1, 3, 2**32):
        with pytest.raises(ValueError, match="n\\(n\\+1\\)/2"):
            core.unpacked(np.zeros(3), n)


def test_the_spread_of_a_covariance_names_its_extremes():
    P = _drawn((5, 9))
    P = P @ P.T
    headings = np.array([False, False, True, False, True])
    coordinates, turns, independent = core.spread_of(P, headings)
    sigmas = np.sqrt(np.diag(P))
    np.testing.assert_allclose(coordinates, (sigmas[~headings].min(), sigmas[~headings].max()))
    np.testing.assert_allclose(turns, (sigmas[headings].min(), sigmas[headings].max()))
    pivots = np.diag(np.linalg.cholesky(P / sigmas / sigmas[:, None]))
    np.testing.assert_allclose(independent, pivots.min() ** 2)
    assert core.spread_of(np.array([[1.0, 2.0], [2.0, 1.0]]), headings[:2])[2] == 0.0
    assert core.spread_of(np.diag([1.0, np.inf]), headings[:2])[0] == [1.0, np.inf]
    for variance in (0.0, -1.0, np.nan):
        assert core.spread_of(np.diag([1.0, variance]), headings[:2]) is None


def test_the_largest_number_is_by_size():
    assert core.largest(np.array([[1.0, -3.0], [2.0, 0.0]])) == 3.0
    assert core.largest(np.zeros((0, 2))) == 0.0
    for values in ([np.nan, 5.0], [5.0, np.nan], [np.inf, np.nan]):
        assert np.isnan(core.largest(np.array(values)))


@pytest.mark.parametrize(
    ("block", "is_sound"),
    [
        ([[2.0, 1.9], [1.9, 2.0]], True),
        ([[4.0, 4.0], [4.0, 4.0]], False),
        ([[2.0, -2.1], [-2.1, 2.0]], False),
        ([[0.0, 0.0], [0.0, 2.0]], False),
        ([[2.0, np.nan], [np.nan, 2.0]], False),
        ([[2.0, 0.0], [0.0, np.inf]], False),
    ],
)
def test_landmarks_are_sound_each_alone(block, is_sound):
    covariance = np.eye(7)
    covariance[5:, 5:] = block
    covariance[0, 0] = -1.0  # the pose does not matter
    whole = core.WholeMap(np.array([3, 7], np.uint32), np.zeros(7), covariance)
    assert whole.has_sound_landmarks == is_sound
    covariance[5:, 5:], covariance[3, 6] = np.eye(2), np.nan
    whole = core.WholeMap(np.array([3, 7], np.uint32), np.zeros(7), covariance)
    assert not whole.has_sound_landmarks


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the class is one of x86_64")
def test_a_processor_without_avx_computes_the_same_bits():
    finished = subprocess.run(
        [sys.executable, "-m", "tests.estimation.arithmetic"],
        env={**os.environ, **CLASSES["without AVX"]},
        capture_output=True,
        text=True,
        check=True,
    )
    level, found = json.loads(finished.stdout)
    assert level == "x86-64-v2"
    assert found == arithmetic.digests()
