"""Odometry that is decoded and taken in blocks is what it is message by message."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from team.config import Bounds, FrontEnd, MotionModel, MotionNoise, Sensor
from team.containment import Boundary
from team.robot.driven import driven
from team.robot.ledger import no_listener
from team.robot.node import RobotNode
from team.stream.odometry_block import OdometryBlock, OdometryTable, decoded_odometry
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import from_floats
from team.wire.bus import Sample, opened
from team.wire.codec import WireError, encoded
from tests.teams import config, published, stream

KEY = ch.ODOMETRY.key("r1")
reals = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False, min_value=-1e300, max_value=1e300),
    st.sampled_from([0.0, -0.0, 1e300, -1e300, 5e-324]),
)
counts = st.one_of(
    st.sampled_from([0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**63 - 1]),
    st.integers(0, 2**63 - 1),
)
stamps = st.one_of(
    st.integers(-(2**62), 2**62 - 1), st.sampled_from([-1, -32, -33, -128, -129, -(2**31) - 1])
)
odometry = st.builds(
    m.Odometry,
    robot=st.just("r1"),
    incarnation=counts,
    number=counts,
    stamp_ns=stamps,
    duration_ns=st.integers(0, 2**62 - 1),
    forward=reals,
    yaw_rate=reals,
)


def one(payload, robot="r1"):
    """The message that a payload is decoded to; None where it is not plain."""
    table = decoded_odometry(robot, [payload])
    assert len(table.is_plain) == 1
    if not table.is_plain[0]:
        return None
    block = table.block(robot, int(table.incarnations[0]), 0, 1)
    return block.message(0)


@settings(deadline=None, max_examples=200)
@given(odometry)
def test_every_sound_interval_is_plain_and_comes_back_to_the_bit(message):
    assert encoded(one(encoded(message))) == encoded(message)
    assert one(encoded(message), "r2") is None  # on another robot's key


@settings(deadline=None, max_examples=400)
@given(odometry, st.integers(0, 99), st.integers(1, 255), st.integers(-1, 40))
def test_what_is_plain_in_damaged_bytes_is_what_the_codec_finds_there(message, at, flip, cut):
    payload = bytearray(encoded(message))
    payload[at % len(payload)] ^= flip
    payload = bytes(payload[: len(payload) - max(cut, 0)]) + b"\0" * (cut == -1)
    found = one(payload)
    if found is not None:
        assert encoded(opened(Sample(KEY, payload, 0, 0, 0))[2]) == encoded(found)


@pytest.mark.parametrize(
    "fields",
    [
        ["odometry/1", 2**62, "r1", 0, 1, 1, 0.0, 0.0],
        ["odometry/1", 2**63, "r1", 0, 1, 1, 0.0, 0.0],
        ["odometry/1", 0, "r1", -1, 1, 1, 0.0, 0.0],
        ["odometry/1", 0, "r1", 0, 1, 2**62, 0.0, 0.0],
        ["odometry/1", 0, "r1", 0, 1, 1, float("nan"), 0.0],
        ["odometry/1", 0, "r1", 0, 1, 1, 0.0, 1.1e300],
        ["odometry/1", 0, "r", 0, 1, 1, 0.0, 0.0],
        ["odometry/1", 0, "r1", 0, 1, 1, 0.0],
        ["odometry/2", 0, "r1", 0, 1, 1, 0.0, 0.0],
        ["increment/1", 0, "r1", 0, 1, 1, b"", b""],
    ],
)
def test_what_the_codec_refuses_and_other_messages_are_not_plain(fields):
    payload = msgspec.msgpack.encode(fields)
    assert one(payload) is None
    with pytest.raises(WireError):
        opened(Sample(KEY, payload, 0, 0, 0))


def test_rows_are_in_the_order_of_the_payloads_and_the_unsound_ones_are_empty():
    messages = [each for each in published(stream("r1", 5)) if isinstance(each, m.Odometry)]
    payloads = [encoded(each) for each in messages]
    table = decoded_odometry("r1", [payloads[0], b"", b"nonsense", *payloads[1:]])
    assert table.is_plain.tolist() == [True, False, False, True, True, True, True]
    assert table.numbers[table.is_plain].tolist() == [each.number for each in messages]
    assert len(decoded_odometry("r1", []).is_plain) == 0
    assert len(OdometryTable.empty().only(np.empty(0, np.bool_)).numbers) == 0


# A node.

DENSE = published(stream("r1", 900, step_ns=20_000_000, seen_every=17, off_ns=7_000_000))
END = m.End(
    stamp_ns=18_000_000_000,
    streams=(m.StreamEnd(robot="r1", incarnation=1, measurements=len(DENSE)),),
)


def in_blocks(measurements, most):
    """The measurements, odometry in blocks of at most so many."""
    found, open_ = [], []
    for each in [*measurements, None]:
        last = open_[-1] if open_ else None
        follows = last and isinstance(each, m.Odometry) and each.number == last.number + 1
        follows = follows and each.incarnation == last.incarnation
        if open_ and (not follows or len(open_) == most):
            payloads = [encoded(message) for message in open_]
            table = decoded_odometry("r1", payloads)
            found.append(table.block("r1", open_[0].incarnation, 0, len(open_)))
            open_ = []
        if isinstance(each, m.Odometry):
            open_.append(each)
        elif each is not None:
            found.append(each)
    return found


def answers(made, inputs, listener=no_listener):
    """All that a node says, as bytes, and how many messages it took one by one."""
    node, boundary = RobotNode(made, on_disposition=listener), Boundary("robot/r1")
    singly = []

    def give(message):
        singly.append(message)
        return boundary.give(node, message)

    out = []
    for each in inputs:
        if isinstance(each, OdometryBlock):
            out += driven(node, each, give)
        else:
            out += boundary.give(node, each)
    said = [(o.key, encoded(o.message)) for o in out]
    return [*said, encoded(node.status()), boundary.refused, boundary.faults], len(singly)


def changed(**fields):
    """The dense stream with other odometry here and there: each row by its number."""
    rows = {int(k.removeprefix("n")): v for k, v in fields.items()}
    return [msgspec.structs.replace(each, **rows.get(each.number, {})) for each in DENSE]


NODES = FrontEnd(
    particles=4, window_s=3.0, keyframe_s=0.1, node_s=0.7, sighting_s=0.3, biases=("forward_scale",)
)
SIGHTED = [
    m.Sightings(
        stamp_ns=each.stamp_ns, robot="r1", incarnation=1, number=each.number,
        teammates=("r2",), ranges=from_floats([3.0]), bearings=from_floats([0.3]),
    )
    if isinstance(each, m.Observations)
    else each
    for each in DENSE
]  # fmt: skip
"""The dense stream with inter-robot measurements in place of its scans."""
SLOW = MotionModel(
    "velocity",
    forward=MotionNoise(per_m=0.02),
    turn=MotionNoise(per_rad=0.1),
    calibrated_speed=(0.0, 1.0),
    alphas=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
    shares=(0.1, 0.2, 0.3),
    turn_drag=0.1,
    yaw_rate_limit=0.01,
)
WHEELS = MotionModel("differential-drive", wheel_base=0.3, left_wheel=0.02, right_wheel=0.01)
FEW = FrontEnd(particles=4, window_s=3.0)


@pytest.mark.parametrize(
    ("options", "measurements", "share"),
    [
        ({}, DENSE, 0.1),
        ({"front_end": NODES, "fusion": "join", "motion": SLOW}, DENSE, 0.3),
        ({"front_end": NODES, "fusion": "join", "motion": SLOW}, SIGHTED, 0.05),
        ({"motion": WHEELS, "clock_offset_s": -0.013}, DENSE, 0.1),
        (
            {"front_end": FrontEnd(particles=4, window_s=1.0, window_m=1e3, standing_s=4.0)},
            DENSE,
            0.1,
        ),
        ({"motion": MotionModel("turn-then-drive", forward=MotionNoise(per_s=0.1))}, DENSE, 0.1),
        ({"sensor": Sensor(mount=(0.1, 0.2, 0.3))}, DENSE, 1.0),
        ({"estimator": "dead-reckoning", "fusion": "alone"}, DENSE, 1.0),
        (
            {"bounds": Bounds(jump_s=0.5, speed_m_s=60.0, interval_s=0.1)},
            changed(
                n100={"forward": 70.0},
                n101={"duration_ns": 0},
                n200={"stamp_ns": 10**15},
                n300={"stamp_ns": 1},
                n400={"duration_ns": 10**9},
                n401={"yaw_rate": 101.0},
                n500={"stamp_ns": 500 * 86_400 * 10**9},
                n600={"incarnation": 1_001},
            ),
            0.5,
        ),
    ],
    ids=[
        "plain",
        "nodes",
        "sightings",
        "wheels",
        "standing",
        "turns",
        "mounted",
        "other",
        "hostile",
    ],
)
def test_a_node_says_the_same_whether_odometry_comes_in_blocks_or_singly(
    options, measurements, share
):
    made = config(**({"front_end": FEW} | options))
    dispositions = [{}, {}, {}]
    expected, _ = answers(made, [*measurements, END], dispositions[0].__setitem__)
    for k, most in enumerate((10**9, 23)):
        blocks = in_blocks(measurements, most)
        found, singly = answers(made, [*blocks, END], dispositions[1 + k].__setitem__)
        assert found == expected
        assert dispositions[1 + k] == dispositions[0]
        first = sum(isinstance(each, OdometryBlock) for each in blocks)
        assert singly <= share * len(measurements) + first, singly


def test_a_block_of_another_turn_is_left_to_the_messages():
    node = RobotNode(config())
    blocks = [each for each in in_blocks(DENSE, 5) if isinstance(each, OdometryBlock)]
    assert node.drive_on(blocks[0]) == (0, [])  # before the initial pose
    following = blocks[3]
    for each in DENSE[: following.first]:
        node.handle(each, 0)
    assert node.drive_on(following._replace(robot="r2")) == (0, [])
    assert node.drive_on(following._replace(incarnation=2)) == (0, [])
    assert node.drive_on(following._replace(first=following.first + 1)) == (0, [])
    assert node.drive_on(following.part(0, 1))[0] == 1
    node.handle(DENSE[40], 0)  # one waits for its turn
    assert node.drive_on(following.part(1, 5)) == (0, [])


def test_a_block_of_which_nothing_follows_is_taken_whole_and_reported_at_each_place():
    still = [msgspec.structs.replace(DENSE[1], stamp_ns=20_000_000 * k, number=k, forward=0.0)
             for k in range(1, 141)]  # fmt: skip
    (block,) = in_blocks(still[1:], 10**9)
    singly, at_once = RobotNode(config()), RobotNode(config())
    for node in (singly, at_once):
        for message in (DENSE[0], still[0]):
            assert node.handle(message, 0) == []
    expected = [each for message in still[1:] for each in singly.handle(message, 0)]
    assert [each.message.measurements for each in expected] == [64, 128]
    assert at_once.drive_on(block) == (139, expected)
