import msgspec
from hypothesis import given, settings, strategies as st

from teamslam.team.door import LATE_NS
from teamslam.team.robot.stream import Inbox
from teamslam.team.wire import messages as m
from tests import build


def measurement(number, incarnation=0):
    return build.odometry(
        stamp_ns=number * 1_000,
        incarnation=incarnation,
        number=number,
        duration_ns=1_000,
        yaw_rate=0.0,
    )


def waiting(inbox):
    return len(inbox.ahead) + sum(map(len, inbox.later.values()))


def names(inbox):
    taken = iter(inbox.take_next, None)
    return [(each.incarnation, each.number) for each in taken]


def received(inbox, arrived):
    """As `RobotNode.handle`: a measurement in its turn is taken at once."""
    if inbox.take(arrived):
        return [(arrived.incarnation, arrived.number), *names(inbox)]
    inbox.put(arrived)
    return names(inbox)


@settings(deadline=None)
@given(st.permutations(list(range(12)) * 2), st.integers(1, 5))
def test_any_order_with_duplicates_comes_out_in_order_and_once(order, at_once):
    inbox, out = Inbox(), []
    for i, number in enumerate(order):
        if i % at_once == 0:
            out += received(inbox, measurement(number))
        else:
            inbox.put(measurement(number))
    out += names(inbox)
    assert out == [(0, number) for number in range(12)]
    assert waiting(inbox) == 0


@settings(deadline=None)
@given(st.permutations([(e, n) for e in (2, 3) for n in range(4)]))
def test_of_two_incarnations_the_earlier_is_taken_as_far_as_it_is_there(order):
    inbox, out = Inbox(), []
    for incarnation, number in order:
        out += received(inbox, measurement(number, incarnation))
    assert out == sorted(out)
    assert [name for name in out if name[0] == 3] == [(3, number) for number in range(4)]
    assert waiting(inbox) == 0, "nothing of a past incarnation is kept"


def test_stamps_are_bounded_by_the_initial_pose_of_the_first_incarnation_too():
    inbox = Inbox()
    assert received(inbox, build.initial_pose(incarnation=0)) == [(0, 0)]
    late = msgspec.structs.replace(measurement(1), stamp_ns=2 * LATE_NS)
    assert inbox.refusal(measurement(1)) is None
    assert inbox.refusal(late) == "stamped 800 days after its stream began"


def test_a_later_incarnation_whose_beginning_is_missing_is_a_gap():
    inbox = Inbox()
    inbox.put(measurement(3, incarnation=1))
    assert names(inbox) == []
    assert inbox.gap == (1, 0, 2)


def test_what_an_earlier_life_consumed_is_not_taken_again():
    inbox = Inbox()
    for number in range(6):
        inbox.put(measurement(number, incarnation=2))
    inbox.put(measurement(0))
    inbox.resume(2, 4)
    inbox.put(measurement(3, incarnation=2))
    assert names(inbox) == [(2, 4), (2, 5)]


def test_the_tail_is_asked_for_whatever_a_stranger_has_published_behind_it():
    inbox = Inbox()
    for each in (*map(measurement, range(3)), measurement(4, incarnation=7)):
        inbox.put(each)
    end = m.StreamEnd(robot="r1", incarnation=0, measurements=9)
    assert inbox.missing(end) == (0, 3, 8), "what waits for its turn is here"
    assert names(inbox) == [(0, 0), (0, 1), (0, 2)]
    assert inbox.missing(end) == (0, 3, 8)
    inbox.put(measurement(40))
    assert inbox.missing(end) == (0, 3, 39)
    assert inbox.missing(m.StreamEnd(robot="r1", incarnation=9, measurements=5)) == (0, 3, 39)
