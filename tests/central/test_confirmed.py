import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.submap_fold import SubmapFold
from teamslam.team.config import UNNAMED
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_ids, ids
from tests.teams import Submaps, of, published, stream

STREAMS = {name: stream(name, 15, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}
SUBMAPS = Submaps(list(STREAMS.values()))
FALSE = 9  # the name of a landmark that is not there
END_NS = 15_000_000_000


def misread(submap: m.Submap) -> m.Submap:
    seen = ids(submap.ids, "ids")
    return msgspec.structs.replace(submap, ids=from_ids(np.array([*seen[:-1], FALSE], np.uint32)))


def rule(spoilt: set[tuple[str, int]], **options: object) -> MapPublisher:
    config = CentralConfig(tick_s=3.0, broadcast_s=3.0, **options)
    found = MapPublisher(SubmapFold(config, b"settings"))
    for each in STREAMS.values():
        found.store.add_start(published(each)[0])
    for k in range(5):
        for name in STREAMS:
            submap = SUBMAPS[name][k]
            found.store.add_submap(misread(submap) if (name, k) in spoilt else submap)
    return found


def final(found: MapPublisher) -> m.FusedMap:
    return of(found.publish_final(END_NS), ch.FINAL_MAP)[0]


def left_out(fused: m.FusedMap) -> list[str]:
    return [text for text in fused.reasons if "left out" in text]


SAME = [("r1", 3), ("r2", 3)]


@pytest.mark.parametrize(("least", "stands"), [(1, True), (2, False)])
def test_what_one_submap_alone_has_stands_in_the_map_only_if_one_is_enough(least, stands):
    fused = final(rule({("r1", 3)}, landmark_submaps=least))
    assert (FALSE in ids(fused.ids, "ids")) == stands
    assert len(left_out(fused)) == (not stands)
    assert all(f"of 6 landmarks ({FALSE})" in text for text in left_out(fused))


def test_what_two_submaps_agree_on_enters_the_map_with_both():
    fused = final(rule(set(SAME), landmark_submaps=2))
    assert FALSE in ids(fused.ids, "ids")
    assert left_out(fused) == []


def test_running_maps_and_priors_have_the_same_landmarks():
    found = rule({("r1", 3)}, landmark_submaps=2)
    out = found.publish_due(END_NS, END_NS)
    (fused,) = of(out, ch.FUSED_MAP)
    shown = ids(fused.ids, "ids").tolist()
    assert shown
    assert FALSE not in shown
    priors = of(out, ch.PRIOR)
    assert len(priors) == 2
    assert all(ids(each.ids, "ids").tolist() == shown for each in priors)


def test_what_one_submap_has_without_a_name_is_in_running_maps_and_not_in_the_final_one():
    found = MapPublisher(SubmapFold(CentralConfig(tick_s=3.0, broadcast_s=3.0), b"settings"))
    found.store.add_start(published(STREAMS["r1"])[0])
    for k in range(5):
        submap = SUBMAPS["r1"][k]
        if k == 2:
            seen = ids(submap.ids, "ids")
            named = from_ids(np.array([*seen[:-1], UNNAMED], np.uint32))
            two = from_ids(np.array([2], np.uint32))
            submap = msgspec.structs.replace(submap, ids=named, counts=two, seen=b"\1", keyframes=1)
        found.store.add_submap(submap)
    (running,) = of(found.publish_due(END_NS, END_NS), ch.FUSED_MAP)
    last = final(found)
    tentative, kept = (int(ids(each.ids, "ids")[-1]) for each in (running, last))
    assert tentative >= UNNAMED > kept
    assert [text.startswith("left out, 2 submaps") for text in left_out(last)] == [True]
