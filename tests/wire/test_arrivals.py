import itertools

from hypothesis import given, strategies as st

from teamslam.team.wire.intervals import PATIENCE_S, IntervalSet
from teamslam.team.wire.zenoh import recovery as module
from teamslam.team.wire.zenoh.recovery import DELAY_S, Arrivals


@given(st.permutations(range(8)), st.lists(st.integers(0, 7), max_size=8))
def test_whatever_the_order_each_is_delivered_once_and_in_order(order, again):
    arrivals: Arrivals[int] = Arrivals(0)
    delivered = [n for number in [*order, *again] for n in arrivals.take(number, number)]
    assert delivered == list(range(8))
    assert arrivals.missing is None


@given(st.sets(st.integers(0, 7)), st.integers(0, 7))
def test_what_has_not_come_is_missing(come, newest):
    arrivals: Arrivals[int] = Arrivals(0)
    for number in sorted(come):
        arrivals.take(number, number)
    arrivals.know(newest)
    lost = {n for begin, end in arrivals.missing_intervals for n in range(begin, end + 1)}
    assert lost == set(range(max([newest, *come]) + 1)) - come
    assert arrivals.missing == ((min(lost), max(lost)) if lost else None)


def test_a_gap_is_asked_for_after_a_while_and_again_later_and_later():
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(3, 3)
    asked = []
    for tick in range(100):
        arrivals.take(4 + tick, 0)  # later messages do not delay the request
        wanted = arrivals.due(tick * 0.1)
        if wanted is not None:
            asked.append((tick, wanted))
    assert [wanted for _, wanted in asked] == [(0, 2), (0, None), (0, None), (0, None)]
    assert asked[0][0] * 0.1 >= PATIENCE_S
    waits = [b - a for (a, _), (b, _) in itertools.pairwise(asked)]
    assert waits == sorted(waits)


def test_what_waits_behind_a_gap_goes_on_after_a_while():
    arrivals: Arrivals[int] = Arrivals(0)
    assert arrivals.take(1, 1) == arrivals.take(2, 2) == []
    arrivals.due(0.0)
    assert arrivals.overdue(DELAY_S - 0.1) == []
    assert arrivals.overdue(DELAY_S) == [1, 2]
    assert arrivals.take(3, 3) == [3]
    assert arrivals.take(0, 0) == [0]


def test_what_the_publisher_has_no_more_is_gone_and_named():
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(1, 1)
    arrivals.take(4, 4)
    assert arrivals.take_answer(0, 3) == [1, 4]
    assert arrivals.missing is None
    assert arrivals.missing_intervals == [(0, 0), (2, 3)]


def test_numbers_of_32_bits_cost_no_memory_and_no_time():
    """A heartbeat and a reply name such numbers; sets of them would need 240 GB."""
    newest = 2**32 - 2
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.know(newest)
    arrivals.take(7, 7)
    assert arrivals.take_answer(0, newest) == [7]
    assert arrivals.missing_intervals == [(0, 6), (8, newest)]
    assert arrivals.take(newest + 1, 8) == [8]
    assert arrivals.missing is None


def test_a_publisher_that_leaves_gaps_without_end_is_not_tracked_without_end(monkeypatch):
    monkeypatch.setattr(module, "MOST_GAPS", 10)
    arrivals: Arrivals[int] = Arrivals(0)
    delivered = []
    for number in range(1, 2_001, 2):
        delivered += arrivals.take(number, number)
        assert len(arrivals.missing_intervals) <= 22
    assert delivered == list(range(1, 1_981, 2)), "the oldest gap is given up for each new one"
    lost = {n for begin, end in arrivals.missing_intervals for n in range(begin, end + 1)}
    assert set(range(0, 2_000, 2)) <= lost


def test_a_number_that_the_publisher_never_had_is_unlearnt():
    """A heartbeat of another key may arrive under this one: the cache's reply corrects it."""
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(0, 0)
    arrivals.know(500)
    assert arrivals.due(0.0) is None
    assert arrivals.due(PATIENCE_S) == (1, 500)
    assert arrivals.take_answer(1, 0, known=500) == []
    assert (arrivals.missing, arrivals.missing_intervals) == (None, [])
    assert arrivals.take(1, 1) == [1]


def test_a_heartbeat_that_comes_during_the_reply_is_not_unlearnt():
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(0, 0)
    arrivals.know(1)
    known = arrivals.newest
    arrivals.know(2)
    arrivals.take_answer(1, 1, known=known)
    assert arrivals.missing_intervals == [(1, 1), (2, 2)]


def test_of_the_newest_alone_nothing_older_is_asked_for_or_waited_for():
    arrivals: Arrivals[int] = Arrivals(5, in_order=False)
    assert arrivals.take(6, 6) == [6]
    assert arrivals.take(4, 4) == [4]
    arrivals.due(0.0)
    assert arrivals.due(1.0) == (5, 5)


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
def test_intervals_are_the_set_in_ascending_disjoint_pieces_that_do_not_touch(of):
    intervals, model = both(of)
    assert expanded(list(intervals)) == sorted(model)
    assert len(intervals) == len(list(intervals)) == sum(n - 1 not in model for n in model)


@given(pairs, st.integers(1, 9))
def test_joined_first_intervals_are_a_superset_that_keeps_the_last_ones(of, count):
    intervals, model = both(of)
    before = list(intervals)
    intervals.join_first(count)
    assert len(intervals) == min(len(before), count)
    assert model <= set(expanded(list(intervals)))
    assert list(intervals)[1:] == before[len(before) - len(intervals) + 1 :]
    assert intervals.last == max(model, default=-1)
