"""Digests of the core are those of the standard library."""

import hashlib

import pytest
from hypothesis import given, strategies as st

from teamslam.team import core


@given(st.lists(st.binary(max_size=300), max_size=5), st.integers(1, 64), st.binary(max_size=16))
def test_a_digest_is_that_of_the_standard_library_however_its_bytes_arrive(parts, size, person):
    data = b"".join(parts)
    expected = hashlib.blake2b(data, digest_size=size, person=person)
    digest = core.Blake2b(size, person)
    for each in parts:
        digest.update(each)
    whole, copy = digest.digest(), digest.copy()
    assert whole == core.blake2b(data, size, person) == expected.digest()
    copy.update(b"more")
    expected.update(b"more")
    assert (digest.digest(), copy.digest()) == (whole, expected.digest())


@pytest.mark.parametrize(("size", "person"), [(0, b""), (65, b""), (8, bytes(17))])
def test_a_size_or_a_person_beyond_the_algorithm_is_refused(size, person):
    with pytest.raises(ValueError, match="must be"):
        core.blake2b(b"", size, person)
