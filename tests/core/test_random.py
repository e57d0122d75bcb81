"""Random numbers: the published generator, and normal numbers that are normal."""

import numpy as np
import pytest

from teamslam.team import core
from teamslam.team.estimation.consistency import chi2_quantile

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


def test_a_part_of_a_block_does_not_depend_on_how_many_are_asked_for():
    assert (
        core.Random(KEY).normals(1, 5).tolist() == core.Random(KEY).normals(1, 16)[:, :5].tolist()
    )


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


def test_wrong_keys_and_sizes_are_refused():
    with pytest.raises(ValueError, match="16 bytes"):
        core.Random(b"short")
    with pytest.raises(ValueError, match="at most"):
        core.Random(KEY).normals(1 << 20, 1 << 20)
