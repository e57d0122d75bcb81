"""When samples are due, as a function of their stamps."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teamslam.team.recording.replayer import schedule
from teamslam.team.wire.bus import Sample


def at(*stamps: int) -> list[Sample]:
    return [Sample("k", b"", stamp, 0, i) for i, stamp in enumerate(stamps)]


def test_spacing_is_team_time_over_speed() -> None:
    delays = [delay for delay, _ in schedule(at(5 * 10**9, 6 * 10**9, 8 * 10**9), speed=2.0)]
    assert delays == [0.0, 0.5, 1.0]


def test_a_sample_older_than_what_went_before_goes_at_once_and_costs_nothing() -> None:
    delays = [delay for delay, _ in schedule(at(0, 2 * 10**9, 10**9, 3 * 10**9), speed=1.0)]
    assert delays == [0.0, 2.0, 0.0, 1.0]


def test_an_infinite_speed_never_waits() -> None:
    assert {delay for delay, _ in schedule(at(0, 10**12, 10**15), math.inf)} == {0.0}


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match=r"speed .* is not positive"):
        list(schedule(at(0), speed))


@settings(deadline=None)
@given(st.lists(st.integers(-(2**62), 2**62)), st.floats(1e-3, 1e6))
def test_order_is_kept_and_delays_add_up_to_the_time_that_passed(
    stamps: list[int], speed: float
) -> None:
    planned = list(schedule(at(*stamps), speed))
    assert [sample for _, sample in planned] == at(*stamps)
    assert all(delay >= 0.0 for delay, _ in planned)
    passed = 1e-9 * (max(stamps) - stamps[0]) / speed if stamps else 0.0
    assert math.isclose(sum(delay for delay, _ in planned), passed, rel_tol=1e-9)
