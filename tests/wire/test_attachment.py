"""The attachment of a publication: golden bytes, and a key that is not its own."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teamslam.team.wire.zenoh.attachment import Attachment, AttachmentError, pack, unpack

KEY = "team/t/robot/r1/submap"
GOLDEN = bytes.fromhex("0100000000000000feffffffffffffff0300000000000000496a1b39ffcf6e5c")
"""Attachment of team time 1 ns, wall clock -2 ns and counter 3 on `KEY`."""
stamps = st.integers(-(2**63), 2**63 - 1)


def test_the_bytes_are_golden() -> None:
    assert pack(KEY, Attachment(1, -2, 3)) == GOLDEN


@given(st.text(st.characters(codec="utf-8")), st.builds(Attachment, stamps, stamps, stamps))
def test_an_attachment_comes_back_on_its_key(key: str, attachment: Attachment) -> None:
    assert unpack(key, pack(key, attachment)) == attachment


@given(st.binary(max_size=64))
def test_noise_is_no_attachment(data: bytes) -> None:
    with pytest.raises(AttachmentError):
        unpack(KEY, data)


@pytest.mark.parametrize(
    "other",
    ["team/t/robot/r1/team/pose", "team/t/robot/r2/submap", "team/u/robot/r1/submap"],
)
def test_an_attachment_of_another_key_is_refused(other: str) -> None:
    with pytest.raises(AttachmentError, match="another key"):
        unpack(other, GOLDEN)


def test_an_attachment_of_an_earlier_version_is_named_as_one() -> None:
    with pytest.raises(AttachmentError, match="an older version"):
        unpack(KEY, struct.pack("<qqq", 1, 2, 3))
