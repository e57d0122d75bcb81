import math

import numpy as np
import pytest

from teamslam.team.estimation.map_joining.marginals import scatter_of_series

CHAINS, SUBMAPS, DRAWS = 3, 40, 600


def _series(rng, fade):
    series = [rng.standard_normal()]
    for fresh in rng.standard_normal(SUBMAPS - 1):
        series.append(fade * series[-1] + math.sqrt(1.0 - fade * fade) * fresh)
    return np.array(series)


@pytest.mark.parametrize("fade", [0.0, 0.3, 0.6])
def test_errors_that_last_longer_than_a_window_widen_the_sum(fade):
    """A sum of squares would be short by √((1 + ρ)/(1 − ρ)), up to a factor of 2.

    The fit removes the mean of the series.
    """
    rng = np.random.default_rng(0)
    sums, found = [], []
    for _ in range(DRAWS):
        chains = [_series(rng, fade) for _ in range(CHAINS)]
        sums.append(sum(chain.sum() for chain in chains))
        mean = np.mean(chains)
        found.append(scatter_of_series([chain - mean for chain in chains]))
    ratio = np.median([each.sigma for each in found]) / np.std(sums)
    assert 0.85 < ratio < 1.1
    independent = CHAINS * SUBMAPS * (1.0 - fade) / (1.0 + fade)
    assert np.median([each.freedom for each in found]) == pytest.approx(independent, rel=0.25)


def test_one_stream_that_determines_the_sum_has_the_degrees_of_freedom_alone():
    rng = np.random.default_rng(1)
    one = scatter_of_series([_series(rng, 0.0), 0.01 * _series(rng, 0.0)])
    assert one.freedom <= 1.01 * SUBMAPS
    assert scatter_of_series([np.zeros(3)]) == (0.0, math.inf)
