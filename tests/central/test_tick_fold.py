from functools import cache

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.tick_fold import TickFold
from teamslam.team import translate
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, add_start, fold_submaps
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import digest_of
from tests.teams import Submaps, stream

CONFIG = CentralConfig(tick_s=4.0)
SUBMAPS = Submaps([stream(name, 15, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))])


def fresh(config=CONFIG):
    ticks = TickFold(config)
    for name, y in (("r1", 0.0), ("r2", 1.0)):
        ticks.add_start(translate.InitialPoseFactor(name, 1, np.array([0.0, y, 0.0]), None))
    return ticks


def add(ticks, submap):
    ticks.add_submap(submap, digest_of(encoded(submap)))


def bits(fold):
    parts = [fold.main.state.tobytes(), *(str(c.key).encode() for c in fold.contributions)]
    return b"".join(parts)


def straight():
    ticks = fresh()
    for each in SUBMAPS.every():
        add(ticks, each)
    ticks.fold_until(float("inf"))
    return ticks


@cache
def expected():
    return bits(straight().fold)


def test_a_late_submap_rolls_back_to_before_its_tick_and_no_further():
    ticks = fresh()
    for each in SUBMAPS["r1"]:
        add(ticks, each)
    assert ticks.fold_until(12e9)
    before = [bits(each.fold) for each in ticks.checkpoints.kept]
    add(ticks, SUBMAPS["r2"][0])
    assert ticks.checkpoints.kept == ()
    for each in SUBMAPS["r2"][1:]:
        add(ticks, each)
    ticks.fold_until(float("inf"))
    assert bits(ticks.fold) == expected()
    assert bits(ticks.checkpoints.kept[0].fold) != before[0]
    kept = [each.fold for each in ticks.checkpoints.kept]
    add(ticks, SUBMAPS["r2"][-1])
    assert [each.fold for each in ticks.checkpoints.kept] == kept[:-1], (
        "earlier checkpoints stay as they are"
    )


def test_a_tick_is_taken_when_the_watermark_has_reached_its_end():
    ticks = fresh()
    for each in SUBMAPS.every():
        add(ticks, each)
    assert not ticks.fold_until(4e9 - 1)
    assert ticks.fold_until(4e9)
    assert not ticks.fold_until(4e9)
    assert {c.end_ns for c in ticks.fold.contributions} == {3_000_000_000}
    ticks.fold_until(8e9)
    assert [c.end_ns // 10**9 for c in ticks.fold.contributions] == [3, 3, 6, 6]


@pytest.mark.parametrize("tick_s", [3.0, 1.5])
def test_a_submap_that_ends_where_a_tick_ends_is_in_it(tick_s):
    ticks = fresh(CentralConfig(tick_s=tick_s))
    add(ticks, SUBMAPS["r1"][0])
    assert ticks.fold_until(3e9)
    assert len(ticks.fold.contributions) == 1


def test_the_fold_by_ticks_is_the_fold_of_the_joined_submaps():
    fold_by_hand = EMPTY_FOLD
    contributions = sorted(
        (translate.contribution_of(x) for x in SUBMAPS.every()), key=lambda c: c.key
    )
    for name, y in (("r1", 0.0), ("r2", 1.0)):
        fold_by_hand = add_start(
            fold_by_hand, translate.InitialPoseFactor(name, 1, np.array([0.0, y, 0.0]), None)
        )
    for tick in range(4):
        part = [c for c in contributions if (c.end_ns - 1) // 4_000_000_000 == tick]
        fold_by_hand = fold_submaps(fold_by_hand, part, fresh().settings)
    assert bits(fold_by_hand) == expected()


def test_the_digest_changes_with_any_member_any_start_and_what_else_is_named():
    whole = straight()
    digests = {whole.digest(whole.fold, b"x"), whole.digest(whole.fold, b"y")}
    for left_out in (SUBMAPS["r1"][-1], SUBMAPS["r2"][-1]):
        ticks = fresh()
        for each in SUBMAPS.every():
            if each != left_out:
                add(ticks, each)
        ticks.fold_until(float("inf"))
        digests.add(ticks.digest(ticks.fold, b"x"))
    moved = straight()
    moved.add_start(translate.InitialPoseFactor("r1", 1, np.array([0.0, 0.0, 1e-9]), None))
    digests.add(moved.digest(moved.fold, b"x"))
    vague = straight()
    vague.add_start(translate.InitialPoseFactor("r1", 1, np.zeros(3), np.eye(3)))
    digests.add(vague.digest(vague.fold, b"x"))
    assert len(digests) == 6
    assert straight().digest(straight().fold, b"x") in digests
