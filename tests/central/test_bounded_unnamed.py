"""The running fold of landmarks without names: bounded, and a pure function of the set."""

from functools import partial

import numpy as np
import pytest

from central import tick_fold
from central.config import CentralConfig
from central.tick_fold import TickFold
from team import translate
from team.association import AssociationProfile
from team.estimation.map_joining import auditing, condensing
from team.estimation.map_joining.condensing import condensed
from team.estimation.map_joining.relinearising import is_due
from team.wire.codec import encoded
from team.wire.digest import digest_of
from tests.estimation.map_joining.association.unnamed_worlds import circle, drive, wrong

PROFILE = AssociationProfile(recent=3, near=0.1, closure_pairs=5, audited=3)
CONFIG = CentralConfig(tick_s=10.0, association=PROFILE)


@pytest.fixture(scope="module")
def world():
    """Laps of a ring; a closure says that the second one is the first again, when most of the first
    is condensed."""
    rng = np.random.default_rng(5)
    angle = 2.0 * np.pi * (np.arange(32) + 0.6 * rng.uniform(size=32)) / 32
    r = rng.uniform(17.0, 23.0, 32)
    landmarks = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    submaps, truth = drive("r1", circle((0.0, 0.0), 20.0, 72, 2.0), landmarks, rng, reach=9.0)
    messages = [
        translate.submap_message(
            "r1",
            1,
            each.sequence,
            (10 * each.sequence + 1, 10 * each.sequence + 10),
            (each.end_ns - 10**10, each.end_ns),
            bytes(8),
            each.local,
        )
        for each in submaps
    ]
    return messages, truth


@pytest.fixture(autouse=True, scope="module")
def _small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tick_fold, "condensed", partial(condensed, lag=3, begin=8))
        patch.setattr(tick_fold, "is_due", partial(is_due, begin=24))
        patch.setattr(condensing, "MOST", 2)
        yield


def folded(messages, bounded=True, watermarks=()):
    ticks = TickFold(CONFIG, bounded)
    for k, each in enumerate(messages):
        ticks.add(each, digest_of(encoded(each)))
        if k in watermarks:
            ticks.take_until(each.stamp_ns)
    ticks.take_until(float("inf"))
    return ticks


def bits(fold):
    old = fold.main.graph.condensed
    seen = [str(each.contribution.key) for each in fold.main.graph.observed]
    parts = [fold.main.state.tobytes(), *map(str.encode, seen), str(fold.landmarks.sets).encode()]
    return b"".join(parts if old is None else [*parts, old.information.tobytes()])


def test_the_running_fold_is_bounded_and_the_full_solution_is_that_of_the_raw_set(world):
    messages, truth = world
    bounded, full = folded(messages), folded(messages, bounded=False)
    assert bounded.fold.departed > 0.5 * len(messages)
    assert wrong(bounded.fold.landmarks, truth) == 0
    assert [each.kind for each in bounded.fold.landmarks.decisions] == ["closure"]
    assert len(bounded.fold.main.graph.observed) < 0.8 * len(messages)
    one, other = bounded.solved(), full.solved()
    assert bits(one) == bits(other)
    assert one.departed == other.departed == 0


def test_a_closure_of_what_is_condensed_is_solved_with_all_of_it_linearised_again(
    world, monkeypatch
):
    messages, _ = world
    sizes = []

    def noted(fold, *rest):
        after = auditing.taken(fold, *rest)
        if after.landmarks.opened:
            sizes.append((fold.departed, after.departed))
        return after

    monkeypatch.setattr(tick_fold, "taken", noted)
    folded(messages[:40])
    (first, _), (again, after) = sizes
    assert first > again == after == 0


def test_late_submaps_give_the_same_bytes(world):
    messages, _ = world
    wanted = bits(folded(messages).fold)
    assert bits(folded(messages, watermarks=range(0, 72, 9)).fold) == wanted
    ticks = TickFold(CONFIG)
    held = messages[30]
    for each in [*messages[:30], *messages[31:]]:
        ticks.add(each, digest_of(encoded(each)))
    ticks.take_until(held.stamp_ns - 1)
    ticks.add(held, digest_of(encoded(held)))
    ticks.take_until(float("inf"))
    assert bits(ticks.fold) == wanted
