"""The running fold of a long run: bounded, a pure function of the set, and the final map is not."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from central import tick_fold
from central.checkpoints import NEAR, Checkpoint, thinned
from central.config import CentralConfig
from central.tick_fold import TickFold
from team import translate
from team.estimation.map_joining import landmark_view, marginals
from team.estimation.map_joining.condensing import condensed
from team.estimation.map_joining.joining import EMPTY_FOLD
from team.estimation.map_joining.relinearising import is_due
from team.wire.arrays import floats, from_floats
from team.wire.codec import encoded
from team.wire.digest import digest_of
from tests.teams import Submaps, stream

CONFIG = CentralConfig(tick_s=4.0)
SUBMAPS = Submaps([stream(name, 40, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))])


@pytest.fixture(autouse=True, scope="module")
def _small():
    """Two submaps of each stream stay raw, and it begins with five; at 9 and at 13 it is again.
    Landmarks rest from the first one on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tick_fold, "condensed", partial(condensed, lag=2, begin=5, first=1))
        patch.setattr(tick_fold, "is_due", partial(is_due, begin=6))
        yield


def fresh(bounded=True):
    ticks = TickFold(CONFIG, bounded)
    for name, y in (("r1", 0.0), ("r2", 1.0)):
        ticks.know_start(translate.InitialPoseFactor(name, 1, np.array([0.0, y, 0.0]), None))
    return ticks


def add(ticks, submap):
    ticks.add(submap, digest_of(encoded(submap)))


def bits(fold):
    old = fold.main.graph.condensed
    parts = [fold.main.state.tobytes(), *(str(c.key).encode() for c in fold.contributions)]
    if old is None:
        return b"".join(parts)
    rest = old.resting
    more = () if rest is None else (rest.ids, rest.means, rest.gain, np.triu(rest.upper))
    return b"".join([*parts, *(each.tobytes() for each in (old.information, *more))])


def straight(bounded=True):
    ticks = fresh(bounded)
    for each in SUBMAPS.every():
        add(ticks, each)
    ticks.take_until(float("inf"))
    return ticks


@pytest.fixture(scope="module")
def expected():
    fold = straight().fold
    assert fold.departed > 0.5 * len(SUBMAPS.every())
    assert len(landmark_view.resting_of(fold.main).ids) > 1
    return bits(fold)


@settings(deadline=None, max_examples=6)
@given(st.randoms(use_true_random=False))
def test_any_order_of_arrival_with_watermarks_between_gives_the_same_bits(expected, random):
    ticks = fresh()
    waiting = {name: list(submaps) for name, submaps in SUBMAPS.items()}
    order = [each.robot for each in SUBMAPS.every()]
    random.shuffle(order)
    for robot in order:
        add(ticks, waiting[robot].pop(0))
        if random.random() < 0.3:
            ticks.take_until(random.choice([8e9, 16e9, 24e9, float("inf")]))
    assert bits(ticks.provisional()) == expected
    ticks.take_until(float("inf"))
    assert bits(ticks.fold) == expected


def test_what_a_late_submap_does_not_change_is_condensed_once(monkeypatch):
    ticks, made = fresh(), []
    *all_but_one, last = SUBMAPS.every()
    for each in all_but_one:
        add(ticks, each)
    ticks.take_until(float("inf"))
    condense = tick_fold.condensed
    monkeypatch.setattr(tick_fold, "condensed", lambda fold: made.append(fold) or condense(fold))
    add(ticks, last)
    ticks.take_until(float("inf"))
    assert not made
    assert bits(ticks.fold) == bits(straight().fold)
    assert sum(each.ahead is not None for each in ticks.checkpoints.taken) <= NEAR


def test_the_full_solution_is_that_of_the_raw_set_and_takes_no_tick_again(monkeypatch):
    bounded, full = straight(), straight(bounded=False)
    assert bounded.fold.departed > full.fold.departed == 0
    assert bounded.digest(bounded.fold) == full.digest(full.fold)
    assert bounded.members(bounded.fold) == full.members(full.fold)
    monkeypatch.delattr(tick_fold, "taken")
    one, other = bounded.solved(), full.solved()
    assert one.departed == 0
    assert one.main.graph.streams.keys() == other.main.graph.streams.keys()
    assert [c.key for c in one.contributions] == [c.key for c in other.contributions]
    maps = [marginals.landmark_map(fold) for fold in (one, other)]
    assert np.allclose(maps[0].means, maps[1].means, atol=1e-6)
    assert np.allclose(maps[0].covariance, maps[1].covariance, rtol=1e-5)


def test_where_a_submap_is_refused_the_full_solution_takes_the_ticks_again():
    *members, last = SUBMAPS.every()
    turned = floats(last.mean, "mean").copy()
    turned[2] = 7.0
    members.append(replace(last, mean=from_floats(turned)))
    bounded, full = fresh(), fresh(bounded=False)
    for each in members:
        add(bounded, each)
        add(full, each)
    one, other = bounded.solved(), full.solved()
    assert bounded.fold.departed > 0
    assert len(one.refused) == 1
    assert bits(one) == bits(other)


def test_a_withdrawal_gives_the_fold_without_the_robot():
    ticks, without = straight(), fresh()
    for each in SUBMAPS["r1"]:
        add(without, each)
    without.take_until(float("inf"))
    ticks.withdraw("r2")
    ticks.take_until(float("inf"))
    assert bits(ticks.fold) == bits(without.fold)


def test_checkpoints_are_few_and_spaced_by_their_age():
    kept: tuple[Checkpoint, ...] = ()
    for number in range(1, 5001):
        kept = thinned((*kept, Checkpoint(number, EMPTY_FOLD, 0, number, raw=number <= 20)))
    numbers = [each.number for each in kept]
    assert len(numbers) < 45
    assert numbers[-4:] == list(range(4997, 5001))
    assert 20 in numbers, "the last raw one stays"
    for age in range(1, 4900):
        before = max(number for number in numbers if number <= 5000 - age)
        assert 5000 - before <= 2.0 * age
