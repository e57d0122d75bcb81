"""What has arrived of a publisher: each once, in order, and what is missing is known."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from team.wire.zenoh.arrivals import DELAY_S, PATIENCE_S, Arrivals


@given(st.permutations(range(8)), st.lists(st.integers(0, 7), max_size=8))
def test_whatever_the_order_each_is_delivered_once_and_in_order(
    order: list[int], again: list[int]
) -> None:
    arrivals: Arrivals[int] = Arrivals(0)
    delivered = [n for number in [*order, *again] for n in arrivals.take(number, number)]
    assert delivered == list(range(8))
    assert arrivals.missing is None


@given(st.sets(st.integers(0, 7)), st.integers(0, 7))
def test_what_has_not_come_is_missing(come: set[int], newest: int) -> None:
    arrivals: Arrivals[int] = Arrivals(0)
    for number in sorted(come):
        arrivals.take(number, number)
    arrivals.know(newest)
    lost = {n for begin, end in arrivals.lacking for n in range(begin, end + 1)}
    assert lost == set(range(max([newest, *come]) + 1)) - come
    assert arrivals.missing == ((min(lost), max(lost)) if lost else None)


def test_a_gap_is_asked_for_after_a_while_and_again_later_and_later() -> None:
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(3, 3)
    asked = []
    for tick in range(100):
        arrivals.take(4 + tick, 0)  # what goes on behind the gap is no reason to wait
        wanted = arrivals.due(tick * 0.1)
        if wanted is not None:
            asked.append((tick, wanted))
    assert [wanted for _, wanted in asked] == [(0, 2), (0, None), (0, None), (0, None)]
    assert asked[0][0] * 0.1 >= PATIENCE_S
    waits = [b - a for (a, _), (b, _) in itertools.pairwise(asked)]
    assert waits == sorted(waits)


def test_the_tail_that_only_a_heartbeat_speaks_of_is_asked_for() -> None:
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(0, 0)
    arrivals.know(2)
    assert arrivals.due(0.0) is None
    assert arrivals.due(PATIENCE_S) == (1, 2)


def test_what_waits_behind_a_gap_goes_on_after_a_while() -> None:
    arrivals: Arrivals[int] = Arrivals(0)
    assert arrivals.take(1, 1) == arrivals.take(2, 2) == []
    arrivals.due(0.0)
    assert arrivals.overdue(DELAY_S - 0.1) == []
    assert arrivals.overdue(DELAY_S) == [1, 2]
    assert arrivals.take(3, 3) == [3]
    assert arrivals.take(0, 0) == [0]


def test_what_the_publisher_has_no_more_is_gone_and_named() -> None:
    arrivals: Arrivals[int] = Arrivals(0)
    arrivals.take(1, 1)
    arrivals.take(4, 4)
    assert arrivals.answered(0, 3) == [1, 4]
    assert arrivals.missing is None
    assert arrivals.lacking == [(0, 0), (2, 3)]


def test_of_the_newest_alone_nothing_older_is_asked_for_or_waited_for() -> None:
    arrivals: Arrivals[int] = Arrivals(5, in_order=False)
    assert arrivals.take(6, 6) == [6]
    assert arrivals.take(4, 4) == [4]
    arrivals.due(0.0)
    assert arrivals.due(1.0) == (5, 5)
