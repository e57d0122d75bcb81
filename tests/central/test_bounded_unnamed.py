import numpy as np
import pytest

from teamslam.central import tick_fold
from teamslam.central.config import CentralConfig
from teamslam.central.tick_fold import TickFold
from teamslam.team import translate
from teamslam.team.association import AssociationProfile
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.map_joining import condensing, marginals, tick
from teamslam.team.estimation.map_joining.condensing import Limits
from teamslam.team.estimation.submap import LocalMap, Unnamed
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import digest_of
from tests.estimation.association.unnamed_worlds import circle, drive, ring, wrong

PROFILE = AssociationProfile(recent=3, near=0.1, closure_pairs=5, audited=3, llr_loose=30.0)
CONFIG = CentralConfig(tick_s=10.0, association=PROFILE)
SMALL = Limits(begin=24, lag=3)


@pytest.fixture(scope="module")
def world():
    """Two laps of a ring; the second closes on the first when most of that is condensed."""
    rng = np.random.default_rng(5)
    path = circle((0.0, 0.0), 20.0, 72, 2.0)
    submaps, truth = drive("r1", path, ring(rng, 32), rng, reach=9.0)
    return [message(each.sequence, each.end_ns, each.local) for each in submaps], truth


def uneven_ring(rng, radius):
    angle = 2.0 * np.pi * (np.arange(16) + 0.6 * rng.uniform(size=16)) / 16
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.fixture(scope="module")
def cluttered():
    rng = np.random.default_rng(6)
    landmarks = uneven_ring(rng, 10.0)
    submaps, truth = drive("r1", circle((0.0, 0.0), 3.0, 80, 5.0), landmarks, rng, reach=20.0)
    return [
        message(each.sequence, each.end_ns, with_clutter(each.local, rng) if k % 2 else each.local)
        for k, each in enumerate(submaps)
    ], truth


def with_clutter(local, rng):
    n = len(local.ids) + 1
    at = rng.uniform(-5.0, 5.0, 2)
    return LocalMap(
        (UNNAMED + np.arange(n)).astype(np.uint32),
        np.concatenate([local.mean, at]),
        np.diag([*np.diag(local.covariance), 1e-3, 1e-3]),
        unnamed=Unnamed(np.full(n, 5, np.uint32), np.ones((n, 1), np.bool_)),
    )


def message(sequence, end_ns, local):
    counters = (10 * sequence + 1, 10 * sequence + 10)
    stamps = (end_ns - 10**10, end_ns)
    return translate.submap_message("r1", 1, sequence, counters, stamps, bytes(8), local)


@pytest.fixture(autouse=True, scope="module")
def _small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(condensing, "MOST", 2)
        yield


@pytest.fixture(scope="module")
def ticks(world, _small):
    messages, _ = world
    return folded(messages), folded(messages, bounded=False)


@pytest.fixture(scope="module")
def all_said(cluttered, _small):
    messages, _ = cluttered
    return folded(messages)


def folded(messages, bounded=True, watermarks=(), late=None):
    """late: number of a message that comes after the others."""
    ticks = TickFold(CONFIG, SMALL if bounded else None)
    for k, each in enumerate(messages):
        if k != late:
            ticks.add_submap(each, digest_of(encoded(each)))
        if k in watermarks:
            ticks.fold_until(each.stamp_ns)
    if late is not None:
        ticks.fold_until(messages[late].stamp_ns - 1)
        ticks.add_submap(messages[late], digest_of(encoded(messages[late])))
    ticks.fold_until(float("inf"))
    return ticks


def bits(fold):
    old = fold.main.graph.condensed
    seen = [str(each.observation[:2]) for each in fold.main.graph.observed]
    parts = [fold.main.state.tobytes(), *map(str.encode, seen), str(fold.landmarks.sets).encode()]
    parts.append(str(fold.landmarks.present).encode())
    return b"".join(parts if old is None else [*parts, old.factor.information.tobytes()])


def test_the_running_fold_is_bounded_and_the_full_solution_is_that_of_the_raw_set(world, ticks):
    messages, truth = world
    bounded, full = ticks
    assert bounded.fold.condensed_count > 0.5 * len(messages)
    assert wrong(bounded.fold.landmarks, truth) == 0
    assert [each.kind for each in bounded.fold.landmarks.decisions] == ["closure"]
    assert len(bounded.fold.main.graph.observed) < 0.8 * len(messages)
    one, other = bounded.solve(), full.solve()
    assert bits(one) == bits(other)
    assert one.condensed_count == other.condensed_count == 0


def test_the_full_solution_of_a_large_set_has_the_running_folds_identities(
    world, ticks, monkeypatch
):
    messages, _ = world
    bounded, raw = ticks[0], ticks[1].solve()
    folds = []
    monkeypatch.setattr(tick_fold, "fold_tick", lambda *_: folds.append(_))
    monkeypatch.setattr(tick_fold, "FULL_UNNAMED", len(messages) - 1)
    solved = bounded.solve()
    assert not folds, "no tick is folded again"
    assert solved.condensed_count == 0
    assert solved.landmarks.sets == raw.landmarks.sets
    one, two = marginals.landmark_map(solved), marginals.landmark_map(raw)
    apart = (one.means - two.means).ravel()
    assert apart @ np.linalg.solve(two.covariance, apart) < 1e-3 * len(apart)


def test_a_closure_of_what_is_condensed_is_solved_with_all_of_it_linearised_again(
    world, monkeypatch
):
    messages, _ = world
    sizes = []

    def noted(fold, *rest):
        after = tick.fold_tick(fold, *rest)
        if after.landmarks.opened:
            sizes.append((fold.condensed_count, after.condensed_count))
        return after

    monkeypatch.setattr(tick_fold, "fold_tick", noted)
    folded(messages[:40])
    (first, _), (again, after) = sizes
    assert first > again == after == 0


def test_late_submaps_give_the_same_bytes(world, ticks):
    messages, _ = world
    wanted = bits(ticks[0].fold)
    assert bits(folded(messages, watermarks=range(0, 72, 9)).fold) == wanted
    assert bits(folded(messages, late=30).fold) == wanted


def test_landmarks_that_nothing_confirms_are_given_up_and_every_order_gives_the_same_bytes(
    cluttered, all_said
):
    messages, truth = cluttered
    halves = [folded(messages[:40]).fold, all_said.fold]
    nodes = [len(each.main.graph.landmarks) for each in halves]
    false = [40 // 2, 80 // 2]
    assert nodes[1] - nodes[0] < 0.3 * (false[1] - false[0])
    fold = halves[1]
    confirmed = {id_: of for id_, of in fold.landmarks.present.items() if of.size > 1}
    assert len({truth[of.first.name] for of in confirmed.values()}) == 16
    assert fold.landmarks.present.keys() == fold.main.graph.landmarks.keys()
    assert len(fold.landmarks.sets) == 16 + false[1]
    assert bits(folded(messages, late=50).fold) == bits(fold)


def test_what_was_given_up_is_there_when_all_is_linearised_again(all_said):
    again = all_said.inputs.restore_submaps(all_said.fold, float("inf"), ())
    assert again.condensed_count == 0
    assert again.landmarks.present.keys() == again.main.graph.landmarks.keys()
    assert again.main.graph.landmarks.keys() == all_said.fold.landmarks.sets.keys()
    cost = again.main.cost / sum(again.main.graph.dimensions)
    assert cost < 1.1, "each lies where its only submap has it"


@pytest.mark.parametrize("bounded", [True, False])
def test_the_first_unnamed_landmarks_meet_all_named_ones(bounded):
    rng = np.random.default_rng(7)
    landmarks = uneven_ring(rng, 20.0)
    path = circle((0.0, 0.0), 17.0, 72, 2.0)
    named, _ = drive("r1", path[:37], landmarks, rng, reach=9.0, named=True)
    unnamed, _ = drive("r1", path[36:], landmarks, rng, reach=9.0)
    count = len(named)
    later = [(count + each.sequence, each.end_ns + count * 10**10, each.local) for each in unnamed]
    first = [message(each.sequence, each.end_ns, each.local) for each in named]
    both = [*first, *(message(*each) for each in later)]
    assert folded(first, bounded).fold.condensed_count == bounded * (count - 1 - SMALL.lag)
    fold = folded(both, bounded).fold
    assert {id_ for id_ in fold.main.graph.landmarks if id_ >= UNNAMED} == set()
