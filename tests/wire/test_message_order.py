import msgspec
from hypothesis import given, strategies as st

from teamslam.team.wire import messages as m
from teamslam.team.wire.message_order import (
    is_newer_map,
    is_newer_prior,
    merge_ends,
    merge_progress,
)
from tests import build
from tests.support import example

PRIOR = example(m.Prior)
MAP = example(m.FusedMap)
vectors = st.dictionaries(st.sampled_from(["r1", "r2", "r3"]), st.integers(0, 3))


def members(vector: dict[str, int]) -> tuple[m.VersionEntry, ...]:
    return build.version(**dict(sorted(vector.items())))


def prior(vector: dict[str, int], heard: int = 0, incarnation: int = 1) -> m.Prior:
    return msgspec.structs.replace(
        PRIOR, incarnation=incarnation, members=members(vector), heard=heard
    )


@given(vectors, vectors, st.integers(0, 9))
def test_a_set_that_holds_another_one_is_newer(one, more, heard):
    both = {r: max(one.get(r, -1), more.get(r, -1)) for r in one | more}
    larger, smaller = prior(both, heard), prior(one, heard)
    assert is_newer_prior(larger, smaller) == (both != one)
    assert not is_newer_prior(smaller, larger)
    without = {r: n for r, n in both.items() if r != "r1"}
    assert is_newer_prior(prior(without, heard + 1), larger)


@given(st.permutations([({"r1": 3}, 4), ({"r1": 2, "r2": 0}, 4), ({"r2": 3}, 5), ({"r2": 1}, 6)]))
def test_whoever_hears_the_same_priors_in_any_order_holds_the_same_one(said):
    held = None
    for each in said:
        told = prior(*each)
        held = told if is_newer_prior(told, held) else held
    assert held == prior({"r2": 1}, 6)


def test_a_later_life_of_the_stream_and_a_settled_map_of_the_same_set_are_newer():
    assert is_newer_prior(prior({}, incarnation=2), prior({"r1": 3}, 9))
    settled = msgspec.structs.replace(MAP, final=False)
    tail = msgspec.structs.replace(settled, provisional=True)
    assert is_newer_map(settled, tail)
    assert not is_newer_map(tail, settled)
    assert is_newer_map(MAP, settled)
    assert not is_newer_map(settled, settled)
    less = msgspec.structs.replace(MAP, members=())
    assert not is_newer_map(less, MAP)


def progress(stamp_ns: int, incarnation: int, measurements: int, submaps: int) -> m.Progress:
    return build.progress(
        stamp_ns=stamp_ns, incarnation=incarnation, measurements=measurements, submaps=submaps
    )


counters = st.builds(progress, st.integers(0, 3), st.integers(1, 2), st.integers(0, 3),
                     st.integers(0, 3))  # fmt: skip


@given(st.lists(counters, min_size=1))
def test_progress_never_goes_back(said):
    held = None
    for each in said:
        before, held = held, merge_progress(each, held)
        assert before is None or held.incarnation >= before.incarnation
        if before is not None and held.incarnation == before.incarnation:
            assert held.measurements >= before.measurements
            assert held.submaps >= before.submaps
            assert held.stamp_ns >= before.stamp_ns
    assert held.submaps == max(p.submaps for p in said if p.incarnation == held.incarnation)


def test_an_older_end_does_not_take_measurements_back():
    first = build.end(1, r1=90, r2=40)
    anew, further = build.end(2, 2, r1=10), build.end(2, r2=50)
    later = msgspec.structs.replace(anew, streams=anew.streams + further.streams)
    assert merge_ends(first, later).streams == later.streams
    assert merge_ends(later, first).streams == later.streams
