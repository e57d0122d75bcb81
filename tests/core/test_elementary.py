"""The core's elementary functions have the bits of those within compiled Python."""

import numpy as np
import pytest

from team import core
from team.estimation import elementary
from team.estimation.compiled import compiled

RNG = np.random.default_rng(0)
SPECIAL = np.array(
    [0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 1e-310, -1e-310, 1e308, -1e308, 5e-324, 1e6,
     1000001.0, -1e7, 1e300, 709.8, -745.3, 800.0, -800.0, np.pi, -np.pi, np.pi / 2.0]
)  # fmt: skip
ARGUMENTS = {
    "special": SPECIAL,
    "powers": np.exp(RNG.uniform(-700.0, 700.0, 4001)),
    **{
        f"about {scale:g}": RNG.normal(0.0, scale, 4001)
        for scale in (1e-300, 1e-9, 1, 10, 1e5, 1e8)
    },
}


ONE, TWO = ("exp", "expm1", "log", "log1p"), ("atan2", "hypot")


@compiled
def of_one(x: np.ndarray) -> np.ndarray:
    """ONE, sine and cosine of each number, by compiled Python."""
    y = np.empty((6, len(x)))
    for i in range(len(x)):
        y[0, i], y[1, i] = elementary.exp(x[i]), elementary.expm1(x[i])
        y[2, i], y[3, i] = elementary.log(x[i]), elementary.log1p(x[i])
        y[4, i], y[5, i] = elementary.sin_and_cos(x[i])
    return y


@compiled
def of_two(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """TWO of each pair, by compiled Python."""
    z = np.empty((2, len(x)))
    for i in range(len(x)):
        z[0, i], z[1, i] = elementary.atan2(y[i], x[i]), elementary.hypot(y[i], x[i])
    return z


def assert_same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    same = (found == expected) & (np.signbit(found) == np.signbit(expected))
    assert (same | (np.isnan(found) & np.isnan(expected))).all()


@pytest.mark.parametrize("name", ARGUMENTS)
def test_functions_of_one_number_have_the_same_bits(name: str) -> None:
    x = ARGUMENTS[name]
    found = *(getattr(core, function)(x) for function in ONE), *core.sin_and_cos(x)
    for one, other in zip(found, of_one(x), strict=True):
        assert_same_bits(one, other)


@pytest.mark.parametrize("name", ARGUMENTS)
def test_functions_of_two_numbers_have_the_same_bits(name: str) -> None:
    x = ARGUMENTS[name]
    for y in (RNG.permutation(x), np.full(len(x), 0.0), np.full(len(x), np.inf), -x):
        for function, expected in zip(TWO, of_two(y, x), strict=True):
            assert_same_bits(getattr(core, function)(y, x), expected)


def test_a_number_s_bits_depend_neither_on_its_place_nor_on_the_others() -> None:
    x = RNG.normal(0.0, 3.0, 37)
    for k in (0, 5, 36):
        assert core.exp(x[k:])[0] == core.exp(x)[k]
        assert core.sin_and_cos(x[k:])[0][0] == core.sin_and_cos(x)[0][k]
