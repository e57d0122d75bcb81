import msgspec
import numpy as np
from hypothesis import given, settings, strategies as st

from teamslam.central.desk.verification.recorded import Recorded, RecordedMeasurements
from teamslam.central.desk.verification.robot import _first_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import encoded
from tests import build, support

numbers = st.integers(0, 12)


def name_of(number):
    return {"stamp_ns": 10 * number, "incarnation": 0, "number": number}


plain = st.builds(
    lambda number, forward: build.odometry(**name_of(number), duration_ns=10, forward=forward),
    numbers,
    st.sampled_from([1.0, 1.0, 1.0, 2.0]),
)
steering = st.builds(
    lambda number: m.Steering(
        **name_of(number), robot="r1", duration_ns=10, wheel_speed=1.0, steering=0.0
    ),
    numbers,
)
scan = st.builds(lambda number: build.observations(**name_of(number)), numbers)
logs = st.lists(st.one_of(plain, plain, steering, scan), max_size=30)


def sample_of(message):
    key = ch.OBSERVATIONS if isinstance(message, m.Observations) else ch.ODOMETRY
    return Sample(key.key("r1"), encoded(message), message.stamp_ns, 0, 0)


@settings(deadline=None, max_examples=300)
@given(logs, st.integers(1, 30), numbers, numbers)
def test_it_is_the_table_of_the_first_message_of_each_number(log, chunk, begin, end):
    found = Recorded()
    for at in range(0, len(log), chunk):
        found.take_all([sample_of(each) for each in log[at : at + chunk]])
    table, contradicted = {}, set()
    for each in log:
        if table.setdefault(each.number, each) != each:
            contradicted.add(each.number)
    there = found.measurements.get(("r1", 0), RecordedMeasurements())
    assert dict(there) == table
    assert {each.number for each in found.contradicted} == contradicted
    assert all((number in there) == (number in table) for number in range(-1, 14))
    end = max(begin, end)
    if table:
        stamps = [each.stamp_ns for each in table.values()]
        assert there.span_ns == (min(stamps), max(stamps))
    consecutive = [*there.consecutive(begin, end)]
    last = next((n for n in range(begin, end) if n not in table), end)
    assert consecutive == [table[n] for n in range(begin, last)]


def test_a_far_number_costs_no_time_where_the_first_measurement_of_a_process_is_found():
    far = 2**40
    there = RecordedMeasurements()
    for number in (1, 9, 10, 11, far):
        there.put(build.odometry(**name_of(number), duration_ns=10))
    assert there.odometry() == [1, 9, 10, 11, far]
    done = build.done(stamp_ns=9, measurements=far + 1, steps=3, submaps=1, ledger=())
    chain = [support.submap(0)]  # of the measurements 0 to 9
    assert _first_of(done, chain, there) == 10
    assert _first_of(msgspec.structs.replace(done, steps=5), chain, there) == 0


def test_unsound_odometry_is_counted_and_another_robots_is_not_taken():
    sound = build.odometry(stamp_ns=1, incarnation=0, number=1, duration_ns=1, yaw_rate=0.0)
    other = msgspec.structs.replace(sound, robot="r2")
    found = Recorded()
    unsound = Sample("source/r1/odometry", b"x", 0, 0, 0)
    found.take_all([sample_of(sound), sample_of(other), unsound])
    assert found.unsound == 2
    assert [*found.measurements] == [("r1", 0)]
    assert np.array_equal([*found.measurements["r1", 0]], [1])


def test_samples_of_a_view_are_ignored_and_those_of_no_channel_are_unsound():
    found = Recorded()
    found.take_all([Sample(key, b"x", 0, 0, 0) for key in ("view/errors", "nothing/r1/at_all")])
    assert found.unsound == 1
    assert not found.outputs
