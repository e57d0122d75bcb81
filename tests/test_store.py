import copy

import msgspec
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team.store import SubmapStore
from teamslam.team.wire import messages as m
from tests import build
from tests.support import packed, spd, submap

CHAIN = [submap(i) for i in range(6)]
BOTH = [*CHAIN, *(submap(i, "bravo") for i in range(4))]


def put(*submaps):
    found = SubmapStore()
    for each in submaps:
        assert found.add_submap(each) is None
    return found


@settings(deadline=None)
@given(st.permutations(BOTH * 2))
def test_any_order_with_duplicates_gives_the_same_set(order):
    found, expected = put(*order), put(*BOTH)
    assert found.streams == expected.streams
    for stream in expected.streams:
        assert found.chain(stream) == expected.chain(stream)
        assert not expected.streams[stream].pending
    assert found.missing() == ()


@settings(deadline=None)
@given(st.sets(st.integers(0, 5)))
def test_a_gap_holds_back_the_chain_and_is_listed(here):
    found = put(*(CHAIN[i] for i in here))
    first = next(i for i in range(7) if i not in here)
    assert len(found.chain(("alpha", 0))) == first
    assert found.chain(("alpha", 0)) == CHAIN[:first]
    behind = any(i > first for i in here)
    assert found.missing() == (
        (m.VersionEntry(robot="alpha", incarnation=0, sequence=first),) if behind else ()
    )


def changed(i, **fields):
    return msgspec.structs.replace(CHAIN[i], **fields)


@pytest.mark.parametrize(
    ("there", "new", "reason"),
    [
        ([0, 1], changed(1, mean=CHAIN[0].covariance[: 8 * 7]), "differs from the one in the set"),
        ([0], changed(1, first_measurement=9), "overlap submap 0's 0-9"),
        ([1], changed(0, last_measurement=10), "overlap submap 1's 10-19"),
        ([0], changed(1, first_measurement=11), "does not continue submap 0"),
        ([0], changed(1, start_ns=999_999), "does not continue submap 0"),
        ([0], changed(3, first_measurement=5), "overlap submap 0's 0-9"),
        ([4], changed(1, last_measurement=45), "overlap submap 4's 40-49"),
        ([4], changed(1, stamp_ns=4_500_000), "does not continue submap 4"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_reason_and_changes_nothing(there, new, reason):
    found = put(*(CHAIN[i] for i in there))
    before = copy.deepcopy(found.streams["alpha", 0])
    said = found.add_submap(new)
    assert reason in said
    assert f"submap {new.sequence} of alpha" in said
    after = found.streams["alpha", 0]
    assert (after.chain, after.pending) == (before.chain, before.pending)
    assert found.add_submap(CHAIN[there[0]]) is None, "what is in stays in"


# --- sightings: what completes a submap ---


def sighting(i, stamp=1, teammate="bravo", measurements=(3,)):
    name = {"robot": "alpha", "incarnation": 0, "sequence": i, "config": b"configur"}
    seen = {"teammate": teammate, "range": 2.0, "bearing": 0.5, "covariance": packed(spd(2))}
    return build.sighting_factor(
        stamp_ns=i * 1_000_000 + stamp, **name, **seen, measurements=measurements
    )


SEEN = [
    sighting(1, 1, measurements=(11,)),
    sighting(1, 1, "carol", (11,)),
    sighting(1, 2, "bravo", (12,)),
]
WITH_SIGHTINGS = [CHAIN[0], changed(1, sightings=3), CHAIN[2], *SEEN]


@settings(deadline=None)
@given(st.permutations(WITH_SIGHTINGS * 2), st.integers(0, 12))
def test_a_submap_counts_when_its_sightings_are_here_in_any_order(order, cut):
    found = SubmapStore()
    for k, each in enumerate(order):
        if k == cut:
            here = order[:cut]
            complete = all(x in here for x in (WITH_SIGHTINGS[1], *SEEN))
            first = CHAIN[0] in here
            expected = (1 + complete + (complete and CHAIN[2] in here)) if first else 0
            assert len(found.chain(("alpha", 0))) == expected
        assert found.add(each) is None
    assert len(found.chain(("alpha", 0))) == 3
    assert found.sightings(WITH_SIGHTINGS[1]) == SEEN
    assert found.missing() == ()


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        (sighting(1, 1, measurements=(13,)), "differs from the one in the set"),
        (sighting(3, 1, measurements=(12, 13)), "uses measurement 12, which another one has used"),
        (sighting(1, 3, "bravo", (14,)), "is one more than submap 1 has"),
    ],
)
def test_a_sighting_that_does_not_fit_is_refused_and_changes_nothing(new, reason):
    found = put(*WITH_SIGHTINGS[:3])
    for each in SEEN:
        found.add_sighting(each)
    before = copy.deepcopy(found)
    assert reason in found.add_sighting(new)
    assert found.sightings(WITH_SIGHTINGS[1]) == before.sightings(WITH_SIGHTINGS[1])
    assert len(found.chain(("alpha", 0))) == 3
