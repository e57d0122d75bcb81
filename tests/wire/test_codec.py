import contextlib
import json
import struct
import time
import tracemalloc
from typing import Any, get_type_hints

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from teamslam.team.config import UNNAMED
from teamslam.team.core import check_packed_covariance, check_pose_covariance
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.channels import OBSERVATIONS
from teamslam.team.wire.codec import (
    DEEPEST,
    LARGEST_PAYLOAD,
    MOST_VALUES,
    SMALL,
    WireError,
    check_structure,
    decoded,
    encoded,
    tag_in,
)
from teamslam.team.wire.zenoh.delivery import Attachment, AttachmentError, pack, unpack
from tests import build
from tests.support import ROOT, examples, odometry, packed, spd, submap

EXAMPLES = {m.tag_of(type(message)): message for message in examples()}
GOLDEN = json.loads((ROOT / "tests/golden/messages.json").read_text())


def reason_of(payload: bytes, expected: type[m.Message] | None = None) -> str:
    with pytest.raises(WireError) as caught:
        decoded(payload, *([expected] if expected else []))
    return caught.value.reason


def fields_of(message: m.Message) -> list[object]:
    return msgpack.unpackb(encoded(message))


@pytest.mark.parametrize("tag", sorted(m.BY_TAG))
def test_each_message_has_its_golden_bytes_and_is_read_from_them(tag):
    assert encoded(EXAMPLES[tag]).hex() == GOLDEN[tag]
    assert decoded(bytes.fromhex(GOLDEN[tag])) == EXAMPLES[tag]
    assert fields_of(EXAMPLES[tag])[:2] == [tag, EXAMPLES[tag].stamp_ns]


@pytest.mark.parametrize("tag", sorted(m.BY_TAG))
def test_appended_fields_are_ignored(tag):
    longer = msgpack.packb([*fields_of(EXAMPLES[tag]), "a later field", 7])
    assert decoded(longer) == EXAMPLES[tag]


@pytest.mark.parametrize(
    ("message", "later"),
    [
        (build.done(robot="alpha", measurements=2, steps=1, submaps=1), 1),
        (msgspec.structs.replace(EXAMPLES["observations/1"], covariances=b""), 1),
        *((submap(0), later) for later in (1, 4, 5, 7, 9)),
    ],
)
def test_a_message_from_before_its_later_fields_has_their_defaults(message, later):
    assert decoded(msgpack.packb(fields_of(message)[:-later])) == message


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.diag([0.1, 0.0, 0.2]), np.ones((3, 3))])
def test_a_motion_may_be_exact_in_some_direction(matrix):
    fields = fields_of(EXAMPLES["increment/1"])
    fields[-1] = from_floats(matrix)
    assert decoded(msgpack.packb(fields), m.Increment).covariance == from_floats(matrix)


def test_a_number_of_numpy_is_encoded_as_the_float_that_it_is():
    """Estimates computed from arrays have this type."""
    plain = EXAMPLES["innovation/1"]
    computed = msgspec.structs.replace(plain, squared=np.float64(plain.squared))
    assert encoded(computed) == encoded(plain)
    with pytest.raises(TypeError, match="no field of a message takes a ndarray"):
        encoded(msgspec.structs.replace(plain, squared=np.zeros(2)))


def test_a_key_of_several_kinds_takes_them_and_names_them_for_another():
    kinds = OBSERVATIONS.kinds
    for tag in ("observations/1", "points/1", "detections/1"):
        payload = encoded(EXAMPLES[tag])
        assert decoded(payload, *kinds) == EXAMPLES[tag]
        assert tag_in(payload) == tag
    with pytest.raises(WireError, match="'observations/1' or 'points/1' or 'detections/1' "):
        decoded(encoded(odometry(0)), *kinds)
    with pytest.raises(WireError, match="wrong version: 'detections/9' where detections/1 is"):
        decoded(msgpack.packb(["detections/9"]), *kinds)


def with_fields(message: m.Message, **values: object) -> bytes:
    fields = fields_of(message)
    for name, value in values.items():
        fields[1 + type(message).__struct_fields__.index(name)] = value
    return msgpack.packb(fields)


def indefinite(n: int) -> bytes:
    return packed(spd(n) - 5.0 * np.eye(n))


def with_two_nodes(stamps: list[int]) -> bytes:
    joint = packed(spd(13))
    return with_fields(
        SUBMAP,
        nodes=from_stamps(stamps),
        mean=from_floats(range(13)),
        covariance=joint,
        sensitivity=from_floats(range(26)),
    )


def longer(message: m.Message, field: bytes) -> bytes:
    fields = msgpack.packb(fields_of(message))
    assert fields[0] == 0xDC, "an array of more than fifteen"
    count = int.from_bytes(fields[1:3], "big") + 1
    return b"\xdc" + count.to_bytes(2, "big") + fields[3:] + field


LISTS = b"\xdd" + MOST_VALUES.to_bytes(4, "big") + b"\x90" * MOST_VALUES
"""A list of so many empty lists."""
NAN, INF = struct.pack("<d", float("nan")), struct.pack("<d", float("inf"))
POSE = EXAMPLES["pose/1"]
SUBMAP = EXAMPLES["submap/1"]
SEEN = EXAMPLES["observations/1"]
POINTS = EXAMPLES["points/1"]
INCREMENT = EXAMPLES["increment/1"]
NO_COVARIANCE = from_floats([1.0, 2.0, 1.0] * 2)
FOUND = EXAMPLES["detections/1"]
MAP = EXAMPLES["map/1"]
MET = EXAMPLES["sighting_factor/1"]
HUGE = [1.0, 1.7e308, 0.0, -1.7e308, 1.0, 0.0, 0.0, 0.0, 1.0]
SKEW = spd(3) + np.triu(np.ones((3, 3)), 1)


@pytest.mark.parametrize(
    ("reason", "payload", "expected"),
    [
        ("wrong length", with_fields(SUBMAP, counts=from_ids([6]), keyframes=8), None),
        ("wrong length", with_fields(SUBMAP, seen=b"\1"), None),
        ("wrong length", with_fields(SUBMAP, counts=from_ids([6, 6])), None),
        ("wrong length", with_fields(SUBMAP, counts=b"", seen=b"", keyframes=0), None),
        ("out of bounds", with_fields(SUBMAP, counts=from_ids([0])), None),
        ("not ascending", with_fields(SUBMAP, biases=("range_scale", "bearing")), None),
        ("wrong length", with_fields(SUBMAP, biases=("bearing",)), None),
        ("wrong length", with_fields(SUBMAP, biases=()), None),
        ("out of bounds", with_fields(INCREMENT, increment=from_floats([1.0, 0.0, 3.2])), None),
        ("wrong length", with_fields(INCREMENT, increment=from_floats([1.0, 0.0])), None),
        *(
            (reason, with_fields(INCREMENT, covariance=from_floats(matrix)), None)
            for reason, matrix in (
                ("not positive definite", np.diag([1.0, -1.0, 1.0])),
                ("not positive definite", [1, 2, 0, 2, 1, 0, 0, 0, 1]),
                ("not positive definite", [0, 1, 0, 1, 1, 0, 0, 0, 1]),
                ("not symmetric", [1, 0, 0, 0.5, 1, 0, 0, 0, 1]),
            )
        ),
        ("out of bounds", with_fields(EXAMPLES["steering/1"], steering=1.6), None),
        ("wrong length", with_fields(POINTS, positions=from_floats([1.0, 0.0])), None),
        ("not positive definite", with_fields(POINTS, covariances=NO_COVARIANCE), None),
        ("wrong length", with_fields(SEEN, covariances=from_floats([1.0, 0.0, 1.0])), None),
        ("not positive definite", with_fields(SEEN, covariances=NO_COVARIANCE), None),
        *(
            ("out of bounds", with_fields(message, ids=from_ids([1, UNNAMED])), None)
            for message in (SEEN, POINTS, EXAMPLES["known_map/1"], EXAMPLES["truth_landmarks/1"])
        ),
        ("wrong tag", b"\xc0", None),
        ("wrong tag", b"\x90", None),
        ("wrong tag", msgpack.packb([7, 0]), None),
        ("wrong tag", msgpack.packb({"tag": "submap/1"}), None),
        ("wrong tag", msgpack.packb(["elsewhere/1", 0]), None),
        ("wrong tag", encoded(SUBMAP), m.Odometry),
        ("wrong version", msgpack.packb(["submap/2", 0]), m.Submap),
        ("wrong version", msgpack.packb(["submap/2", 0]), None),
        ("truncated", b"", None),
        ("truncated", encoded(SUBMAP)[:-1], None),
        ("truncated", b"\xdc", None),
        ("trailing bytes", encoded(SUBMAP) + b"\x00", None),
        ("wrong length", with_fields(SUBMAP, mean=b"\x00" * 8), None),
        ("wrong length", with_fields(SUBMAP, mean=b"\x00" * 7), None),
        ("wrong length", with_fields(SUBMAP, covariance=b""), None),
        ("wrong length", with_fields(SEEN, ranges=b"\x00" * 24), None),
        ("not finite", with_fields(SUBMAP, mean=NAN * 10), None),
        ("not finite", with_fields(SEEN, ranges=INF * 2), None),
        ("not symmetric", with_fields(POSE, covariance=from_floats(SKEW)), None),
        ("not positive definite", with_fields(SUBMAP, covariance=indefinite(10)), None),
        ("not positive definite", with_fields(POSE, covariance=from_floats(-spd(3))), None),
        (
            "not positive definite",
            with_fields(MAP, covariance=from_floats([1.0, 1.0, 1.0] * 2)),
            None,
        ),
        ("not positive definite", with_fields(MAP, covariance=from_floats([1e300] * 6)), None),
        ("not positive definite", with_fields(MAP, covariance=from_floats([-1.0, 0, 1] * 2)), None),
        ("not symmetric", with_fields(POSE, covariance=from_floats(HUGE)), None),
        ("not ascending", with_fields(SUBMAP, ids=from_ids([7, 7])), None),
        ("out of bounds", with_fields(SEEN, bearings=from_floats([4.0, 0.0])), None),
        ("out of bounds", with_fields(SEEN, ranges=from_floats([-1.0, 0.0])), None),
        ("out of bounds", with_fields(SUBMAP, start_ns=2**40), None),
        ("out of bounds", with_fields(SUBMAP, nodes=from_stamps([8_000])), None),
        ("out of bounds", with_fields(SUBMAP, nodes=from_stamps([9_001])), None),
        ("wrong length", with_fields(SUBMAP, nodes=b""), None),
        ("not ascending", with_two_nodes([8_500, 8_500]), None),
        ("out of bounds", with_fields(MET, range=0.0), None),
        ("out of bounds", with_fields(MET, bearing=3.2), None),
        ("out of bounds", with_fields(MET, teammate="alpha"), None),
        ("not ascending", with_fields(MET, measurements=[]), None),
        ("not ascending", with_fields(MET, measurements=[5, 5]), None),
        ("not positive definite", with_fields(MET, covariance=indefinite(2)), None),
        ("wrong tag", b"\xdd\x7f\xff\xff\xff" + b"\x00" * 100, None),
        ("too large", with_fields(SUBMAP, ids=from_ids(range(4096)), mean=bytes(8 * 8198)), None),
        ("wrong tag", b"\x91" * 100_000, None),
        ("too deep", longer(SUBMAP, b"\x91" * 100_000 + b"\xc0"), None),
        ("too deep", longer(SUBMAP, b"\x91" * 300_000 + b"\xc0"), None),
        ("too large", longer(SUBMAP, b"\x92" + LISTS * 2), None),
        ("truncated", longer(SUBMAP, b"\x91" + LISTS)[:-1], None),
        ("wrong field", b"\x92" + msgpack.packb("status/1") + LISTS, None),
        ("damaged", longer(SUBMAP, b"\xc1"), None),
        ("damaged", longer(SUBMAP, b"\xc1" + bytes(SMALL)), None),
        ("damaged", b"\xc1", None),
        ("damaged", b"\x91\xa1\xff", None),
        ("wrong length", with_fields(FOUND, bearings=b""), None),
        ("wrong length", with_fields(FOUND, signatures=bytes(8)), None),
        ("out of bounds", with_fields(FOUND, ranges=from_floats([-1.0, 0.0])), None),
        ("not positive definite", with_fields(FOUND, covariances=bytes(48)), None),
        ("wrong field", with_fields(SUBMAP, robot="Not A Name"), None),
        ("wrong field", with_fields(SUBMAP, incarnation=-1), None),
        ("wrong field", with_fields(SUBMAP, incarnation=1.5), None),
        ("wrong field", with_fields(SUBMAP, mean=[0.0]), None),
        ("wrong field", with_fields(SUBMAP, stamp_ns=2**62), None),
        ("wrong field", with_fields(EXAMPLES["status/1"], figures={"x": float("nan")}), None),
        ("wrong field", with_fields(EXAMPLES["odometry/1"], forward=float("nan")), None),
        ("wrong field", msgpack.packb(fields_of(SUBMAP)[:-11]), None),
    ],
)
def test_an_unsound_payload_is_refused_for_its_reason(reason, payload, expected):
    assert reason_of(payload, expected) == reason


@pytest.mark.parametrize("name", ["Not A Name", "r1\n", "", "r" * 33])
@pytest.mark.parametrize(
    "tag",
    [
        tag
        for tag, each in EXAMPLES.items()
        if get_type_hints(type(each), include_extras=True).get("robot") == m.Robot
    ],
)
def test_a_robot_of_a_frequent_message_has_a_name(tag, name):
    assert reason_of(with_fields(EXAMPLES[tag], robot=name)) == "wrong field"


def test_an_error_names_the_field_and_a_payload_beyond_the_limit_is_not_read():
    with pytest.raises(WireError, match=r"not ascending: Submap\.ids"):
        decoded(with_fields(SUBMAP, ids=from_ids([7, 4])))
    assert reason_of(b"\x91" * (LARGEST_PAYLOAD + 1)) == "too large"


MIB = 2**20
TIME = b"\x00"
HOLDING = msgpack.packb(["a", 0, False, [], bytes(8)])
BOMBS = {
    "lists as the message": LISTS[:5] + b"\x90" * 8 * MIB,
    "lists as a field": b"\x96" + msgpack.packb("status/1") + TIME + b"\xa1x\xa0" + LISTS * 32,
    "lists as a later field": longer(SUBMAP, b"\x9f" + LISTS * 32),
    "texts": b"\x96" + msgpack.packb("status/1") + TIME + b"\xa1x\xa0\x80\xdd"
    + (8 * MIB).to_bytes(4, "big") + b"\xa0" * 8 * MIB,
    "structures": b"\x96" + msgpack.packb("set_summary/1") + TIME + b"\xa1x\x00\xc4\x08" + bytes(8)
    + b"\xdd" + MIB.to_bytes(4, "big") + HOLDING * MIB + b"\x90",
}  # fmt: skip
"""Payloads of megabytes whose values would take many times their size as objects."""


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("kind", [m.Status, m.SetSummary, m.Submap, None], ids=str)
def test_a_payload_of_many_values_takes_no_more_than_its_size_and_is_refused_at_once(name, kind):
    payload = BOMBS[name]
    began = time.process_time()
    tracemalloc.start()
    try:
        reason = reason_of(payload, kind)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert reason in ("wrong tag", "wrong field", "too large")
    assert peak < len(payload)
    assert time.process_time() - began < 5.0


@settings(deadline=None, max_examples=1500)
@given(
    st.sampled_from(sorted(EXAMPLES)),
    st.lists(
        st.tuples(
            st.floats(0, 1, exclude_max=True), st.sampled_from("fird"), st.binary(max_size=9)
        ),
        min_size=1,
        max_size=4,
    ),
)
@example("pose/1", [(0.9, "f", b"\x7f")])
def test_mutated_payloads_give_a_message_or_a_wire_error(tag, mutations):
    payload = bytearray(encoded(EXAMPLES[tag]))
    for where, how, data in mutations:
        i = int(where * len(payload))
        if how == "f":  # flip bits
            payload[i : i + 1] = bytes(b ^ (data[0] if data else 1) for b in payload[i : i + 1])
        elif how == "i":  # insert
            payload[i:i] = data
        elif how == "r":  # replace
            payload[i : i + len(data)] = data
        else:  # drop
            del payload[i : i + len(data)]
    with contextlib.suppress(WireError):
        message = decoded(bytes(payload))
        assert decoded(encoded(message)) == message


def test_the_examples_cover_every_message():
    assert set(EXAMPLES) == set(m.BY_TAG) == set(GOLDEN)


scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(-1e30, 1e30)
leaves = scalars | st.text(max_size=300) | st.binary(max_size=300)
values = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=40), inner, max_size=20)
    ),
    max_leaves=40,
)


def count(value: Any) -> int:
    if isinstance(value, dict):
        return 1 + sum(1 + count(each) for each in value.values())
    return 1 + sum(map(count, value)) if isinstance(value, list) else 1


def reason_of_structure(payload: bytes) -> str:
    with pytest.raises(WireError) as refused:
        check_structure(payload)
    return refused.value.reason


@pytest.mark.parametrize("nested", range(DEEPEST - 2, DEEPEST + 3))
def test_nesting_is_bounded(nested):
    payload = b"\x91" * nested + b"\xc0"
    if nested < DEEPEST:
        check_structure(payload)
    else:
        assert reason_of_structure(payload) == "too deep"


def verdict(check, *arguments):
    try:
        check(*arguments)
    except ValueError as error:
        return str(error).partition(":")[0]
    return "sound"


@pytest.mark.parametrize("seed", range(20))
def test_a_symmetric_pose_covariance_is_judged_as_a_packed_one_of_three_rows_is(seed):
    rng = np.random.default_rng(seed)
    scale = np.diag(10.0 ** rng.uniform(-100.0, 100.0, 3))
    root = rng.normal(size=(3, 3))
    P = root @ root.T
    for matrix in (P, P - 0.5 * np.eye(3), root[:, :2] @ root[:, :2].T - 1e-6 * np.eye(3), -P):
        scaled = scale @ (0.5 * (matrix + matrix.T)) @ scale
        packed = from_floats(scaled[np.triu_indices(3)])
        expected = verdict(check_packed_covariance, packed, 3, "it")
        assert verdict(check_pose_covariance, from_floats(scaled), "it") == expected


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)])
def test_symmetry_is_judged_by_the_standard_deviations(place):
    sigmas = np.array([1e-3, 10.0, 0.1])
    P = np.outer(sigmas, sigmas) * (0.3 + 0.7 * np.eye(3))
    for by, expected in ((5e-10, "sound"), (2e-9, "not symmetric")):
        other = P.copy()
        other[place] += by * sigmas[place[0]] * sigmas[place[1]]
        assert verdict(check_pose_covariance, from_floats(other), "it") == expected


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(9))
def test_no_entry_of_a_pose_covariance_is_infinite_or_no_number(value, place):
    P = np.eye(3).ravel()
    P[place] = value
    assert verdict(check_pose_covariance, from_floats(P), "it") == "not finite"


KEY = "team/t/robot/r1/submap"
GOLDEN_ATTACHMENT = bytes.fromhex(
    "0100000000000000feffffffffffffff0300000000000000496a1b39ffcf6e5c"
)
"""Attachment of team time 1 ns, wall clock -2 ns and counter 3 on `KEY`."""
stamps = st.integers(-(2**63), 2**63 - 1)


@given(st.text(st.characters(codec="utf-8")), st.builds(Attachment, stamps, stamps, stamps))
def test_an_attachment_comes_back_on_its_key(key, attachment):
    assert unpack(key, pack(key, attachment)) == attachment


@given(st.binary(max_size=64))
def test_noise_is_no_attachment(data):
    with pytest.raises(AttachmentError):
        unpack(KEY, data)


@pytest.mark.parametrize(
    ("key", "data", "why"),
    [
        ("team/t/robot/r1/team/pose", GOLDEN_ATTACHMENT, "another key"),
        ("team/t/robot/r2/submap", GOLDEN_ATTACHMENT, "another key"),
        ("team/u/robot/r1/submap", GOLDEN_ATTACHMENT, "another key"),
        (KEY, struct.pack("<qqq", 1, 2, 3), "an older version"),
    ],
)
def test_an_attachment_of_another_key_or_version_is_refused(key, data, why):
    assert pack(KEY, Attachment(1, -2, 3)) == GOLDEN_ATTACHMENT
    with pytest.raises(AttachmentError, match=why):
        unpack(key, data)
