"""The door: golden bytes, round trips, and what hostile bytes come to."""

import contextlib
import json
import struct
import time
import tracemalloc

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from teamslam.team.config import UNNAMED
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.channels import OBSERVATIONS
from teamslam.team.wire.codec import LARGEST_PAYLOAD, WireError, decoded, encoded, tag_in
from teamslam.team.wire.structure import MOST_VALUES, SMALL
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
def test_each_message_has_its_golden_bytes(tag: str) -> None:
    assert encoded(EXAMPLES[tag]).hex() == GOLDEN[tag]


@pytest.mark.parametrize("tag", sorted(GOLDEN))
def test_golden_bytes_are_still_understood(tag: str) -> None:
    assert decoded(bytes.fromhex(GOLDEN[tag])) == EXAMPLES[tag]


@pytest.mark.parametrize("tag", sorted(m.BY_TAG))
def test_plain_msgpack_reads_the_tag_and_the_stamp_first(tag: str) -> None:
    assert fields_of(EXAMPLES[tag])[:2] == [tag, EXAMPLES[tag].stamp_ns]


@pytest.mark.parametrize("tag", sorted(m.BY_TAG))
def test_appended_fields_are_ignored(tag: str) -> None:
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
def test_a_message_from_before_its_later_fields_has_their_defaults(
    message: m.Message, later: int
) -> None:
    assert decoded(msgpack.packb(fields_of(message)[:-later])) == message


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.diag([0.1, 0.0, 0.2]), np.ones((3, 3))])
def test_a_motion_may_be_exact_in_some_direction(matrix: np.ndarray) -> None:
    fields = fields_of(EXAMPLES["increment/1"])
    fields[-1] = from_floats(matrix)
    assert decoded(msgpack.packb(fields), m.Increment).covariance == from_floats(matrix)


def test_a_number_of_numpy_is_encoded_as_the_float_that_it_is() -> None:
    """An estimate computed of arrays is one; a valid increment of huge numbers gave it."""
    plain = EXAMPLES["innovation/1"]
    computed = msgspec.structs.replace(plain, squared=np.float64(plain.squared))
    assert encoded(computed) == encoded(plain)
    with pytest.raises(TypeError, match="no field of a message takes a ndarray"):
        encoded(msgspec.structs.replace(plain, squared=np.zeros(2)))


def test_a_key_of_several_kinds_takes_them_and_names_them_for_another() -> None:
    kinds = OBSERVATIONS.kinds
    for tag in ("observations/1", "points/1", "detections/1"):
        payload = encoded(EXAMPLES[tag])
        assert decoded(payload, *kinds) == EXAMPLES[tag]
        assert tag_in(payload) == tag
    with pytest.raises(WireError, match="'observations/1' or 'points/1' or 'detections/1' "):
        decoded(encoded(odometry(0)), *kinds)
    with pytest.raises(WireError, match="wrong version: 'detections/9' where detections/1 is"):
        decoded(msgpack.packb(["detections/9"]), *kinds)


def test_no_tag_is_read_where_there_is_none() -> None:
    assert [tag_in(data) for data in (b"", b"\x98", b"\x98\x01\x02")] == ["", "", ""]


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
    """The payload with one more field, which no class has."""
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
        ("too large", b"\xdd\x7f\xff\xff\xff" + b"\x00" * 100, None),
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
def test_an_unsound_payload_is_refused_for_its_reason(
    reason: str, payload: bytes, expected: type[m.Message] | None
) -> None:
    assert reason_of(payload, expected) == reason


def test_a_payload_beyond_the_limit_is_refused_unread() -> None:
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
def test_a_payload_of_many_values_takes_no_more_than_its_size_and_is_refused_at_once(
    name: str, kind: type[m.Message] | None
) -> None:
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


def test_an_error_names_the_field() -> None:
    with pytest.raises(WireError, match=r"not ascending: Submap\.ids"):
        decoded(with_fields(SUBMAP, ids=from_ids([7, 4])))


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
def test_mutated_payloads_give_a_message_or_a_wire_error(
    tag: str, mutations: list[tuple[float, str, bytes]]
) -> None:
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


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_noise_is_never_a_message(payload: bytes) -> None:
    with pytest.raises(WireError):
        decoded(payload)


def test_the_examples_cover_every_message() -> None:
    assert set(EXAMPLES) == set(m.BY_TAG) == set(GOLDEN)
