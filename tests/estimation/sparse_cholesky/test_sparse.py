"""The sparse factorisation equals the dense one, and says which variable is undetermined."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from team.estimation.sparse_cholesky.ordering import minimum_degree
from team.estimation.sparse_cholesky.sparse import (
    NotPositiveDefiniteError,
    Pattern,
    analysed,
    factorised,
    inverse_columns,
    selected_inverse,
    solved,
)


def pattern_of(sizes, pairs):
    """The pattern with these blocks (i > j) and every diagonal block."""
    columns = [[j, *sorted(i for i, k in set(pairs) if k == j)] for j in range(len(sizes))]
    starts = np.cumsum([0, *(len(rows) for rows in columns)])
    return Pattern(np.array(sizes), starts, np.array([i for rows in columns for i in rows]))


def values_of(pattern, dense):
    offset = pattern.offset
    return np.concatenate(
        [
            dense[offset[i] : offset[i + 1], offset[j] : offset[j + 1]].ravel()
            for i, j in zip(pattern.rows, pattern.columns, strict=True)
        ]
    )


def dense_on(pattern, rng):
    """A well-conditioned positive definite matrix with this pattern, badly scaled."""
    n = pattern.offset[-1]
    mask = values_mask(pattern)
    dense = np.where(mask, rng.normal(size=(n, n)), 0.0)
    dense = np.tril(dense) + np.tril(dense, -1).T
    dense += (1.0 + np.abs(dense).sum(axis=1).max()) * np.eye(n)
    scale = 10.0 ** rng.uniform(-3.0, 3.0, n)
    return scale[:, None] * dense * scale


def values_mask(pattern):
    offset = pattern.offset
    mask = np.zeros((offset[-1], offset[-1]), dtype=bool)
    for i, j in zip(pattern.rows, pattern.columns, strict=True):
        mask[offset[i] : offset[i + 1], offset[j] : offset[j + 1]] = True
        mask[offset[j] : offset[j + 1], offset[i] : offset[i + 1]] = True
    return mask


@st.composite
def systems(draw):
    sizes = draw(st.lists(st.sampled_from([1, 2, 3]), min_size=1, max_size=14))
    index = st.integers(0, len(sizes) - 1)
    pairs = draw(st.lists(st.tuples(index, index), max_size=30))
    pattern = pattern_of(sizes, [(i, j) for i, j in pairs if i > j])
    return pattern, dense_on(pattern, np.random.default_rng(draw(st.integers(0, 2**32))))


@settings(deadline=None, max_examples=60)
@given(systems())
def test_solution_equals_the_dense_one(system):
    pattern, dense = system
    right = dense @ np.random.default_rng(0).normal(size=(len(dense), 3))
    solution = solved(factorised(analysed(pattern), values_of(pattern, dense)), right)
    np.testing.assert_allclose(dense @ solution, right, rtol=1e-8, atol=1e-8 * abs(right).max())


@settings(deadline=None, max_examples=60)
@given(systems())
def test_selected_inverse_equals_the_dense_inverse_on_the_pattern(system):
    pattern, dense = system
    inverse = np.linalg.inv(dense)
    selected = selected_inverse(factorised(analysed(pattern), values_of(pattern, dense)))
    scale = np.sqrt(np.diag(inverse))
    relative = values_of(pattern, np.outer(scale, scale))
    np.testing.assert_allclose(
        selected / relative, values_of(pattern, inverse) / relative, atol=1e-9
    )


@settings(deadline=None, max_examples=30)
@given(systems())
def test_columns_of_the_inverse_equal_the_dense_ones(system):
    pattern, dense = system
    unknowns = np.arange(len(dense))[::-2]
    columns = inverse_columns(factorised(analysed(pattern), values_of(pattern, dense)), unknowns)
    expected = np.linalg.inv(dense)[:, unknowns]
    scale = np.sqrt(np.diag(np.linalg.inv(dense)))
    relative = np.outer(scale, scale[unknowns])
    np.testing.assert_allclose(columns / relative, expected / relative, atol=1e-9)


def test_many_columns_equal_a_few_at_a_time():
    pattern = pattern_of([3] * 60, [(i + 1, i) for i in range(59)])
    cholesky = factorised(
        analysed(pattern), values_of(pattern, dense_on(pattern, np.random.default_rng(1)))
    )
    together = inverse_columns(cholesky, np.arange(180))
    for k in (0, 63, 64, 179):
        np.testing.assert_allclose(
            inverse_columns(cholesky, np.array([k]))[:, 0], together[:, k], rtol=1e-12
        )


def test_an_analysis_serves_other_numbers_on_its_pattern():
    pattern = pattern_of([3, 2, 3, 2], [(1, 0), (2, 0), (3, 2)])
    analysis = analysed(pattern)
    for seed in range(3):
        dense = dense_on(pattern, np.random.default_rng(seed))
        right = np.ones((10, 1))
        solution = solved(factorised(analysis, values_of(pattern, dense)), right)
        np.testing.assert_allclose(dense @ solution, right, atol=1e-9)


@pytest.mark.parametrize("bad", range(5))
def test_an_indefinite_matrix_names_the_variable_of_its_pivot(bad):
    pattern = pattern_of([3, 2, 3, 2, 1], [])
    dense = np.eye(11)
    last = pattern.offset[bad + 1] - 1
    dense[last, last] = -1.0
    with pytest.raises(NotPositiveDefiniteError) as caught:
        factorised(analysed(pattern), values_of(pattern, dense))
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
        factorised(analysed(pattern), values_of(pattern, dense))


def test_a_column_without_its_diagonal_block_is_no_pattern():
    with pytest.raises(ValueError, match="diagonal"):
        Pattern(np.array([3, 2]), np.array([0, 1, 2]), np.array([0, 0]))


def test_a_chain_is_eliminated_without_fill():
    pattern = pattern_of([3] * 40, [(i + 1, i) for i in range(39)])
    elimination = minimum_degree(pattern.sizes, pattern.column_start, pattern.rows)
    assert np.diff(elimination.start).max() == 1
    assert sorted(elimination.order) == list(range(40))


def test_what_everything_sees_is_eliminated_last():
    spokes = [(40, i) for i in range(40)]
    chain = [(i + 1, i) for i in range(39)]
    pattern = pattern_of([3] * 40 + [2], chain + spokes)
    elimination = minimum_degree(pattern.sizes, pattern.column_start, pattern.rows)
    assert 40 in elimination.order[-2:]
    assert np.diff(elimination.start).max() == 2


def test_a_child_comes_before_its_parent_and_subtrees_are_contiguous():
    rng = np.random.default_rng(2)
    pairs = [(i, j) for i in range(30) for j in range(i) if rng.random() < 0.08]
    pattern = pattern_of([2] * 30, pairs)
    parent = minimum_degree(pattern.sizes, pattern.column_start, pattern.rows).parent
    size = np.ones(30, dtype=int)
    for step, above in enumerate(parent):
        assert above == -1 or above > step
        if above >= 0:
            size[above] += size[step]
    for step in range(30):
        subtree = {step}
        for below in range(step - 1, -1, -1):
            if parent[below] in subtree:
                subtree.add(below)
        assert subtree == set(range(step - size[step] + 1, step + 1))


def test_the_same_numbers_give_the_same_bytes():
    pattern = pattern_of([3, 2, 3, 2], [(1, 0), (2, 0), (3, 2), (3, 0)])
    values = values_of(pattern, dense_on(pattern, np.random.default_rng(3)))
    first, second = (factorised(analysed(pattern), values) for _ in range(2))
    assert first.panels.tobytes() == second.panels.tobytes()
    assert selected_inverse(first).tobytes() == selected_inverse(second).tobytes()
