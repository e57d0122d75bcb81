import itertools

from teamslam.team.wire.intervals import LONGEST_S, PATIENCE_S, RequestTimes


def asked(gap_of, seconds=40.0):
    requests = RequestTimes()
    times = [0.1 * tick for tick in range(round(10 * seconds))]
    return [now for now in times if requests.due({"r1": gap_of(now)}, now)]


def test_a_gap_that_stands_is_asked_for_with_longer_and_longer_pauses():
    times = asked(lambda now: 3)
    assert asked(lambda now: now // 0.4) == [], "a gap that changes has new patience"
    assert PATIENCE_S <= times[0] < PATIENCE_S + 0.11
    pauses = [after - before for before, after in itertools.pairwise(times)]
    assert pauses == sorted(pauses)
    assert LONGEST_S <= pauses[-1] < LONGEST_S + 0.11


def test_a_gap_that_was_closed_and_opens_again_has_new_patience():
    requests = RequestTimes()
    assert requests.due({"r1": 3}, 0.0) == requests.due({}, 1.0) == requests.due({"r1": 3}, 2.0)
    assert requests.due({"r1": 3}, 2.0 + PATIENCE_S) == ["r1"]
