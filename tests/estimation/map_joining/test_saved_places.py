from dataclasses import replace

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.join_messages import shown_landmarks
from teamslam.central.saved_maps import landmark_changes
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.fold_association import associate_tick
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    JoinSettings,
    ages,
    solve_island,
)
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold, solve_fold
from teamslam.team.estimation.map_joining.landmark_view import points_of
from teamslam.team.estimation.map_joining.submap_graph import EMPTY_GRAPH, add_submaps
from teamslam.team.estimation.submap import LocalMap, Unnamed

SITE, ROBOT = ("map-site", 0), ("r1", 1)
ANGLES = 2.0 * np.pi * np.arange(8) / 8
PLACES = 5.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
MOVED, BY = 3, np.array([0.25, -0.18])


def island(first: int, having: int, submaps: int) -> Island:
    """A map of eight landmarks, and a robot in their midst, at rest.

    The landmark at index MOVED is elsewhere, in `having` of the robot's submaps.
    """
    taken = [Contribution(*SITE, 0, 0, _local(first, PLACES))]
    for k in range(submaps):
        places = PLACES.copy()
        places[MOVED] += BY
        keep = np.arange(len(places)) != MOVED if k >= having else np.full(len(places), True)
        taken.append(Contribution(*ROBOT, k, k + 1, _local(first, places, keep)))
    graph, state = add_submaps(EMPTY_GRAPH, np.zeros(0), taken, {}, {})
    return solve_island(Island(graph, state, ages(len(taken)), ages(0), JoinSettings()))[0]


def _local(first: int, places: np.ndarray, keep: np.ndarray | None = None) -> LocalMap:
    chosen = np.arange(len(places)) if keep is None else np.flatnonzero(keep)
    mean = np.concatenate([np.zeros(3), places[chosen].ravel()])
    variances = np.concatenate([[1e-4, 1e-4, 1e-6], np.full(2 * len(chosen), 0.05**2)])
    once = np.ones((len(chosen), 1), np.bool_) if first >= UNNAMED else np.ones((0, 1), np.bool_)
    unnamed = Unnamed(np.ones(len(once), np.uint32), once)
    ids = (first + chosen).astype(np.uint32)
    return LocalMap(ids, mean, np.diag(variances), unnamed=unnamed)


def final(of: Island) -> Fold:
    fold = Fold((), {}, {SITE: of}, {SITE: SITE, ROBOT: SITE}, EMPTY_FOLD.reasons)
    return solve_fold(fold, of.settings)


def states(of: Island) -> dict[int, str]:
    changes = landmark_changes(final(of), sorted(of.graph.landmarks))
    return {each.landmark - min(of.graph.landmarks): each.state for each in changes}


@pytest.mark.parametrize("submaps", [1, 6])
def test_a_single_submap_moves_no_landmark_that_is_known_by_its_place_alone(submaps: int) -> None:
    """It may have associated a neighbour, which becomes a landmark of its own."""
    of = island(UNNAMED, having=1, submaps=submaps)
    found = states(of)
    assert MOVED not in found
    assert {*found.values()} == {"unchanged"}
    assert len(found) == len(PLACES) - 1
    solved = final(of).main
    saved, other = points_of(solved, [UNNAMED + MOVED, UNNAMED + len(PLACES)])
    assert np.allclose(saved, PLACES[MOVED], atol=0.01)
    assert np.allclose(other, PLACES[MOVED] + BY, atol=0.01)


def test_a_single_submap_moves_a_landmark_that_its_number_identifies() -> None:
    assert states(island(1, having=1, submaps=1))[MOVED] == "moved"


def test_an_unnamed_landmark_has_moved_if_its_former_place_is_empty() -> None:
    found = states(island(UNNAMED, having=8, submaps=8))
    assert {k for k, state in found.items() if state != "unchanged"} == {MOVED}
    assert found[MOVED] == "moved"


def test_beside_a_former_place_that_may_have_been_overlooked_it_is_a_new_landmark() -> None:
    assert states(island(UNNAMED, having=2, submaps=2))[MOVED] == "new"
    assert states(island(1, having=2, submaps=2))[MOVED] == "moved"


def test_an_unnamed_landmark_is_tested_in_the_tick_that_associates_it() -> None:
    """Later its submaps are discounted against the saved map, which is not."""
    of = island(UNNAMED, having=8, submaps=8)
    fold = Fold((), {}, {SITE: of}, {SITE: SITE, ROBOT: SITE}, EMPTY_FOLD.reasons)
    newest = of.graph.submaps[-1].contribution
    assert {*associate_tick(fold, [newest]).main.graph.former} == {(SITE, UNNAMED + MOVED)}


def test_a_saved_landmark_that_nobody_looked_at_today_stays_in_the_map() -> None:
    """Its map counts as no single submap that all others contradict."""
    of = island(UNNAMED, having=0, submaps=8)
    taken = tuple(each.contribution for each in of.graph.submaps)
    fold = replace(final(of), contributions=taken)
    assert UNNAMED + MOVED in shown_landmarks(fold, CentralConfig(), "final").ids
