"""Intervals of integers against a set of them, and with numbers that no set could have."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from teamslam.team.wire.intervals import IntervalSet

numbers = st.integers(-5, 40)
pairs = st.lists(st.tuples(numbers, numbers), max_size=20)


def both(of: list[tuple[int, int]]) -> tuple[IntervalSet, set[int]]:
    intervals, model = IntervalSet(), set[int]()
    for first, last in of:
        intervals.add(first, last)
        model |= set(range(first, last + 1))
    return intervals, model


def expanded(intervals: list[tuple[int, int]]) -> list[int]:
    return [n for first, last in intervals for n in range(first, last + 1)]


@given(pairs)
def test_intervals_are_the_set_in_ascending_disjoint_pieces_that_do_not_touch(
    of: list[tuple[int, int]],
) -> None:
    intervals, model = both(of)
    assert expanded(list(intervals)) == sorted(model)
    assert len(intervals) == len(list(intervals)) == sum(n - 1 not in model for n in model)


@given(pairs, numbers)
def test_membership_and_the_nearest_absent_numbers_are_those_of_the_set(
    of: list[tuple[int, int]], number: int
) -> None:
    intervals, model = both(of)
    assert (number in intervals) == (number in model)
    assert intervals.next_absent(number) == next(n for n in range(number, 99) if n not in model)
    assert intervals.last_absent(number) == next(
        n for n in range(number, -99, -1) if n not in model
    )


@given(pairs, numbers, numbers)
def test_gaps_are_the_complement_within_their_bounds(
    of: list[tuple[int, int]], first: int, last: int
) -> None:
    intervals, model = both(of)
    gaps = intervals.gaps(first, last)
    assert expanded(gaps) == [n for n in range(first, last + 1) if n not in model]
    assert all(a[1] + 1 < b[0] for a, b in pairwise(gaps))


def test_four_billion_numbers_are_one_interval() -> None:
    intervals = IntervalSet()
    intervals.add(0, 2**32 - 1)
    intervals.add(2**40, 2**63)
    assert list(intervals) == [(0, 2**32 - 1), (2**40, 2**63)]
    assert intervals.gaps(0, 2**41) == [(2**32, 2**40 - 1)]


@given(pairs, st.integers(1, 9))
def test_joined_first_intervals_are_a_superset_that_keeps_the_last_ones(
    of: list[tuple[int, int]], count: int
) -> None:
    intervals, model = both(of)
    before = list(intervals)
    intervals.join_first(count)
    assert len(intervals) == min(len(before), count)
    assert model <= set(expanded(list(intervals)))
    assert list(intervals)[1:] == before[len(before) - len(intervals) + 1 :]
    assert intervals.last == max(model, default=-1)
