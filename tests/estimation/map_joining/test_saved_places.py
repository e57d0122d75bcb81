"""Moves of a saved map's landmarks that today's submaps place, with numbers and without."""

import numpy as np
import pytest

from teamslam.central.saved_maps import landmark_changes
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.gauss_newton import (
    Island,
    JoinSettings,
    ages,
    solve_island,
)
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold
from teamslam.team.estimation.map_joining.saved_maps import (
    FALSE_ALARM,
    maps_of,
    next_change,
    separate,
)
from teamslam.team.estimation.map_joining.submap_graph import EMPTY_GRAPH, add_submaps
from teamslam.team.estimation.submap import LocalMap

SITE, ROBOT = ("map-site", 0), ("r1", 1)
ANGLES = 2.0 * np.pi * np.arange(8) / 8
PLACES = 5.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
MOVED, BY = 3, np.array([0.25, -0.18])


def island(first: int, having: int, submaps: int) -> Island:
    """A map of eight landmarks, and a robot in their midst, at rest.

    first: number of the first landmark. The one at index MOVED is elsewhere, in `having` of the
    robot's submaps.
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
    return LocalMap((first + chosen).astype(np.uint32), mean, np.diag(variances))


def states(of: Island) -> dict[int, str]:
    """Separate the landmark that next_change finds; return the states by index."""
    found = next_change(of, FALSE_ALARM)
    first = min(of.graph.landmarks)
    if found is not None:
        of = solve_island(separate(of, found[0], [found[1].landmark]))[0]
    fold = Fold((), {}, {SITE: of}, {SITE: SITE, ROBOT: SITE}, EMPTY_FOLD.reasons)
    changes = landmark_changes(fold, sorted(of.graph.landmarks))
    return {each.landmark - first: each.state for each in changes}


@pytest.mark.parametrize("submaps", [1, 6])
def test_a_single_submap_moves_no_landmark_that_is_known_by_its_place_alone(submaps):
    """It may have associated a neighbour; a number identifies it."""
    found = states(island(UNNAMED, having=1, submaps=submaps))
    assert MOVED not in found
    assert {*found.values()} == {"unchanged"}
    assert len(found) == len(PLACES) - 1
    of = island(1, having=1, submaps=1)
    found_named = next_change(of, FALSE_ALARM)
    assert found_named is not None
    assert found_named[1].landmark == 1 + MOVED
    assert found_named[0] is maps_of(of.graph)[0]


def test_an_unnamed_landmark_has_moved_if_its_former_place_is_empty():
    found = states(island(UNNAMED, having=8, submaps=8))
    assert {k for k, state in found.items() if state != "unchanged"} == {MOVED}
    assert found[MOVED] == "moved"


def test_beside_a_former_place_that_may_have_been_overlooked_it_is_a_new_landmark():
    assert states(island(UNNAMED, having=2, submaps=2))[MOVED] == "new"
    assert states(island(1, having=2, submaps=2))[MOVED] == "moved"
