import numpy as np
import pytest

from teamslam.sim.studies.batch_reference import growing as batch
from tests.estimation.team_rounds import STARTS, team_run

KNOWN = {robot: (pose, None) for robot, pose in STARTS.items()}


def turns_of(rounds):
    return [turn for turns in rounds for turn in turns]


def converged(start, turns):
    found = batch.solve(batch.add_steps(start, turns), 100, 1e-5)
    assert found.converged(1e-5)
    return found


def test_how_it_has_grown_does_not_matter():
    rounds, _ = team_run(7, steps=9)
    whole = converged(batch.initial_state(KNOWN, None), turns_of(rounds))
    grown = batch.initial_state(KNOWN, None)
    for k in range(0, 9, 3):
        grown = batch.add_steps(grown, turns_of(rounds[k : k + 3]))
        grown = batch.solve(grown, 2, 1e-2)
    grown = converged(grown, [])
    for one, other in zip(
        batch.landmark_gaussian(whole), batch.landmark_gaussian(grown), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("robust", [True, False], ids=["Cauchy", "mutant: plain squares"])
def test_a_robust_batch_leaves_outliers_out(robust):
    rounds, _ = team_run(11, steps=12)
    turns = turns_of(rounds)
    victim = turns[9]
    ranges = victim.ranges.copy()
    ranges[0] += 20.0
    spoilt = [*turns[:9], victim._replace(ranges=ranges), *turns[10:]]
    clean = batch.landmark_gaussian(converged(batch.initial_state(KNOWN, None), turns))
    found = batch.solve(
        batch.add_steps(batch.initial_state(KNOWN, 2.0 if robust else None), spoilt), 200, 1e-6
    )
    assert found.converged(1e-6)
    off = (batch.landmark_gaussian(found).means - clean.means).ravel()
    sigmas = float(np.abs(off / np.sqrt(np.diag(clean.covariance))).max())
    assert (sigmas < 1.0) == robust, sigmas
