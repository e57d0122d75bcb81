"""Sine, logarithm and the like, of floats: the same bits on every processor.

A C library takes other paths on other processors, and so do NumPy's loops. These functions are
sums, products, quotients and square roots in one order, compiled without contraction of a product
and a sum, so IEEE 754 leaves one result. Their errors are in units of the last place, as
tests/estimation/test_elementary.py finds them against forty digits.

Hardly a function branches on its argument, so loops over particles can be vectorised. Reductions
by Cody and Waite 1980; the polynomials' coefficients are those of fdlibm (Sun Microsystems 1993).
"""

import math
from typing import TypeVar

import numpy as np

from team.estimation.compiled import compiled, inlined

PI_2_1, PI_2_2, PI_2_3 = (
    1.57079632673412561417,
    6.07710050630396597660e-11,
    2.02226624879595063154e-21,
)
"""π/2 in three parts, the first two of 33 bits: products with integers below 2²⁰ are exact."""
FARTHEST = 1e6
"""Angles beyond this are taken modulo the double that is nearest to 2π [rad]."""
PI_LOW = 1.2246467991473532072e-16
"""π less the double that is nearest to it."""
LN2, PER_LN2 = 0.6931471805599453, 1.4426950408889634
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
SPLIT = 134217729.0
"""2²⁷ + 1: a product with it parts a double into halves (Veltkamp)."""

Number = TypeVar("Number")


def squared(x: Number) -> Number:
    """The square of a number or of each of an array: in Python, `x**2` is the C library's `pow`."""
    return x * x  # type: ignore[no-any-return, operator] # whatever can be multiplied


@compiled
def sin_and_cos(angle: float) -> tuple[float, float]:
    """Sine and cosine of an angle [rad]; NaN of what is not finite."""
    return sin_and_cos_near(near(angle))


@inlined
def near(angle: float) -> float:
    """An angle of at most a million [rad] of the same direction; NaN of what is not finite."""
    return np.fmod(angle, 2.0 * math.pi) if abs(angle) > FARTHEST else angle


@inlined
def sin_and_cos_near(angle: float) -> tuple[float, float]:
    """Sine and cosine of an angle of at most a million [rad], without a branch."""
    quarters = np.floor(angle * (2.0 / math.pi) + 0.5)
    first = angle - quarters * PI_2_1
    second = quarters * PI_2_2
    high = first - second
    back = first - high
    low = (first - (high + back)) + (back - second) - quarters * PI_2_3
    x = high + low
    y = low - (x - high)
    z = x * x
    r = 8.33333333332248946124e-03 + z * (
        -1.98412698298579493134e-04
        + z
        * (
            2.75573137070700676789e-06
            + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
        )
    )
    sine = x - ((z * (0.5 * y - z * x * r) - y) - z * x * -1.66666666666666324348e-01)
    r = z * (
        4.16666666666666019037e-02
        + z * (-1.38888888888741095749e-03 + z * 2.48015872894767294178e-05)
    ) + z * z * z * z * (
        -2.75573143513906633035e-07
        + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
    )
    half = 0.5 * z
    w = 1.0 - half
    cosine = w + (((1.0 - w) - half) + (z * r - x * y))
    quarter = quarters - 4.0 * np.floor(0.25 * quarters)
    odd = quarter == 1.0 or quarter == 3.0
    s, c = cosine if odd else sine, sine if odd else cosine
    s = -s if quarter >= 2.0 else s
    c = -c if quarter == 1.0 or quarter == 2.0 else c
    return s, c


@compiled
def sin(angle: float) -> float:
    """The sine of an angle [rad]."""
    return sin_and_cos(angle)[0]


@compiled
def cos(angle: float) -> float:
    """The cosine of an angle [rad]."""
    return sin_and_cos(angle)[1]


@compiled
def tan(angle: float) -> float:
    """The tangent of an angle [rad]."""
    s, c = sin_and_cos(angle)
    return s / c


@compiled
def atan2(y: float, x: float) -> float:
    """The direction of (x, y) in [−π, π], signs of zeros as in IEEE 754."""
    if x != x or y != y:
        return math.nan
    ax, ay = abs(x), abs(y)
    larger = max(ax, ay)
    if larger > 1e270 or larger < 1e-240:
        if larger == math.inf:
            ax, ay = 1.0 if ax == math.inf else 0.0, 1.0 if ay == math.inf else 0.0
        elif larger == 0.0:
            ax = 1.0
        else:
            scale = 2.0**-700 if larger > 1.0 else 2.0**300
            ax, ay = ax * scale, ay * scale
    return math.copysign(direction_near(ay, math.copysign(ax, x)), y)


@inlined
def direction_near(y: float, x: float) -> float:
    """`atan2` of y ≥ 0, coordinates of at most 1e270, the larger of at least 1e-240: no branch.

    With the smaller coordinate over the larger one, turned by π/4 if that exceeds tan(π/8), it is
    C ± atan(q), |q| ≤ tan(π/8), C a multiple of π/4. What rounding takes from q is computed (Dekker
    1971) and goes into the sum.
    """
    ax, ay = abs(x), y
    steep = ay > ax
    n, d = min(ax, ay), max(ax, ay)
    turned = n > 0.4142135623730950488 * d
    difference, total = n - d, n + d
    lost_n = n - (difference + d)
    lost_d = n - (total - d)
    lost_n = lost_n if turned else 0.0
    lost_d = lost_d if turned else 0.0
    n = difference if turned else n
    d = total if turned else d
    q = n / d
    wide = SPLIT * q
    q1 = wide - (wide - q)
    wide = SPLIT * d
    d1 = wide - (wide - d)
    q2, d2 = q - q1, d - d1
    product = q * d
    lost = ((q1 * d1 - product) + q1 * d2 + q2 * d1) + q2 * d2
    rest = (((n - product) - lost) + (lost_n - q * lost_d)) / d
    z = q * q
    w = z * z
    odd = z * (
        3.33333333333329318027e-01
        + w
        * (
            1.42857142725034663711e-01
            + w
            * (
                9.09088713343650656196e-02
                + w
                * (
                    6.66107313738753120669e-02
                    + w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02)
                )
            )
        )
    )
    even = w * (
        -1.99999999998764832476e-01
        + w
        * (
            -1.11111104054623557880e-01
            + w
            * (
                -7.69187620504482999495e-02
                + w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02)
            )
        )
    )
    rest = rest * (1.0 - z + w) - q * (odd + even)
    eighths = 1.0 if turned else 0.0
    sign = -1.0 if steep else 1.0
    eighths = 2.0 - eighths if steep else eighths
    behind = math.copysign(1.0, x)
    sign *= behind
    eighths = 4.0 - eighths if behind < 0.0 else eighths
    high = eighths * (0.25 * math.pi)
    q *= sign
    angle = high + q
    return angle + (((high - angle) + q) + (eighths * (0.25 * PI_LOW) + sign * rest))


@inlined
def exp(x: float) -> float:
    """E to the power of x; 0 below −745.2, infinite above 709.8."""
    x = min(max(x, -800.0), 800.0) if x == x else x
    k = np.floor(x * PER_LN2 + 0.5)
    high, low = x - k * LN2_HIGH, k * LN2_LOW
    r = high - low
    t = r * r
    c = r - t * (
        1.66666666666666019037e-01
        + t
        * (
            -2.77777777770155933842e-03
            + t
            * (
                6.61375632143793436117e-05
                + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08)
            )
        )
    )
    y = 1.0 - ((low - (r * c) / (2.0 - c)) - high)
    half = np.floor(0.5 * k)
    power: float = y * _power_of_two(half) * _power_of_two(k - half)
    return power


@inlined
def _power_of_two(exponent: float) -> float:
    """2 to the power of an integer in −1022 … 1023, by its bits."""
    bits = np.float64(exponent + (1023.0 + 2.0**52)).view(np.int64)
    return float(np.int64(bits << 52).view(np.float64))


@compiled
def log(x: float) -> float:
    """The natural logarithm; −∞ of 0, NaN of what is negative."""
    if not 2.3e-308 < x < math.inf:
        if x == 0.0:
            return -math.inf
        if not x > 0.0 or x == math.inf:
            return x if x > 0.0 else math.nan
        return log_of_normal(x * 2.0**54) - 54.0 * LN2
    return log_of_normal(x)


@inlined
def log_of_normal(x: float) -> float:
    """The natural logarithm of a positive number that is neither subnormal nor infinite."""
    bits = np.float64(x).view(np.int64)
    above = ((bits & 0x000FFFFFFFFFFFFF) + 0x95F6400000000) & 0x0010000000000000
    exponent = np.int64((bits >> 52) + (above >> 52) | 0x4330000000000000).view(np.float64)
    k = exponent - (2.0**52 + 1023.0)
    f = float(np.int64((bits & 0x000FFFFFFFFFFFFF) | (above ^ 0x3FF0000000000000)).view(np.float64))
    f -= 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    even = w * (
        3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01)
    )
    odd = z * (
        6.666666666666735130e-01
        + w
        * (2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01))
    )
    half = 0.5 * f * f
    return k * LN2_HIGH - ((half - (s * (half + (even + odd)) + k * LN2_LOW)) - f)


@compiled
def log1p(x: float) -> float:
    """The logarithm of 1 + x, x > −1, to the last places of a small x (Kahan)."""
    u = 1.0 + x
    if u == 1.0 or u == math.inf:
        return x
    if u == 0.0:
        return -math.inf
    return log(u) + (x - (u - 1.0)) / u


@compiled
def expm1(x: float) -> float:
    """E to the power of x, less 1, to the last places of a small x (Kahan)."""
    u = exp(x)
    if u == 1.0:
        return x
    if u == math.inf or u - 1.0 == -1.0:
        return u - 1.0
    return (u - 1.0) * x / log(u)


@compiled
def hypot(x: float, y: float) -> float:
    """The length of (x, y); infinite where one of them is, NaN of what is not a number."""
    ax, ay = abs(x), abs(y)
    larger = max(ax, ay)
    if larger == math.inf or ay == math.inf:
        return math.inf
    if larger > 1e150 or larger < 1e-140:
        scale = 2.0**-600 if larger > 1.0 else 2.0**600
        ax, ay = ax * scale, ay * scale
        return math.sqrt(ax * ax + ay * ay) / scale
    return math.sqrt(ax * ax + ay * ay)
