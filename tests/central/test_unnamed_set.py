from functools import cache
from itertools import permutations

import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.submap_fold import RecordedFields, SubmapFold
from teamslam.team import translate
from teamslam.team.association import AssociationProfile
from teamslam.team.wire import messages as m
from teamslam.team.wire.codec import encoded
from tests import build
from tests.estimation.association.unnamed_worlds import circle, drive

CONFIG = CentralConfig(association=AssociationProfile(recent=4), withdraw_above=None)
RING = 20.0


@cache
def two_robots() -> dict[str, list[m.Submap]]:
    rng = np.random.default_rng(8)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 80))
    r = rng.uniform(16.0, 24.0, 80)
    world = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    found = {}
    for robot, phase in (("r1", 0.0), ("r2", 2.0)):
        submaps, _ = drive(robot, circle((0.0, 0.0), RING, 8, 0.45, phase), world, rng)
        found[robot] = [
            translate.submap_message(
                robot,
                1,
                k,
                (10 * k + 1, 10 * k + 10),
                (each.end_ns - 10**10, each.end_ns),
                bytes(8),
                each.local,
            )
            for k, each in enumerate(submaps)
        ]
    return found


def _rule(*messages: m.Message) -> MapPublisher:
    rule = MapPublisher(SubmapFold(CONFIG, bytes(8)))
    for message in (*(build.initial_pose(robot=robot) for robot in two_robots()), *messages):
        rule.store.add(message)
    return rule


def _verdict(withdrawn: bool = False) -> m.Verdict:
    first = m.LocalLandmark(robot="r1", incarnation=1, sequence=3, local=0)
    second = m.LocalLandmark(robot="r1", incarnation=1, sequence=4, local=0)
    return build.verdict(first, second, same=False, withdrawn=withdrawn)


def _final(rule: MapPublisher) -> m.FusedMap:
    final = rule.publish_final(10**12)[-1].message
    assert isinstance(final, m.FusedMap)
    return final


@pytest.fixture(scope="module")
def final():
    return _final(_rule(*two_robots()["r1"], *two_robots()["r2"]))


def test_late_submaps_and_maps_in_between_change_no_byte_of_the_final_map(final):
    rule = _rule()
    for k in range(8):
        rule.store.add(two_robots()["r2"][k])
        if k % 3 == 2:
            rule.publish_due(two_robots()["r2"][k].stamp_ns, two_robots()["r2"][k].stamp_ns)
    for submap in reversed(two_robots()["r1"]):
        rule.store.add(submap)
    assert encoded(_final(rule)) == encoded(final)
    assert final.memberships
    assert [each.kind for each in final.decisions if each.kind == "merge"] == ["merge"]


def test_a_verdict_is_a_member_of_the_set_whenever_it_comes_and_names_the_map():
    maps = []
    for order in permutations(("r1", "r2", "verdict")):
        parts = {**two_robots(), "verdict": [_verdict()]}
        rule = _rule(*(message for what in order for message in parts[what]))
        if order[0] == "r1":
            maps.append(_final(rule))
    assert len({encoded(each) for each in maps}) == 1
    assert maps[0].verdicts == (_verdict().judgement,)


def test_a_verdict_that_is_withdrawn_leaves_the_map_as_if_it_had_never_been_said(final):
    for order in ((_verdict(), _verdict(withdrawn=True)), (_verdict(withdrawn=True), _verdict())):
        found = _final(_rule(*two_robots()["r1"], order[0], *two_robots()["r2"], order[1]))
        assert found.verdicts == ()
        assert (found.means, found.digest) == (final.means, final.digest)


def test_a_map_is_computed_again_from_the_verdicts_that_it_names(final):
    maps = []
    for verdicts in ([_verdict()], []):
        fold = _rule(*verdicts, *two_robots()["r1"], *two_robots()["r2"]).fold
        maps.append(fold.make_map("final", recorded=RecordedFields((), 0, ()))[-1].message)
    with_verdict, without = maps
    assert with_verdict.digest != without.digest
    assert without.means == final.means


def test_a_robot_that_is_withdrawn_leaves_the_landmarks_as_if_it_had_never_been():
    order = build.withdrawal(robot="r2", reason="")
    wanted = _final(_rule(*two_robots()["r1"]))
    both = [each for pair in zip(*two_robots().values(), strict=True) for each in pair]
    maps = []
    for at in (0, 5, 16):
        rule = _rule()
        for k, message in enumerate([*both[:at], order, *both[at:]]):
            rule.store.add(message)
            if k % 6 == 5:
                rule.publish_due(message.stamp_ns, message.stamp_ns)
        maps.append(_final(rule))
    assert len({encoded(each) for each in maps}) == 1
    assert (maps[0].means, maps[0].memberships) == (wanted.means, wanted.memberships)
    assert maps[0].withdrawn == ("r2",)
