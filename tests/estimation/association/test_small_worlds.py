from dataclasses import replace

import msgspec
import numpy as np
import pytest

from teamslam.central.join_messages import Shown, reasons
from teamslam.team.association import AssociationProfile
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.landmark_sets import Verdict
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Fold,
    InitialPoseFactor,
    JoinSettings,
    Tick,
    add_start,
)
from teamslam.team.estimation.map_joining.tick import fold_tick
from teamslam.team.estimation.se2 import transformed
from teamslam.team.estimation.submap import LocalMap, Unnamed
from tests.estimation.association.unnamed_worlds import circle, drive

SETTINGS = JoinSettings(association=AssociationProfile(recent=4))
R1, R2 = ("r1", 1), ("r2", 1)


def small_world(seed: int, count: int) -> np.ndarray:
    rng, world = np.random.default_rng(seed), np.zeros((0, 2))
    while len(world) < count:
        point = rng.uniform((-9.0, -7.5), (9.0, 7.5))
        if (np.hypot(*(world - point).T) > 1.0).all():
            world = np.vstack([world, point])
    return world


def drive_around(
    robot: str, world: np.ndarray, phase: float = 0.0
) -> tuple[list[Contribution], dict[LocalLandmark, int]]:
    path = circle((0.0, 0.0), 4.0, 8, 1.0, phase)
    return drive(robot, path, world, np.random.default_rng(1), reach=9.0)


def saved_map(world: np.ndarray) -> Contribution:
    n = len(world)
    moved = [transformed(np.array([3.0, 1.0, 0.8]), point) for point in world]
    mean = np.concatenate([np.zeros(3), np.ravel(moved)])
    unnamed = Unnamed(np.full(n, 5, np.uint32), np.ones((n, 1), np.bool_))
    ids = (UNNAMED + np.arange(n)).astype(np.uint32)
    covariance = np.diag(np.concatenate([np.full(3, 1e-6), np.full(2 * n, 0.03**2)]))
    return Contribution("map-site", 0, 0, 0, LocalMap(ids, mean, covariance, unnamed=unnamed))


def folded(
    submaps: list[Contribution],
    verdicts: tuple[Verdict, ...] = (),
    settings: JoinSettings = SETTINGS,
    fold: Fold = EMPTY_FOLD,
) -> Fold:
    ordered = sorted(submaps, key=lambda each: each.key)
    for each in ordered:
        judged = verdicts if each is ordered[-1] else ()
        fold = fold_tick(fold, Tick([each], verdicts=judged), settings)
    return fold


def test_robots_without_starts_that_share_everything_wait_and_the_reason_names_the_remedies():
    world = small_world(0, 15)
    submaps = [*drive_around("r1", world)[0], *drive_around("r2", world, 2.0)[0]]
    (why,) = [each for each in reasons(folded(submaps), Shown(), (), 1) if "not joined" in each]
    assert "context" in why
    for remedy in ("starts", "tags", "verdict", "central.association.context = 0"):
        assert remedy in why
    association = msgspec.structs.replace(SETTINGS.association, context=0.0)
    assert len(folded(submaps, settings=replace(SETTINGS, association=association)).islands) == 1


def test_robots_with_starts_that_share_everything_are_in_one_frame():
    world, fold = small_world(0, 15), EMPTY_FOLD
    for stream, phase in ((R1, 0.0), (R2, 2.0)):
        pose = circle((0.0, 0.0), 4.0, 8, 1.0, phase)[0]
        fold = add_start(fold, InitialPoseFactor(*stream, pose, np.diag([1e-4, 1e-4, 1e-6])))
    submaps = [*drive_around("r1", world)[0], *drive_around("r2", world, 2.0)[0]]
    fold = folded(submaps, fold=fold)
    assert len(fold.islands) == 1
    assert len(fold.main.graph.landmarks) == len(world)


@pytest.mark.parametrize(("same", "islands"), [(True, 1), (False, 2)])
def test_a_verdict_on_one_pair_joins_robots_that_share_everything(same: bool, islands: int):
    world = small_world(0, 15)
    one, first = drive_around("r1", world)
    two, second = drive_around("r2", world, 2.0)
    number = next(iter({*first.values()} & {*second.values()}))
    pair = (next(k for k, v in of.items() if v == number) for of in (second, first))
    assert len(folded([*one, *two], (Verdict(*pair, same=same),)).islands) == islands


def test_a_verdict_that_no_match_contains_joins_nothing():
    world = small_world(0, 15)
    one, first = drive_around("r1", world)
    two, second = drive_around("r2", world, 2.0)
    wrong = Verdict(
        next(k for k, v in first.items() if v == 0),
        next(k for k, v in second.items() if v == 1),
        True,
    )
    assert len(folded([*one, *two], (wrong,)).islands) == 2


@pytest.mark.parametrize("seed", range(4))
def test_a_saved_map_of_a_small_world_is_joined_though_a_landmark_has_moved(seed: int):
    world = small_world(seed, 15)
    today = world.copy()
    today[3] += (0.6, 0.8)
    robots = [*drive_around("r1", today)[0], *drive_around("r2", today, 2.0)[0]]
    assert len(folded([saved_map(world), *robots]).islands) == 1


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "change",
    [
        lambda world: world * (1.0, -1.0),
        lambda world: small_world(99, len(world)),
        lambda world: np.vstack([world[::2], small_world(99, len(world) // 2)]),
    ],
    ids=["mirrored", "another_site", "half_moved"],
)
def test_a_wrong_saved_map_of_a_small_world_is_not_joined(change, seed: int):
    world = small_world(seed, 18)
    fold = folded([saved_map(change(world)), *drive_around("r1", world)[0]])
    assert len(fold.islands) == 2


def test_a_saved_map_is_not_joined_by_one_part_while_the_rest_of_the_overlap_has_moved():
    """The last submaps match it without a rival, the landmarks of the former ones do not."""
    world = small_world(7, 20)
    moved = world[:, 0] >= 0.5
    elsewhere = small_world(57, 40)
    elsewhere = elsewhere[elsewhere[:, 0] >= 0.5][: moved.sum()]
    path = np.column_stack([np.linspace(6.0, -6.0, 13), np.zeros(13), np.full(13, np.pi)])
    submaps, _ = drive("r1", path, world, np.random.default_rng(1), reach=7.0)
    fold = folded([saved_map(np.vstack([world[~moved], elsewhere])), *submaps])
    assert len(fold.islands) == 2
    (waits,) = fold.landmarks.waits.values()
    assert waits.why.endswith("of the overlap with a saved map is matched")
