import math
from collections.abc import Callable
from decimal import Decimal, localcontext

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.estimation.consistency import chi2_quantile

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
DIGITS = 45


def _sine(x: Decimal) -> Decimal:
    """Taylor's series at an eighth of the reduced angle, three times doubled."""
    x = (x - 2 * PI * (x / (2 * PI)).to_integral_value()) / 3**3
    term = total = x
    for k in range(1, 40):
        term = -term * x * x / ((2 * k) * (2 * k + 1))
        total += term
    for _ in range(3):
        total = 3 * total - 4 * total**3
    return total


def _cosine(x: Decimal) -> Decimal:
    return _sine(x + PI / 2)


def _arctangent(t: Decimal) -> Decimal:
    """Halve the angle of 0 ≤ t ≤ 1 four times, then sum the series."""
    for _ in range(4):
        t = t / (1 + (1 + t * t).sqrt())
    term, total = t, t
    for k in range(1, 40):
        term = -term * t * t
        total += term / (2 * k + 1)
    return 16 * total


def _direction(y: Decimal, x: Decimal) -> Decimal:
    ax, ay = abs(x), abs(y)
    angle = _arctangent(ay / ax) if ay <= ax else PI / 2 - _arctangent(ax / ay)
    return (angle if x > 0 else PI - angle).copy_sign(y)


REFERENCES: dict[str, tuple[Callable[..., Decimal], float]] = {
    "sin": (_sine, 0.8),
    "cos": (_cosine, 0.8),
    "tan": (lambda x: _sine(x) / _cosine(x), 2.0),
    "atan2": (_direction, 0.7),
    "exp": (lambda x: x.exp(), 0.9),
    "log": (lambda x: x.ln(), 0.8),
    "log1p": (lambda x: (1 + x).ln(), 1.5),
    "expm1": (lambda x: x.exp() - 1, 3.0),
    "hypot": (lambda x, y: (x * x + y * y).sqrt(), 1.2),
}
"""Each function in forty digits, and how many units of the last place it may be off."""


def _arguments(name: str) -> list[tuple[float, ...]]:
    rng = np.random.default_rng(7)
    wide = 10.0 ** rng.uniform(-12, 2, 150) * rng.choice([-1.0, 1.0], 150)
    if name in ("sin", "cos", "tan"):
        quarters = np.arange(1, 60) * (0.5 * math.pi)
        far = rng.uniform(-1e6, 1e6, 80)
        return [(x,) for x in (*rng.uniform(-4, 4, 300), *wide, *quarters, *far)]
    if name in ("atan2", "hypot"):
        near, far = rng.normal(size=(300, 2)), 10.0 ** rng.uniform(-250, 250, (100, 2))
        edge = [(math.sqrt(0.5) * (1 + e), 1.0) for e in rng.uniform(-0.5, 0.5, 50)]
        pairs = [*near.tolist(), *edge, *far.tolist()]
        return [(y, x) for y, x in pairs if name == "hypot" or 1e-290 < abs(y) / abs(x) < 1e290]
    if name == "exp":
        return [(x,) for x in (*rng.uniform(-700, 700, 200), *rng.uniform(-2, 2, 200), *wide)]
    if name == "log":
        return [(10.0**x,) for x in (*rng.uniform(-300, 300, 200), *rng.uniform(-0.1, 0.1, 200))]
    return [(x,) for x in (*wide, *rng.uniform(-0.99, 20, 200)) if x > -1.0]


@pytest.mark.parametrize("name", REFERENCES)
def test_an_elementary_function_is_right_to_the_last_place(name):
    reference, most = REFERENCES[name]
    function = getattr(core, name)
    with localcontext() as context:
        context.prec = DIGITS
        for arguments in _arguments(name):
            exact = reference(*[Decimal(float(x)) for x in arguments])
            found = function(*[float(x) for x in arguments])
            assert math.isfinite(found), arguments
            off = abs(Decimal(found) - exact) / Decimal(math.ulp(float(exact)))
            assert off <= Decimal(most), (arguments, found, off)


def test_special_cases_are_those_of_ieee_754():
    inf, nan, tiny, huge = math.inf, math.nan, 5e-324, 1.7e308
    values = (0.0, -0.0, 1.0, -1.0, inf, -inf, tiny, -tiny, huge, -huge, nan)
    for y in values:
        for x in values:
            for name in ("atan2", "hypot"):
                found, wanted = getattr(core, name)(y, x), getattr(math, name)(y, x)
                same = found == pytest.approx(wanted, rel=1e-15, abs=0.0, nan_ok=True)
                assert same, (name, y, x)
                assert math.copysign(1.0, found) == math.copysign(1.0, wanted) or found != found
    assert [core.exp(x) for x in (-inf, -746.0, -0.0, 710.0, inf)] == [0, 0, 1, inf, inf]
    assert core.exp(-745.0) == math.exp(-745.0) == tiny
    assert [core.log(x) for x in (0.0, 1.0, inf)] == [-inf, 0.0, inf]
    assert core.log(tiny) == pytest.approx(math.log(tiny), rel=1e-15)
    assert [core.log1p(x) for x in (-1.0, 0.0, inf)] == [-inf, 0.0, inf]
    assert [core.expm1(x) for x in (-inf, 0.0, inf)] == [-1.0, 0.0, inf]
    for name in ("sin", "cos", "tan", "exp", "log", "log1p", "expm1"):
        assert math.isnan(getattr(core, name)(nan)), name
    assert math.isnan(core.sin(inf))
    assert math.isnan(core.log(-1.0))
    assert core.cos(1e15) == pytest.approx(math.cos(math.fmod(1e15, 2.0 * math.pi)), abs=1e-9)


SPECIAL = np.array(
    [0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 1e-310, -1e-310, 1e308, -1e308, 5e-324, 1e6,
     1000001.0, -1e7, 1e300, 709.8, -745.3, 800.0, -800.0, np.pi, -np.pi, np.pi / 2.0]
)  # fmt: skip
ONE = ("sin", "cos", "tan", "exp", "expm1", "log", "log1p", "normal_below", "wrapped")


def assert_same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    same = (found == expected) & (np.signbit(found) == np.signbit(expected))
    assert found.shape == expected.shape
    assert (same | (np.isnan(found) & np.isnan(expected))).all()


@pytest.mark.parametrize("x", [SPECIAL, np.random.default_rng(0).normal(0.0, 9.0, 37)])
def test_an_array_s_functions_are_those_of_its_numbers(x):
    for name in ONE:
        function = getattr(core, name)
        assert_same_bits(function(x), np.array([function(v) for v in x.tolist()]))
    for name in ("atan2", "hypot"):
        function = getattr(core, name)
        of_each = [[function(v, w) for w in x.tolist()] for v in x.tolist()]
        assert_same_bits(function(x[:, None], x), np.array(of_each))
        assert_same_bits(function(x, x[0]), np.array(of_each)[:, 0])
        assert_same_bits(function(x[0], x), np.array(of_each)[0])
    s, c = core.sin_and_cos(x)
    assert_same_bits(s, core.sin(x))
    assert_same_bits(c, core.cos(x))


def test_a_function_takes_numbers_and_arrays_of_any_type_shape_and_layout():
    for one in (1, True, np.float32(1.0), np.int64(1), np.float64(1.0)):
        assert isinstance(core.log(one), float)
    x = np.arange(1.0, 25.0).reshape(2, 3, 4)
    for part in (x.T, x[:, ::-2], x[..., 1], np.asfortranarray(x), x[:0], x[0, 0, 0]):
        for y in (core.exp(part), core.sin_and_cos(part)[0], core.hypot(part, 0.0)):
            assert np.shape(y) == np.shape(part)
        assert (core.hypot(part, 0.0) == part).all()
    assert (core.hypot(np.arange(3), np.zeros((2, 1))) == [[0, 1, 2], [0, 1, 2]]).all()
    for wrong in ("1", None, [1.0], 1j):
        with pytest.raises(TypeError):
            core.exp(wrong)
    with pytest.raises(ValueError, match="fit"):
        core.atan2(np.zeros(2), np.zeros(3))


def test_a_normal_variable_stays_below_with_the_probability_of_tables():
    x = np.array([-9.5, -3.0, -1.0, 0.0, 0.5, 1.959963984540054, 4.0, 20.0])
    tables = [0.5 * math.erfc(-v / math.sqrt(2.0)) for v in x]
    np.testing.assert_allclose(core.normal_below(x), tables, rtol=0.0, atol=1e-15)


KEY = bytes(range(16))


def test_uniform_numbers_are_those_of_philox_4x64():
    drawn, published = core.Random(KEY), np.random.Philox(key=int.from_bytes(KEY, "little"))
    blocks = published.random_raw(4 * 100).reshape(-1, 4)
    assert [drawn.uniform() for _ in range(100)] == [
        (bits >> 11) * 2.0**-53 for bits in blocks[:, 0].tolist()
    ]


def test_normal_numbers_are_box_and_muller_s_of_the_same_blocks():
    bits = np.random.Philox(key=int.from_bytes(KEY, "little")).random_raw(32).reshape(2, 16)
    uniform = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    radius, angle = np.sqrt(-2.0 * np.log(uniform[:, :8])), 2.0 * np.pi * uniform[:, 8:]
    expected = np.hstack([radius * np.cos(angle), radius * np.sin(angle)])
    assert core.Random(KEY).normals(2, 16) == pytest.approx(expected, abs=1e-14)


def test_normal_numbers_are_standard_normal():
    x = core.Random(b"sixteen bytes ok").normals(1000, 300).ravel()
    n = len(x)
    assert abs(x.mean()) < 4.0 / np.sqrt(n)
    assert abs((x * x).mean() - 1.0) < 4.0 * np.sqrt(2.0 / n)
    assert abs((x**4).mean() - 3.0) < 4.0 * np.sqrt(96.0 / n)
    edges = core.normal_below(np.linspace(-4.0, 4.0, 65))
    counts = np.histogram(core.normal_below(x), np.concatenate([[0.0], edges, [1.0]]))[0]
    expected = n * np.diff(np.concatenate([[0.0], edges, [1.0]]))
    chi2 = ((counts - expected) ** 2 / expected).sum()
    assert chi2 < float(chi2_quantile(0.9999, float(len(counts) - 1)))
    assert abs(np.corrcoef(x[:-1], x[1:])[0, 1]) < 4.0 / np.sqrt(n)
    assert abs(np.corrcoef(x[::16], x[8::16])[0, 1]) < 4.0 / np.sqrt(n / 16)
