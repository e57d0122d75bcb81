import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team.core import Cholesky, NotPositiveDefiniteError, Pattern

BIG_ROWS, BLOCK = 256, 48
"""A panel of so many rows is factorised by blocks of so many columns (`sparse.cpp`)."""


def pattern_of(sizes, pairs):
    columns = [[j, *sorted(i for i, k in set(pairs) if k == j)] for j in range(len(sizes))]
    starts = np.cumsum([0, *(len(rows) for rows in columns)])
    return Pattern(np.array(sizes), starts, np.array([i for rows in columns for i in rows]))


def pattern_with(sizes, tied):
    """The pattern with these blocks; `tied` is read below its diagonal."""
    columns = [np.append(j, j + 1 + np.flatnonzero(tied[j + 1 :, j])) for j in range(len(sizes))]
    starts = np.cumsum([0, *(len(rows) for rows in columns)])
    return Pattern(np.array(sizes), starts, np.concatenate(columns))


def values_of(pattern, dense):
    offset = pattern.offset
    return np.concatenate(
        [
            dense[offset[i] : offset[i + 1], offset[j] : offset[j + 1]].ravel()
            for i, j in zip(pattern.rows, pattern.columns, strict=True)
        ]
    )


def dense_on(pattern, rng):
    """A positive definite matrix with this pattern, well-conditioned but badly scaled."""
    offset = pattern.offset
    n = offset[-1]
    mask = np.zeros((n, n), dtype=bool)
    for i, j in zip(pattern.rows, pattern.columns, strict=True):
        mask[offset[i] : offset[i + 1], offset[j] : offset[j + 1]] = True
    dense = np.tril(np.where(mask, rng.normal(size=(n, n)), 0.0))
    dense += np.tril(dense, -1).T
    dense += (1.0 + np.abs(dense).sum(axis=1).max(initial=0.0)) * np.eye(n)
    scale = 10.0 ** rng.uniform(-3.0, 3.0, n)
    return scale[:, None] * dense * scale


def inverse_of(dense):
    scale = 1.0 / np.sqrt(np.diag(dense))
    return scale[:, None] * np.linalg.inv(scale[:, None] * dense * scale) * scale


def assert_right(pattern, dense, rng):
    """Compare every result of the factor with dense algebra, relative to standard deviations."""
    cholesky, inverse = Cholesky(pattern, values_of(pattern, dense)), inverse_of(dense)
    n, sigma = len(dense), np.sqrt(np.diag(inverse))
    relative = np.outer(sigma, sigma)

    many = int(rng.choice([0, 1, 2, 3, 5, 20, 70]))
    right = dense @ rng.normal(size=(n, many))
    solution = cholesky.solve(right)
    margin = 1e-11 * (abs(dense) @ (1.0 / np.sqrt(np.diag(dense))))[:, None]
    scale = np.abs(right / np.sqrt(np.diag(dense))[:, None]).max(initial=0.0)
    assert (abs(dense @ solution - right) <= margin * (1.0 + scale)).all()
    for k in range(min(many, 3)):
        np.testing.assert_array_equal(cholesky.solve(right[:, k]), solution[:, k])

    chosen = rng.permutation(n)[: int(rng.integers(0, n + 1))]
    columns, block = cholesky.inverse_columns(chosen), cholesky.inverse_block(chosen)
    np.testing.assert_allclose(
        columns / relative[:, chosen], inverse[:, chosen] / relative[:, chosen], atol=1e-11
    )
    among = np.ix_(chosen, chosen)
    np.testing.assert_allclose(
        block / relative[among], inverse[among] / relative[among], atol=1e-11
    )
    np.testing.assert_array_equal(block, block.T)

    weights = values_of(pattern, relative)
    np.testing.assert_allclose(
        cholesky.selected_inverse() / weights, values_of(pattern, inverse) / weights, atol=1e-11
    )


@st.composite
def patterns(draw):
    sizes = draw(st.lists(st.sampled_from([1, 2, 3, 4]), min_size=1, max_size=24))
    index = st.integers(0, len(sizes) - 1)
    pairs = draw(st.lists(st.tuples(index, index), max_size=60))
    return pattern_of(sizes, [(i, j) for i, j in pairs if i > j])


seeds = st.integers(0, 2**32)


@settings(deadline=None, max_examples=150)
@given(patterns(), seeds)
def test_a_sparse_system_is_solved_and_inverted_like_a_dense_one(pattern, seed):
    rng = np.random.default_rng(seed)
    assert_right(pattern, dense_on(pattern, rng), rng)


def clique(unknowns):
    """A full matrix of blocks of three unknowns."""
    sizes = [3] * (unknowns // 3) + [1] * (unknowns % 3)
    return pattern_with(sizes, np.ones((len(sizes), len(sizes)), dtype=bool))


@settings(deadline=None, max_examples=20)
@given(st.integers(5, 10), st.sampled_from([-1, 0, 1]), seeds)
def test_a_big_panel_is_right_at_each_edge_of_a_block(blocks, beyond, seed):
    pattern, rng = clique(BLOCK * blocks + beyond), np.random.default_rng(seed)
    assert_right(pattern, dense_on(pattern, rng), rng)


def groups_on_a_clique(seed):
    """Three groups of some 70 unknowns, each tied to some 580 of a clique's 1000."""
    rng = np.random.default_rng(seed)
    root, group, loose = 500, 35, 30
    n = root + 3 * group + loose
    sizes, tied = rng.integers(1, 4, n), np.zeros((n, n), dtype=bool)
    tied[:root, :root] = True
    for begin in range(root, n - loose, group):
        tied[begin : begin + group, begin : begin + group] = True
        tied[begin : begin + group, rng.choice(root, 290, replace=False)] = True
    for i in range(n - loose, n):
        tied[i, rng.integers(0, i)] = True
    order = rng.permutation(n)
    return pattern_with(sizes[order], (tied | tied.T)[np.ix_(order, order)])


@pytest.mark.parametrize("seed", [0, 1])
def test_big_and_small_panels_together_are_right(seed):
    pattern, rng = groups_on_a_clique(seed), np.random.default_rng(seed)
    width, rows = pattern.panels
    big = (rows >= BIG_ROWS) & (width > BLOCK)
    assert big[-1]
    assert (big & (rows > width)).sum() >= 2
    assert not big.all()
    assert_right(pattern, dense_on(pattern, rng), rng)


@pytest.mark.parametrize("beyond", [-1, 0, 1])
def test_a_clique_is_big_from_the_threshold_on_and_right_on_either_side(beyond):
    n = BIG_ROWS + beyond
    pattern = clique(n)
    cholesky = Cholesky(pattern, values_of(pattern, dense_on(pattern, np.random.default_rng(0))))
    assert pattern.has_big_panel == (beyond >= 0)
    chosen = np.arange(0, n, 7)
    block, columns = cholesky.inverse_block(chosen), cholesky.inverse_columns(chosen)[chosen]
    np.testing.assert_allclose(block, 0.5 * (columns + columns.T), rtol=1e-9)
    if beyond < 0:
        np.testing.assert_array_equal(block, 0.5 * (columns + columns.T))


def test_the_same_numbers_give_the_same_bytes():
    sizes, pairs = [3, 2, 3, 2], [(1, 0), (2, 0), (3, 2), (3, 0)]
    values = values_of(
        pattern_of(sizes, pairs), dense_on(pattern_of(sizes, pairs), np.random.default_rng(3))
    )
    first, second = (Cholesky(pattern_of(sizes, pairs), values) for _ in range(2))
    assert first.selected_inverse().tobytes() == second.selected_inverse().tobytes()


def test_a_block_and_a_quadratic_form_are_those_of_the_dense_matrix():
    pattern, rng = pattern_of([3, 2, 1, 2], [(1, 0), (3, 1)]), np.random.default_rng(4)
    dense, x, offset = dense_on(pattern, rng), rng.normal(size=8), pattern.offset
    dense = 0.5 * (dense + dense.T)
    values = values_of(pattern, dense)
    np.testing.assert_allclose(pattern.quadratic(values, x), x @ dense @ x)
    np.testing.assert_array_equal(values[pattern.diagonal], np.diag(dense))
    for i in range(4):
        for j in range(4):
            expected = dense[offset[i] : offset[i + 1], offset[j] : offset[j + 1]]
            np.testing.assert_array_equal(pattern.block(values, i, j), expected)


@pytest.mark.parametrize("bad", range(5))
@pytest.mark.parametrize("value", [-1.0, 0.0, 1e-15, np.nan])
def test_an_indefinite_matrix_names_the_variable_of_its_pivot(bad, value):
    pattern = pattern_of([3, 2, 3, 2, 1], [])
    dense = np.eye(11)
    last = pattern.offset[bad + 1] - 1
    dense[last, last - 1 : last] = dense[last - 1 : last, last] = 1.0
    dense[last, last] = value if pattern.sizes[bad] == 1 else 1.0 + value
    if bad == 4:
        dense[last, last - 1] = dense[last - 1, last] = 0.0
        dense[last, last] = min(value, 0.0)
    with pytest.raises(NotPositiveDefiniteError, match=f"variable {bad}") as caught:
        Cholesky(pattern, values_of(pattern, dense))
    assert caught.value.variable == bad


def test_a_singular_matrix_is_refused_though_rounding_leaves_a_positive_pivot():
    pattern = pattern_of([1, 1, 1], [(1, 0), (2, 1)])
    weights = np.array([0.1, 0.7])
    dense = np.array(
        [
            [weights[0], -weights[0], 0.0],
            [-weights[0], weights.sum(), -weights[1]],
            [0.0, -weights[1], weights[1]],
        ]
    )
    with pytest.raises(NotPositiveDefiniteError):
        Cholesky(pattern, values_of(pattern, dense))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_no_factor_has_a_number_that_is_not_finite(value):
    pattern = pattern_of([1, 2, 1], [(1, 0), (2, 1)])
    for k in range(pattern.value_start[-1]):
        values = values_of(pattern, dense_on(pattern, np.random.default_rng(0)))
        values[k] = value
        try:
            cholesky = Cholesky(pattern, values)
        except NotPositiveDefiniteError:
            continue
        assert np.isfinite(cholesky.selected_inverse()).all()


@pytest.mark.parametrize(
    ("sizes", "column_start", "rows", "why"),
    [
        ([3, 2], [0, 1, 2], [0, 0], "diagonal"),
        ([3, 2], [0, 2, 2], [0, 1], "diagonal"),
        ([3, 2], [0, 2, 3], [0, 2, 1], "rows"),
        ([3, 2], [0, 2, 3], [0, -1, 1], "rows"),
        ([3, 2], [0, 3, 4], [0, 1, 1, 1], "distinct"),
        ([3, 2], [0, 1], [0, 1], "column_start"),
        ([3, 2], [0, 1, 9], [0, 1], "column_start"),
        ([3, 2], [0, 9, 2], [0, 1], "diagonal"),
        ([3, 0], [0, 1, 2], [0, 1], "unknowns"),
        ([3, -2], [0, 1, 2], [0, 1], "unknowns"),
    ],
)
def test_what_is_no_pattern_is_refused(sizes, column_start, rows, why):
    with pytest.raises(ValueError, match=why):
        Pattern(*(np.array(each, np.int64) for each in (sizes, column_start, rows)))


small = st.lists(st.integers(-2, 5), max_size=6).map(lambda each: np.array(each, np.int64))


@settings(deadline=None, max_examples=300)
@given(small, small, small)
def test_any_integers_are_a_pattern_or_refused(sizes, column_start, rows):
    try:
        pattern = Pattern(sizes, column_start, rows)
    except ValueError:
        return
    dense = dense_on(pattern, np.random.default_rng(0))
    cholesky = Cholesky(pattern, values_of(pattern, dense) if len(rows) else np.zeros(0))
    assert np.isfinite(cholesky.selected_inverse()).all()


def test_arguments_of_another_size_are_refused():
    pattern = pattern_of([3, 2], [(1, 0)])
    cholesky = Cholesky(pattern, values_of(pattern, np.eye(5)))
    for call in (
        lambda: Cholesky(pattern, np.ones(3)),
        lambda: cholesky.solve(np.ones(4)),
        lambda: cholesky.solve(np.ones((4, 2))),
        lambda: cholesky.inverse_columns(np.array([5])),
        lambda: cholesky.inverse_block(np.array([-1])),
        lambda: pattern.block(np.ones(19), 0, 2),
        lambda: pattern.quadratic(np.ones(19), np.ones(4)),
    ):
        with pytest.raises(ValueError, match=r"must|no such"):
            call()
