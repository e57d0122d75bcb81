from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from teamslam.central import checkpoints, tick_fold
from teamslam.central.checkpoints import NEAR, Checkpoint, thinned
from teamslam.central.config import CentralConfig
from teamslam.central.tick_fold import TickFold
from teamslam.team import translate
from teamslam.team.estimation.map_joining import landmark_view, marginals, tick
from teamslam.team.estimation.map_joining.condensing import Limits
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, add_start, fold_submaps
from teamslam.team.wire.arrays import floats, from_floats
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import digest_of
from tests.teams import Submaps, stream

CONFIG = CentralConfig(tick_s=4.0)
SHORT, SUBMAPS = (
    Submaps([stream(name, steps, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))])
    for steps in (15, 40)
)
SMALL = Limits(begin=6, lag=2, first=1)
"""Two submaps of each stream stay raw, beyond six in all; at 9 and at 13 all is linearised again.
Landmarks rest from the first one on."""
LATER_NS = 40_000_000_000  # end of the streams; a robot that appears then


def fresh(submaps=(), limits=None, config=CONFIG):
    """A fold with known starts and these submaps."""
    ticks = TickFold(config, limits)
    for name, y in (("r1", 0.0), ("r2", 1.0)):
        ticks.add_start(translate.InitialPoseFactor(name, 1, np.array([0.0, y, 0.0]), None))
    add(ticks, *submaps)
    return ticks


def add(ticks, *submaps):
    for each in submaps:
        ticks.add_submap(each, digest_of(encoded(each)))


def folded(*given, **options):
    ticks = fresh(*given, **options)
    ticks.fold_until(float("inf"))
    return ticks


def bits(fold):
    old = fold.main.graph.condensed
    parts = [fold.main.state.tobytes(), *(str(c.key).encode() for c in fold.contributions)]
    if old is None:
        return b"".join(parts)
    rest = landmark_view.resting(fold.main)
    more = (of(fold.main, rest) for of in (landmark_view.points_of, landmark_view.blocks_of))
    return b"".join([*parts, *(each.tobytes() for each in (old.factor.information, *more))])


@cache
def of_short():
    return bits(folded(SHORT.every()).fold)


def test_a_late_submap_rolls_back_to_before_its_tick_and_no_further():
    ticks = fresh(SHORT["r1"])
    assert ticks.fold_until(12e9)
    before = [bits(each.fold) for each in ticks.checkpoints.kept]
    add(ticks, SHORT["r2"][0])
    assert ticks.checkpoints.kept == ()
    add(ticks, *SHORT["r2"][1:])
    ticks.fold_until(float("inf"))
    assert bits(ticks.fold) == of_short()
    assert bits(ticks.checkpoints.kept[0].fold) != before[0]
    kept = [each.fold for each in ticks.checkpoints.kept]
    add(ticks, SHORT["r2"][-1])
    assert [each.fold for each in ticks.checkpoints.kept] == kept[:-1], "earlier ones stay"


def test_a_tick_is_taken_when_the_watermark_has_reached_its_end():
    ticks = fresh(SHORT.every())
    assert not ticks.fold_until(4e9 - 1)
    assert ticks.fold_until(4e9)
    assert not ticks.fold_until(4e9)
    assert {c.end_ns for c in ticks.fold.contributions} == {3_000_000_000}
    ticks.fold_until(8e9)
    assert [c.end_ns // 10**9 for c in ticks.fold.contributions] == [3, 3, 6, 6]


@pytest.mark.parametrize("tick_s", [3.0, 1.5])
def test_a_submap_that_ends_where_a_tick_ends_is_in_it(tick_s):
    ticks = fresh(SHORT["r1"][:1], config=CentralConfig(tick_s=tick_s))
    assert ticks.fold_until(3e9)
    assert len(ticks.fold.contributions) == 1


def test_the_fold_by_ticks_is_the_fold_of_the_joined_submaps():
    fold = EMPTY_FOLD
    contributions = sorted(map(translate.contribution_of, SHORT.every()), key=lambda c: c.key)
    for name, y in (("r1", 0.0), ("r2", 1.0)):
        start = translate.InitialPoseFactor(name, 1, np.array([0.0, y, 0.0]), None)
        fold = add_start(fold, start)
    for number in range(4):
        part = [c for c in contributions if (c.end_ns - 1) // 4_000_000_000 == number]
        fold = fold_submaps(fold, part, fresh().settings)
    assert bits(fold) == of_short()


def test_the_digest_changes_with_any_member_any_start_and_what_else_is_named():
    whole = folded(SHORT.every())
    digests = {whole.digest(whole.fold, b"x"), whole.digest(whole.fold, b"y")}
    for left_out in (SHORT["r1"][-1], SHORT["r2"][-1]):
        ticks = folded(each for each in SHORT.every() if each != left_out)
        digests.add(ticks.digest(ticks.fold, b"x"))
    for pose, spread in ((np.array([0.0, 0.0, 1e-9]), None), (np.zeros(3), np.eye(3))):
        other = folded(SHORT.every())
        other.add_start(translate.InitialPoseFactor("r1", 1, pose, spread))
        digests.add(other.digest(other.fold, b"x"))
    assert len(digests) == 6
    again = folded(SHORT.every())
    assert again.digest(again.fold, b"x") in digests


# Bounded: old submaps are condensed.


condensed = partial(folded, limits=SMALL)


@pytest.fixture(scope="module")
def expected():
    fold = condensed(SUBMAPS.every()).fold
    assert fold.condensed_count > 0.5 * len(SUBMAPS.every())
    assert len(landmark_view.resting(fold.main)) > 1
    return bits(fold)


@settings(deadline=None, max_examples=6)
@given(st.randoms(use_true_random=False))
def test_any_order_of_arrival_with_watermarks_between_gives_the_same_bits(expected, random):
    ticks = fresh(limits=SMALL)
    waiting = {name: list(submaps) for name, submaps in SUBMAPS.items()}
    order = [each.robot for each in SUBMAPS.every()]
    random.shuffle(order)
    for robot in order:
        add(ticks, waiting[robot].pop(0))
        if random.random() < 0.3:
            ticks.fold_until(random.choice([8e9, 16e9, 24e9, float("inf")]))
    assert bits(ticks.fold_ahead()) == expected
    ticks.fold_until(float("inf"))
    assert bits(ticks.fold) == expected


def test_what_a_late_submap_does_not_change_is_condensed_once(monkeypatch):
    *all_but_one, last = SUBMAPS.every()
    ticks, made = condensed(all_but_one), []
    condense = checkpoints.condense_submaps

    def noted(fold, limits):
        made.append(fold)
        return condense(fold, limits)

    monkeypatch.setattr(checkpoints, "condense_submaps", noted)
    add(ticks, last)
    ticks.fold_until(float("inf"))
    assert not made
    assert bits(ticks.fold) == bits(condensed(SUBMAPS.every()).fold)
    assert sum(each.ahead is not None for each in ticks.checkpoints.kept) <= NEAR


def test_the_full_solution_is_that_of_the_raw_set_and_folds_no_tick_again(monkeypatch):
    bounded, full = (folded(SUBMAPS.every(), limits=limits) for limits in (SMALL, None))
    assert bounded.fold.condensed_count > full.fold.condensed_count == 0
    assert bounded.digest(bounded.fold) == full.digest(full.fold)
    assert bounded.members(bounded.fold) == full.members(full.fold)
    monkeypatch.delattr(tick_fold, "fold_tick")
    one, other = bounded.solve(), full.solve()
    assert_same_solution(one, other)


def assert_same_solution(one, other):
    """The same raw submaps, and the same map up to the solver's iterations."""
    assert one.condensed_count == other.condensed_count == 0
    assert one.main.graph.streams.keys() == other.main.graph.streams.keys()
    assert [c.key for c in one.contributions] == [c.key for c in other.contributions]
    maps = [marginals.landmark_map(fold) for fold in (one, other)]
    assert np.allclose(maps[0].means, maps[1].means, atol=1e-6)
    assert np.allclose(maps[0].covariance, maps[1].covariance, rtol=1e-5)


def test_a_refused_submap_is_not_restored(monkeypatch):
    members = SUBMAPS.every()
    at = next(k for k, each in enumerate(members) if (each.robot, each.sequence) == ("r2", 11))
    turned = floats(members[at].mean, "mean").copy()
    turned[2] = 7.0
    members[at] = replace(members[at], mean=from_floats(turned))
    bounded, full = (folded(members, limits=limits) for limits in (SMALL, None))
    assert bounded.fold.condensed_count > 0
    monkeypatch.delattr(tick_fold, "fold_tick")
    one, other = bounded.solve(), full.solve()
    assert len(one.refused) == len(other.refused) == 3
    assert_same_solution(one, other)


def test_a_submap_with_its_motion_alone_is_restored_so(monkeypatch):
    """With the landmarks of r2's submap 5 no graph counts as solvable."""
    members = SUBMAPS.every()
    solvable = tick.is_solvable

    def strict(island):
        chosen = (each.contribution for each in island.graph.submaps)
        return solvable(island) and not any(
            (each.robot, each.sequence) == ("r2", 5) and len(each.local.ids) for each in chosen
        )

    monkeypatch.setattr(tick, "is_solvable", strict)
    bounded, full = (fresh(members, limits=limits) for limits in (SMALL, None))
    one, other = bounded.solve(), full.solve()
    assert bounded.fold.condensed_count > 0
    assert one.motion_only == other.motion_only != frozenset()
    assert_same_solution(one, other)


@pytest.mark.parametrize("known", [True, False])
def test_a_new_main_island_merges_with_the_condensed_one(known):
    """r1 appears late and fixes the frame, by its start or its name; r2 is condensed by then."""
    late = [
        replace(each, stamp_ns=each.stamp_ns + LATER_NS, start_ns=each.start_ns + LATER_NS)
        for each in SUBMAPS["r1"]
    ]
    ticks, full = (TickFold(CONFIG, limits) for limits in (SMALL, None))
    for each in (ticks, full):
        if known:
            each.add_start(translate.InitialPoseFactor("r1", 1, np.zeros(3), None))
        add(each, *SUBMAPS["r2"], *late)
    ticks.fold_until(LATER_NS)
    before = ticks.fold
    assert before.condensed_count > 0
    assert before.main_key == ("r2", 1)
    ticks.fold_until(float("inf"))
    assert ticks.fold.main_key == ("r1", 1)
    assert ticks.fold.reasons == {}
    assert len(ticks.fold.joined) == 1
    assert ticks.fold.condensed_count > 0, "the merged island is condensed again"
    assert_same_solution(ticks.solve(), full.solve())


def test_a_withdrawal_gives_the_fold_without_the_robot():
    ticks, without = condensed(SUBMAPS.every()), condensed(SUBMAPS["r1"])
    ticks.withdraw_robot("r2")
    ticks.fold_until(float("inf"))
    assert bits(ticks.fold) == bits(without.fold)


def test_checkpoints_are_few_and_spaced_by_their_age():
    kept: tuple[Checkpoint, ...] = ()
    for number in range(1, 5001):
        kept = thinned((*kept, Checkpoint(number, EMPTY_FOLD, 0, number)))
    numbers = [each.number for each in kept]
    assert len(numbers) < 45
    assert numbers[-4:] == list(range(4997, 5001))
    for age in range(1, 4900):
        before = max((number for number in numbers if number <= 5000 - age), default=0)
        assert 5000 - before <= 2.0 * age
