"""The structure of a payload, read without its values, against a reader that creates them."""

import contextlib
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from teamslam.team.wire import structure
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.structure import DEEPEST, StructureError, check_structure, read_tag
from tests.support import examples

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


def depth(value: Any) -> int:
    if isinstance(value, dict):
        value = list(value.values())
    inner = value if isinstance(value, list) else None
    return 0 if inner is None else 1 + max(map(depth, inner), default=0)


def reason_of(payload: bytes) -> str:
    with pytest.raises(StructureError) as refused:
        check_structure(payload)
    return refused.value.reason


@given(values, st.booleans())
def test_every_value_is_counted_and_its_end_found(value: object, single: bool) -> None:
    payload = msgpack.packb(value, use_single_float=single)
    check_structure(payload)
    check_structure(payload + b"\xc1")
    for cut in {0, len(payload) // 2, len(payload) - 1}:
        assert reason_of(payload[:cut]) == "truncated"


@given(values, st.integers(1, 40))
def test_more_values_than_the_most_are_too_many(value: object, most: int) -> None:
    payload = msgpack.packb(value)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(structure, "MOST_VALUES", most)
        if count(value) > most:
            assert reason_of(payload) == "too large"
        else:
            check_structure(payload)


@pytest.mark.parametrize("nested", range(DEEPEST - 2, DEEPEST + 3))
def test_nesting_is_bounded(nested: int) -> None:
    payload = b"\x91" * nested + b"\xc0"
    if nested < DEEPEST:
        check_structure(payload)
    else:
        assert reason_of(payload) == "too deep"


@given(st.binary(max_size=200))
def test_noise_is_read_or_refused(payload: bytes) -> None:
    for read in (check_structure, read_tag):
        with contextlib.suppress(StructureError):
            read(payload)


def test_no_message_is_near_the_bounds_and_each_has_its_tag() -> None:
    deepest = 0
    for message in examples():
        payload = encoded(message)
        check_structure(payload)
        assert read_tag(payload) == type(message).__struct_config__.tag
        deepest = max(deepest, depth(msgpack.unpackb(payload)))
    assert 2 * deepest <= DEEPEST


@pytest.mark.parametrize(
    "head", [b"\x91\xa3x/1", b"\xdc\x00\x01\xa3x/1", b"\xdd\x00\x00\x00\x01\xa3x/1",
             b"\x91\xd9\x03x/1", b"\x91\xda\x00\x03x/1", b"\x91\xdb\x00\x00\x00\x03x/1"]
)  # fmt: skip
def test_a_tag_is_read_in_every_form_of_an_array_and_a_text(head: bytes) -> None:
    assert read_tag(head) == msgpack.unpackb(head)[0] == "x/1"
    for cut in range(len(head)):
        with pytest.raises(StructureError):
            read_tag(head[:cut])
