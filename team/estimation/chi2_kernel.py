"""Quantiles of χ²: the inverse of the incomplete gamma function.

χ² of n degrees of freedom does not exceed x with the probability P(n/2, x/2), the regularised
incomplete gamma function: a series below its middle, a continued fraction of 1 − P above it (Press
et al. 2007, section 6.2). Its inverse is found by Halley's steps within a bracket, to some 1e-15.
SciPy has the same function, but importing it takes 0.13 s and 25 MB.
"""

import math

import numpy as np
from jaxtyping import Float

from team.estimation import elementary
from team.estimation.compiled import compiled

LARGE = 16.0
"""Shape from which Stirling's series gives Γ to the last place."""
MOST_TERMS = 100_000
MOST_STEPS = 200
PRECISE = 1e-16
SETTLED = 1e-9
"""Relative length of the last step: Halley's next one would be shorter than rounding."""


@compiled
def _density(a: float, x: float) -> float:
    """xᵃ e⁻ˣ / Γ(a + 1), without the cancellation of its large factors (x near a)."""
    shape, factor = a, 1.0
    while shape < LARGE:
        shape += 1.0
        factor *= shape / x
    away = (x - shape) / shape
    inverse = 1.0 / (shape * shape)
    stirling = (
        1.0 / 12.0
        - inverse
        * (
            1.0 / 360.0
            - inverse
            * (1.0 / 1260.0 - inverse * (1.0 / 1680.0 - inverse * (1.0 / 1188.0 - inverse / 521.5)))
        )
    ) / shape
    ratio = elementary.log1p(away) if away > -0.5 else elementary.log(x / shape)
    exponent = shape * (ratio - away) - stirling
    return factor * elementary.exp(exponent) / math.sqrt(2.0 * math.pi * shape)


@compiled
def _tails(a: float, x: float) -> tuple[float, float, float]:
    """Compute P(a, x), 1 − P(a, x) and the density dP/dx."""
    density = _density(a, x)
    if x < a + 1.0:
        term, total = 1.0, 1.0
        for k in range(1, MOST_TERMS):
            term *= x / (a + k)
            total += term
            if term < PRECISE * total:
                break
        return density * total, 1.0 - density * total, density * a / x
    b = x + 1.0 - a
    c, d = math.inf, 1.0 / b
    fraction = d
    for k in range(1, MOST_TERMS):
        numerator = k * (a - k)
        b += 2.0
        d = 1.0 / (b + numerator * d)
        c = b + numerator / c
        fraction *= d * c
        if abs(d * c - 1.0) < PRECISE:
            break
    above = density * a * fraction
    return 1.0 - above, above, density * a / x


@compiled
def _quantile(a: float, below: float, above: float) -> float:
    """Solve P(a, x) = below = 1 − above for x, by the smaller of the two."""
    low, high = 0.0, math.inf
    tail = min(below, above)
    t = math.sqrt(-2.0 * elementary.log(tail))
    normal = t - (2.30753 + 0.27061 * t) / (1.0 + t * (0.99229 + 0.04481 * t))
    cube = 1.0 - 1.0 / (9.0 * a) + math.copysign(normal, below - above) / (3.0 * math.sqrt(a))
    x = a * cube * cube * cube if cube > 0.1 else elementary.exp(elementary.log(below) / a)
    for _ in range(MOST_STEPS):
        p, q, slope = _tails(a, x)
        error = p - below if below <= above else above - q
        if error > 0.0:
            high = x
        else:
            low = x
        step = error / slope
        step /= max(1.0 - 0.5 * step * ((a - 1.0) / x - 1.0), 0.5)
        if abs(step) <= SETTLED * x:
            return x - step
        x -= step
        if not low < x < high:
            x = 2.0 * low if high == math.inf else 0.5 * (low + high)
    return x


@compiled
def chi2_quantiles(
    below: float, above: float, dof: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Compute the values that χ² exceeds with the probability above = 1 − below; NaN for less than
    one degree of freedom.
    """
    found = np.full(len(dof), math.nan)
    for k in range(len(dof)):
        if dof[k] >= 1.0:
            found[k] = 2.0 * _quantile(0.5 * dof[k], below, above)
    return found
