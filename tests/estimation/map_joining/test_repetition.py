import math
from dataclasses import replace

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.join_messages import reasons, shown_landmarks
from teamslam.team.association import AssociationProfile
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.map_joining.distinctness import (
    BY_CHANCE,
    find_repetitions,
    log_by_chance,
)
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, Fold, JoinSettings, Tick
from teamslam.team.estimation.map_joining.tick import fold_tick
from tests.estimation.association.unnamed_worlds import circle, drive

SETTINGS = JoinSettings(association=AssociationProfile(recent=4))
ROUND = 14


def field(seed: int, count: int = 30, half: float = 15.0) -> np.ndarray:
    rng, kept = np.random.default_rng(seed), []
    while len(kept) < count:
        point = rng.uniform(-half, half, 2)
        if all(np.hypot(*(point - other)) > 2.0 for other in kept):
            kept.append(point)
    return np.array(kept)


def folded(*parts: list[Contribution]) -> Fold:
    """Fold a robot's drives one after the other, as if its odometry joined them."""
    fold, sequence = EMPTY_FOLD, 0
    for part in parts:
        for each in part:
            own = Contribution("r1", 1, sequence, (sequence + 1) * 10**10, each.local)
            fold, sequence = fold_tick(fold, Tick([own]), SETTINGS), sequence + 1
    return fold


def said(fold: Fold) -> list[str]:
    config = CentralConfig()
    shown = shown_landmarks(fold, config, "final")
    return [each for each in reasons(fold, shown, (), 1) if "look alike" in each]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_robot_that_was_carried_off_is_named_with_the_time_and_the_way_and_no_copy_is_shown(seed):
    rng, world = np.random.default_rng(seed), field(seed)
    before, _ = drive("r1", circle((0.0, 0.0), 9.0, ROUND, 1.1), world, rng, reach=7.0)
    after, _ = drive("r1", circle((1.0, -1.0), 8.0, ROUND, 1.1, 2.5), world, rng, reach=7.0)
    fold = folded(before, after)
    (found,) = find_repetitions(fold.main, fold.main.graph.landmarks)
    assert found.first == ROUND
    one, two = circle((0.0, 0.0), 9.0, ROUND, 1.1)[-1], circle((1.0, -1.0), 8.0, ROUND, 1.1, 2.5)[0]
    assert math.hypot(*found.displacement[:2]) == pytest.approx(
        math.hypot(*(two - one)[:2]), abs=0.5
    )
    assert len(found.pairs) >= 12
    shown = shown_landmarks(fold, CentralConfig(), "final")
    assert not set(found.ids) & set(shown.ids)
    (text,) = said(fold)
    assert "(t = 140 to 280 s) r1" in text
    assert "either the building repeats" in text


@pytest.mark.parametrize("same", [0.5, 2.5])
def test_a_copy_is_found_where_chance_explains_the_matches_of_wide_lengths(same):
    rng, world = np.random.default_rng(1), field(1)
    before, _ = drive("r1", circle((0.0, 0.0), 9.0, ROUND, 1.1), world, rng, reach=7.0)
    after, _ = drive("r1", circle((1.0, -1.0), 8.0, ROUND, 1.1, 2.5), world, rng, reach=7.0)
    island = folded(before, after).main
    wide = replace(island.settings, association=AssociationProfile(recent=4, same=same))
    (found,) = find_repetitions(replace(island, settings=wide), island.graph.landmarks)
    assert found.first == ROUND
    assert len(found.pairs) >= 12
    assert log_by_chance(len(found.ids), field(1), len(found.ids), 2.5) > BY_CHANCE


def test_two_equal_rooms_are_told_as_that_and_as_nothing_else():
    """The set does not distinguish such a building from a robot that was carried off."""
    rng, room = np.random.default_rng(5), field(5, 14, 8.0)
    rooms = np.concatenate((room, room + np.array([60.0, 0.0])))
    first, _ = drive("r1", circle((0.0, 0.0), 5.0, 8, 1.1), rooms, rng, reach=7.0)
    corridor = np.array([[5.0, 0.0, 0.0], [20.0, 0.0, 0.0], [40.0, 0.0, 0.0], [65.0, 0.0, 0.0]])
    way, _ = drive("r1", corridor, rooms, rng, reach=7.0)
    second, _ = drive("r1", circle((60.0, 0.0), 5.0, 8, 1.1), rooms, rng, reach=7.0)
    fold = folded(first, way, second)
    (found,) = find_repetitions(fold.main, fold.main.graph.landmarks)
    assert len(found.pairs) >= 12
    assert math.hypot(*found.displacement[:2]) == pytest.approx(60.0, abs=5.0)
    (text,) = said(fold)
    assert "either the building repeats itself, or the robot was carried off or slipped" in text


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_nothing_is_said_of_a_robot_that_explores_and_comes_back(seed):
    rng, world = np.random.default_rng(seed), field(seed, 60, 25.0)
    path = circle((0.0, 0.0), 16.0, 30, 1.4)
    submaps, _ = drive("r1", path, world, rng, reach=7.0)
    fold = folded(submaps)
    assert find_repetitions(fold.main, fold.main.graph.landmarks) == []
