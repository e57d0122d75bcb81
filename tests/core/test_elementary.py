"""The core's elementary functions have the bits of `team.estimation.elementwise`."""

import numpy as np
import pytest

from team import core
from team.estimation import elementwise

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


def assert_same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    same = (found == expected) & (np.signbit(found) == np.signbit(expected))
    assert (same | (np.isnan(found) & np.isnan(expected))).all()


@pytest.mark.parametrize("name", ARGUMENTS)
def test_functions_of_one_number_have_the_same_bits(name: str) -> None:
    x = ARGUMENTS[name]
    for function in ("exp", "expm1", "log", "log1p"):
        assert_same_bits(getattr(core, function)(x), getattr(elementwise, function)(x))
    for found, expected in zip(core.sin_and_cos(x), elementwise.sin_and_cos(x), strict=True):
        assert_same_bits(found, expected)


@pytest.mark.parametrize("name", ARGUMENTS)
def test_functions_of_two_numbers_have_the_same_bits(name: str) -> None:
    x = ARGUMENTS[name]
    for y in (RNG.permutation(x), np.full(len(x), 0.0), np.full(len(x), np.inf), -x):
        for function in ("atan2", "hypot"):
            assert_same_bits(getattr(core, function)(y, x), getattr(elementwise, function)(y, x))


def test_a_number_s_bits_depend_neither_on_its_place_nor_on_the_others() -> None:
    x = RNG.normal(0.0, 3.0, 37)
    for k in (0, 5, 36):
        assert core.exp(x[k:])[0] == core.exp(x)[k]
        assert core.sin_and_cos(x[k:])[0][0] == core.sin_and_cos(x)[0][k]
