"""A damped iteration is that of Levenberg and Marquardt, and the next one is damped less."""

from dataclasses import replace

import numpy as np
import pytest

from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, take_step
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import team


def dense(pattern, values):
    """The symmetric matrix whose blocks of the lower triangle these are."""
    matrix = np.zeros((pattern.offset[-1], pattern.offset[-1]))
    for entry, (row, column) in enumerate(zip(pattern.rows, pattern.columns, strict=True)):
        block = values[pattern.value_start[entry] : pattern.value_start[entry + 1]]
        block = block.reshape(pattern.sizes[row], pattern.sizes[column])
        rows, columns = (slice(pattern.offset[k], pattern.offset[k + 1]) for k in (row, column))
        matrix[rows, columns], matrix[columns, rows] = block, block.T
    return matrix


@pytest.mark.parametrize("damping", [1e-4, 0.3, 20.0])
def test_a_damped_step_solves_the_equations_with_so_much_more_of_their_diagonal(damping):
    world = team(4, robots=2, submaps=4)
    island = joined_with(world.submaps, world.starts, (), JoinSettings(), 1000).main
    free = np.repeat(~island.graph.fixed, np.diff(island.graph.offset))
    away = np.random.default_rng(1).uniform(-0.01, 0.01, len(free))
    island = replace(island, state=np.where(free, island.state + away, island.state))
    values, gradient = island.estimate.normal_equations
    hessian = dense(island.graph.pattern, values)
    damped = hessian + damping * np.diag(np.diag(hessian))
    expected = -np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
    moved, (eased, largest) = take_step(island, damping)
    np.testing.assert_allclose((moved.state - island.state)[free], expected, rtol=1e-6, atol=1e-10)
    np.testing.assert_array_equal(moved.state[~free], island.state[~free])
    assert largest == pytest.approx(np.abs(expected).max())
    assert eased == pytest.approx(0.0 if damping == 1e-4 else damping / 10.0)
    assert island.estimate.cost_of(moved.estimate) < island.estimate.cost_of(island.estimate)
