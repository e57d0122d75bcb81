"""Panels that are computed by blocks: the same as dense algebra, at every edge of a block."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_triangular

from team.estimation.map_joining.gauss_newton import JoinSettings
from team.estimation.map_joining.joining import EMPTY_FOLD, folded, started
from team.estimation.sparse_cholesky import panel_products as products
from team.estimation.sparse_cholesky.sparse import (
    NotPositiveDefiniteError,
    Pattern,
    analysed,
    factorised,
    inverse_block,
    inverse_columns,
    selected_inverse,
    solved,
)
from team.estimation.sparse_cholesky.sparse_kernel import has_big_panel
from tests.estimation.sparse_cholesky.test_sparse import dense_on, values_of
from tests.estimation.submap_world import team

EDGES = sorted(
    {1, 2} | {size * k + d for size in (products.BLOCK, products.CHUNK) for k in (1, 2, 3)
     for d in (-1, 0, 1)}
)  # fmt: skip


def spd(n, rng):
    root = rng.normal(size=(n, n + 5))
    scale = 10.0 ** rng.uniform(-2.0, 2.0, n)
    return scale[:, None] * (root @ root.T + n * np.eye(n)) * scale


def panel_and_rest(width, below, seed):
    """The panel of A's first columns, the factor's panel, and what they are parts of."""
    dense = spd(width + below, np.random.default_rng(seed))
    panel = np.triu(dense)[:width].copy()
    return dense, panel, np.linalg.cholesky(dense).T[:width]


shapes = st.tuples(st.sampled_from(EDGES), st.sampled_from([0, *EDGES]), st.integers(0, 2**32))


@settings(deadline=None, max_examples=40)
@given(shapes)
def test_a_panel_by_blocks_is_the_dense_factor(shape):
    dense, panel, expected = panel_and_rest(*shape)
    sigma = np.sqrt(np.diag(dense))
    assert products.factorise_by_blocks(panel, np.zeros(len(panel))) == -1
    np.testing.assert_allclose(panel / sigma, expected / sigma, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(shapes)
def test_a_panel_s_part_of_the_inverse_is_the_dense_one(shape):
    width = shape[0]
    dense, _, factor = panel_and_rest(*shape)
    inverse = np.linalg.inv(dense)
    found = np.zeros(factor.shape)
    known = np.ascontiguousarray(inverse[width:, width:])
    products.selected_by_blocks(np.ascontiguousarray(factor), known, found)
    sigma = np.sqrt(np.diag(inverse))
    relative = sigma[:width, None] * sigma
    np.testing.assert_allclose(found / relative, np.triu(inverse)[:width] / relative, atol=1e-10)


@settings(deadline=None, max_examples=40)
@given(shapes, st.integers(0, 5))
def test_a_forward_solution_by_blocks_is_the_dense_one(shape, many):
    width, _, seed = shape
    _, _, factor = panel_and_rest(*shape)
    right = np.random.default_rng(seed).normal(size=(width, many))
    expected = solve_triangular(factor[:, :width].T, right, lower=True)
    products.solve_forward(np.ascontiguousarray(factor), right)
    np.testing.assert_allclose(
        right, expected, rtol=1e-9, atol=1e-10 * abs(expected).max(initial=0)
    )


@pytest.mark.parametrize("bad", [0, 1, *(edge for edge in EDGES if edge > 2)])
@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan])
def test_blocks_stop_at_the_same_pivot_as_the_loops(bad, value):
    width = EDGES[-1] + 3
    dense = spd(width, np.random.default_rng(bad))
    factor = np.linalg.cholesky(dense)
    dense[bad, bad] = factor[bad, :bad] @ factor[bad, :bad] + value * dense[bad, bad]
    least = 1e-12 * np.abs(np.diag(dense))
    panel = np.triu(dense)
    by_loops = products.factorise_columns(panel.copy(), 0, width, least)
    assert products.factorise_by_blocks(panel.copy(), least) == by_loops == bad


def pattern_with(sizes, tied):
    """The pattern with these blocks; `tied` is looked at below its diagonal."""
    columns = [np.append(j, j + 1 + np.flatnonzero(tied[j + 1 :, j])) for j in range(len(sizes))]
    starts = np.cumsum([0, *(len(rows) for rows in columns)])
    return Pattern(np.array(sizes), starts, np.concatenate(columns))


def clique(unknowns):
    """Everything is tied to everything; blocks of three unknowns as far as they go."""
    sizes = [3] * (unknowns // 3) + [1] * (unknowns % 3)
    return pattern_with(sizes, np.ones((len(sizes), len(sizes)), dtype=bool))


def groups_on_a_clique(seed):
    """Three groups that are tied to parts of a clique: big panels below a big root, and small ones.

    Each group: some 70 unknowns, all tied to each other and to some 580 of the clique's 1000.
    """
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


@pytest.fixture(scope="module", params=[0, 1])
def system(request):
    """(pattern, dense matrix, its inverse, Cholesky factor)."""
    pattern = groups_on_a_clique(request.param)
    dense = dense_on(pattern, np.random.default_rng(request.param))
    scale = 1.0 / np.sqrt(np.diag(dense))
    inverse = scale[:, None] * np.linalg.inv(scale[:, None] * dense * scale) * scale
    return pattern, dense, inverse, factorised(analysed(pattern), values_of(pattern, dense))


def test_the_systems_here_have_big_panels_of_each_kind(system):
    columns_of, row_start, _, _, _ = system[3].analysis.structure
    width, rows = np.diff(columns_of), np.diff(row_start)
    big = np.array([products.is_big(w, m) for w, m in zip(width, rows, strict=True)])
    assert big[-1]
    assert (big & (width > products.BLOCK) & (rows - width > products.CHUNK)).sum() >= 2
    assert not big.all()


def test_solution_of_a_big_system_is_right(system):
    _, dense, _, cholesky = system
    right = dense @ np.random.default_rng(0).normal(size=(len(dense), 3))
    error = dense @ solved(cholesky, right) - right
    assert (abs(error) < 1e-11 * (abs(dense) @ np.ones((len(dense), 1)))).all()


def test_selected_inverse_of_a_big_system_is_the_dense_one(system):
    pattern, _, inverse, cholesky = system
    sigma = np.sqrt(np.diag(inverse))
    relative = values_of(pattern, np.outer(sigma, sigma))
    np.testing.assert_allclose(
        selected_inverse(cholesky) / relative, values_of(pattern, inverse) / relative, atol=1e-12
    )


@pytest.mark.parametrize("count", [0, 1, 40, 300])
def test_covariance_among_some_unknowns_of_a_big_system_is_the_dense_one(system, count):
    _, dense, inverse, cholesky = system
    chosen = np.random.default_rng(count).permutation(len(dense))[:count]
    found = inverse_block(cholesky, chosen)
    sigma = np.sqrt(np.diag(inverse))[chosen]
    relative = np.outer(sigma, sigma)
    np.testing.assert_allclose(
        found / relative, inverse[np.ix_(chosen, chosen)] / relative, atol=1e-12
    )
    np.testing.assert_array_equal(found, found.T)


@pytest.mark.parametrize("beyond", [-1, 0, 1])
def test_a_clique_is_big_from_the_threshold_on_and_right_on_either_side(beyond):
    n = products.ROWS + beyond
    pattern = clique(n)
    dense = dense_on(pattern, np.random.default_rng(0))
    cholesky = factorised(analysed(pattern), values_of(pattern, dense))
    assert has_big_panel(cholesky.analysis.structure) == (beyond >= 0)
    chosen = np.arange(0, n, 7)
    block = inverse_block(cholesky, chosen)
    columns = inverse_columns(cholesky, chosen)[chosen]
    np.testing.assert_allclose(block, 0.5 * (columns + columns.T), rtol=1e-9)
    if beyond < 0:
        np.testing.assert_array_equal(block, 0.5 * (columns + columns.T))


@pytest.mark.parametrize("bad", [0, 15, 16, 50, 84, 85])
def test_an_indefinite_big_matrix_names_the_variable_of_its_pivot(bad):
    n = products.ROWS
    pattern = clique(n)
    dense = np.eye(n) + 1e-3
    unknown = pattern.offset[bad + 1] - 1
    dense[unknown, unknown] = -1.0
    with pytest.raises(NotPositiveDefiniteError) as caught:
        factorised(analysed(pattern), values_of(pattern, dense))
    assert caught.value.variable == bad


def test_a_hundred_landmarks_have_no_big_panel():
    world = team(0, robots=10, submaps=30, landmarks=100, size=60.0, reach=20.0)
    fold = EMPTY_FOLD
    for start in world.starts:
        fold = started(fold, start)
    fold = folded(fold, world.submaps, JoinSettings(iterations_per_tick=1))
    assert len(fold.main.graph.landmarks) == 100
    assert not has_big_panel(fold.main.graph.analysis.structure)
