import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.join_messages import reasons, shown_landmarks
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.association import AssociationProfile
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.distinctness import find_odometry_ties, find_parts
from teamslam.team.estimation.map_joining.gauss_newton import Island
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold, JoinSettings, Tick
from teamslam.team.estimation.map_joining.late_seams import find_late_seam
from teamslam.team.estimation.map_joining.tick import fold_tick
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats
from tests.estimation.association.unnamed_worlds import circle, drive
from tests.estimation.sighting_world import mirrored
from tests.scenarios import final_only, scenario_in
from tests.trials.stress_world import CarriedOff, StressWorld, write

SETTINGS = JoinSettings(association=AssociationProfile(recent=4))
ROUND = 14
SPARSE = np.array(
    [[9.0, 3.0], [2.0, 12.0], [-8.0, 5.0], [-11.0, -4.0], [-1.0, -10.0], [8.0, -7.0], [1.0, 1.0]]
)
"""Fewer landmarks in view than a seam needs at once (`continuity`)."""


def folded(*parts: list[Contribution]) -> Fold:
    """Fold drives one after the other, as if odometry joined those of a robot."""
    fold, sequence = EMPTY_FOLD, {"r1": 0, "r2": 0}
    ordered = sorted((e for p in parts for e in p), key=lambda each: (each.end_ns, each.robot))
    for each in ordered:
        own = replace(each, sequence=sequence[each.robot])
        sequence[each.robot] += 1
        fold = fold_tick(fold, Tick([own]), SETTINGS)
    return fold


def later(part: list[Contribution], by: int) -> list[Contribution]:
    return [replace(each, end_ns=each.end_ns + by * 10**10) for each in part]


def carried(seed: int, reach: float = 6.0) -> Fold:
    rng = np.random.default_rng(seed)
    before, _ = drive("r1", circle((0.0, 0.0), 8.0, ROUND, 1.1), SPARSE, rng, reach=reach)
    after, _ = drive("r1", circle((1.0, -1.0), 8.0, ROUND, 1.1, 2.5), SPARSE, rng, reach=reach)
    return folded(before, later(after, ROUND))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_landmarks_that_a_robot_should_observe_again_and_does_not_show_where_it_was_carried_off(
    seed,
):
    seam = find_late_seam(carried(seed).main)
    assert seam is not None
    assert seam.before == ROUND - 1
    assert seam.after in (ROUND, ROUND + 1)
    assert seam.begin_ns == ROUND * 10**10


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_robot_that_comes_back_to_its_landmarks_has_no_seam(seed):
    rng = np.random.default_rng(seed)
    path, _ = drive("r1", circle((0.0, 0.0), 8.0, 2 * ROUND, 2.2), SPARSE, rng, reach=6.0)
    assert find_late_seam(folded(path).main) is None


def far_apart() -> Fold:
    rng = np.random.default_rng(1)
    far = np.concatenate((SPARSE, SPARSE + np.array([60.0, 0.0])))
    before, _ = drive("r1", circle((0.0, 0.0), 8.0, ROUND, 1.0), far, rng, reach=6.0)
    way = np.column_stack([np.linspace(8.0, 68.0, 8), np.zeros(8), np.zeros(8)])
    between, _ = drive("r1", way, far, rng, reach=6.0)
    after, _ = drive("r1", circle((60.0, 0.0), 8.0, ROUND, 1.1), far, rng, reach=6.0)
    return folded(before, later(between, ROUND), later(after, ROUND + 7))


def test_a_robot_that_never_comes_near_its_former_landmarks_has_no_seam():
    assert find_late_seam(far_apart().main) is None


def test_a_part_that_odometry_alone_places_is_named_where_the_robot_misses_landmarks():
    fold = carried(1)
    (found,) = find_odometry_ties(fold.main, fold.main.graph.landmarks)
    assert found.stream == ("r1", 1)
    assert min(found.earlier, found.later) >= len(SPARSE)
    assert found.first == ROUND
    shown = shown_landmarks(fold, CentralConfig(), "final")
    (text,) = (each for each in reasons(fold, shown, (), 1) if "odometry alone" in each)
    (tie,) = shown.tied
    assert f"its {tie.later} landmarks beside the {tie.earlier} others" in text


def test_landmarks_on_both_sides_tie_a_map():
    rng = np.random.default_rng(1)
    many = rng.uniform(-15.0, 15.0, (40, 2))
    path, _ = drive("r1", circle((0.0, 0.0), 8.0, ROUND, 1.1), many, rng, reach=6.0)
    fold = folded(path)
    assert find_odometry_ties(fold.main, fold.main.graph.landmarks) == []
    assert len({*find_parts(fold.main).values()}) == 1


def sides(main: Island, first: int) -> tuple[set[int], set[int]]:
    id_of = {node: id_ for id_, node in main.graph.landmarks.items()}
    seen: tuple[set[int], set[int]] = set(), set()
    for each in main.graph.submaps:
        seen[each.contribution.sequence >= first].update(id_of[k] for k in each.landmarks.tolist())
    return seen


def test_a_tie_counts_possible_duplicates_beside_a_shown_landmark_on_each_side():
    main = carried(1).main
    (whole,) = find_odometry_ties(main, main.graph.landmarks)
    near, far = sides(main, whole.first)
    (tie,) = find_odometry_ties(main, [min(near), min(far)], near | far)
    assert tie == whole
    assert find_odometry_ties(main, [], near | far) == []
    assert find_odometry_ties(main, [min(near), min(far)]) == []


def test_no_part_of_a_map_has_landmarks_of_both_sides_of_a_tie():
    main = carried(1).main
    (tie,) = find_odometry_ties(main, main.graph.landmarks)
    part = find_parts(main)
    near, far = ({part[id_] for id_ in side} for side in sides(main, tie.first))
    assert near.isdisjoint(far)


def test_a_wall_that_hides_the_landmarks_of_each_side_is_no_seam():
    """The robot passes its end, where it tracks landmarks without a gap."""
    rng = np.random.default_rng(1)
    x = np.linspace(-12.0, 12.0, 9)
    sides = [np.column_stack([x, np.full(9, y)]) for y in (-2.0, 2.0)]
    end = np.array([[14.0, 0.0], [15.0, 2.0], [15.0, -2.0]])
    there = np.column_stack([np.linspace(-12.0, 14.0, 14), np.full(14, -1.0), np.zeros(14)])
    back = np.column_stack([there[::-1, 0], np.full(14, 1.0), np.full(14, math.pi)])
    turn = np.array([there[-1], [16.0, -1.0, math.pi / 2], [16.0, 1.0, math.pi], back[0]])
    one, _ = drive("r1", there, np.concatenate((sides[0], end)), rng, reach=5.0)
    round_it, _ = drive("r1", turn, end, rng, reach=5.0)
    two, _ = drive("r1", back, np.concatenate((sides[1], end)), rng, reach=5.0)
    assert find_late_seam(folded(one, later(round_it, 13), later(two, 16)).main) is None


SPARSE_WORLD = StressWorld(seed=3, robots=1, hidden=True, landmarks=11, seconds=240.0)


def run(world: StressWorld) -> tuple[m.FusedMap, np.ndarray]:
    with TemporaryDirectory() as folder:
        place = write(world, Path(folder))
        scenario = final_only(scenario_in(place))
        final = final_map(list(run_team(scenario, streams_of(scenario))))
        rows = np.loadtxt(place / "landmarks.csv", delimiter=",", skiprows=1)
    return final, rows[:, 1:]


@pytest.mark.parametrize("metres", [5.0, 15.0])
def test_the_final_map_of_few_landmarks_has_no_second_copy_and_names_the_time(metres):
    final, landmarks = run(
        replace(SPARSE_WORLD, carried_off=(CarriedOff("r1", metres, 1.2, 120.0),))
    )
    means = floats(final.means, "means").reshape(-1, 2)
    away = np.hypot(*(means[:, None] - landmarks).transpose(2, 0, 1))
    assert len(means) >= 5
    assert away.min(axis=1).max() < 1.5
    assert len({*away.argmin(axis=1).tolist()}) == len(means)
    found = [each for each in final.diagnosis if each.cause == "carried_off"]
    assert [each.robot for each in found] == ["r1"]
    assert abs(found[0].at_ns * 1e-9 - 120.0) <= 10.0


def test_the_same_robot_left_alone_is_not_cut():
    final, _ = run(SPARSE_WORLD)
    assert not any(each.cause == "carried_off" for each in final.diagnosis)
    assert not any("refused" in each for each in final.reasons)


@pytest.mark.parametrize("seed", [401, 425])
def test_a_landmark_that_two_parts_may_share_is_shown_once(seed):
    """The robot returns to a few landmarks, too few for a closure, and misses none."""
    landmarks, half, reach = {401: (8, 20.0, 10.0), 425: (9, 15.0, 6.0)}[seed]
    final, truth = run(
        replace(SPARSE_WORLD, seed=seed, landmarks=landmarks, half_m=half, reach_m=reach)
    )
    means = floats(final.means, "means").reshape(-1, 2)
    nearest = np.hypot(*(means[:, None] - truth).transpose(2, 0, 1)).argmin(axis=1)
    assert len(means) >= 5
    assert len({*nearest.tolist()}) == len(means)
    assert not any("odometry alone" in each for each in final.reasons)


def test_an_island_without_unnamed_landmarks_has_no_late_seam():
    island, _ = mirrored(0.02, JoinSettings())
    assert find_late_seam(island) is None
