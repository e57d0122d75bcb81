"""The bounded fold of landmarks without names: what is condensed, and what is remembered of it."""

import numpy as np
import pytest

from teamslam.team.association import AssociationProfile
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.auditing import fold_tick
from teamslam.team.estimation.map_joining.condensed_factor import places
from teamslam.team.estimation.map_joining.condensing import Limits, condense_submaps
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold, JoinSettings, Tick
from teamslam.team.estimation.map_joining.memory import MOST, Memory, Observed
from teamslam.team.estimation.map_joining.relinearising import restore_submaps
from teamslam.team.estimation.map_joining.submap_graph import tied
from tests.estimation.association.unnamed_worlds import (
    circle,
    drive,
    duplicates,
    wrong,
)

SETTINGS = JoinSettings(association=AssociationProfile(recent=4))
LAPS = 5


@pytest.fixture(scope="module")
def laps():
    """Laps of one robot on a ring: the full fold and the bounded one, submap after submap."""
    rng = np.random.default_rng(5)
    angle = 2.0 * np.pi * (np.arange(60) + 0.6 * rng.uniform(size=60)) / 60
    r = rng.uniform(17.0, 23.0, 60)
    world = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    submaps, truth = drive("r1", circle((0.0, 0.0), 20.0, 24 * LAPS, LAPS), world, rng)
    full = bounded = EMPTY_FOLD
    for submap in submaps:
        full = fold_tick(full, Tick([submap]), SETTINGS)
        before = condense_submaps(bounded, Limits(30, lag=4))
        bounded = fold_tick(before, Tick([submap]), SETTINGS)
    return submaps, truth, full, bounded


def _members(fold: Fold) -> set[frozenset[object]]:
    return {frozenset(each) for each in fold.landmarks.sets.values()}


def _apart(one: Fold, other: Fold) -> float:
    """Compute the distance of two maps in σ² per degree of freedom."""
    a, b = marginals.landmark_map(one), marginals.landmark_map(other)
    assert a.ids.tolist() == b.ids.tolist()
    difference = (a.means - b.means).ravel()
    return float(difference @ np.linalg.solve(a.covariance, difference) / len(difference))


def test_the_bounded_fold_unites_the_same_landmarks_as_the_full_one(laps):
    submaps, truth, full, bounded = laps
    assert bounded.condensed_count > 0.5 * len(submaps)
    assert wrong(bounded.landmarks, truth) == duplicates(bounded.landmarks, truth) == 0
    assert _members(bounded) == _members(full)
    assert _apart(full, bounded) < 1e-2
    variances = [np.diag(marginals.landmark_map(each).covariance) for each in (full, bounded)]
    assert np.allclose(*variances, rtol=0.1)
    assert marginals.confirmed(bounded, 3) == marginals.confirmed(full, 3)


def test_what_is_remembered_is_the_newest_submaps_of_each_landmark(laps):
    *_, bounded = laps
    graph = bounded.main.graph
    seen = np.concatenate([each.landmarks for each in graph.memory.submaps])
    counts = np.bincount(seen, minlength=len(graph.fixed))
    assert counts.max() > MOST
    once = Memory(graph.memory.submaps).shortened(len(graph.fixed), most=1)
    twice = Memory(graph.memory.submaps).shortened(len(graph.fixed), most=2)
    assert 0 < len(once.submaps) < len(twice.submaps) < len(graph.memory.submaps)
    newest: dict[int, Observed] = {}
    for each in graph.memory.submaps:
        newest |= dict.fromkeys(each.landmarks.tolist(), each)
    assert set(map(id, newest.values())) == set(map(id, once.submaps))
    assert once.distinct.all()  # one keyframe saw all of each submap
    pairs = set(map(tuple, once.pairs.tolist()))
    gone = next(each for each in graph.memory.submaps if each not in once.submaps)
    assert tuple(sorted(gone.landmarks[:2].tolist())) in pairs


def test_landmarks_that_become_one_do_so_in_what_is_condensed_exactly(laps):
    """The same point costs the same as one node and as two that are equal."""
    *_, bounded = laps
    island = bounded.main
    before = island.graph
    one, two = sorted(before.landmarks, key=before.landmarks.__getitem__)[5:7]
    after, state = tied(before, island.state, {two: one})
    assert before.condensed is not None
    assert after.condensed is not None
    assert len(after.condensed.nodes) == len(before.condensed.nodes) - 1
    state = state + 0.1 * np.random.default_rng(1).normal(size=len(state))
    node_of = np.cumsum(np.arange(len(before.fixed)) != before.landmarks[two]) - 1
    node_of[before.landmarks[two]] = after.landmarks[one]
    equal = state[places(after.offset, node_of)]
    cost = _cost_of(before.condensed, equal[before.boundary])
    assert _cost_of(after.condensed, state[after.boundary]) == pytest.approx(cost, rel=1e-9)


def _cost_of(condensed, values):
    d = condensed.moved(values, np.arange(len(values)))
    return condensed.cost + 2.0 * condensed.slope @ d + d @ condensed.information @ d


def test_what_is_linearised_again_has_the_identities_that_were_found(laps):
    submaps, _, full, bounded = laps
    again = restore_submaps(bounded, submaps, [])
    assert again.condensed_count == 0
    assert not again.main.graph.memory.submaps
    assert _apart(full, again) < 1e-6
    assert _members(condense_submaps(again, Limits(30, lag=4))) == _members(full)
