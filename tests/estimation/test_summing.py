"""Sums within kernels have the bits of NumPy's."""

import numpy as np

from team.estimation.summing import total


def test_a_sum_within_a_kernel_has_the_bits_of_numpys_sum():
    random = np.random.default_rng(1)
    for count in (*range(300), 1000, 2400, 12345):
        values = random.standard_normal(count)
        assert total(values) == np.add.reduce(values), count
