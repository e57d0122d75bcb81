from itertools import pairwise

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.sent_priors import SentPriors
from teamslam.central.submap_fold import SubmapFold
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.map_joining.marginals import LandmarkBlocks
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_ids, ids
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.teams import Submaps, of, published, stream

CONFIG = CentralConfig(tick_s=3.0, broadcast_s=6.0)
STREAMS = {name: stream(name, 15, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}
SUBMAPS = Submaps(list(STREAMS.values()))
STARTS = {name: published(each)[0] for name, each in STREAMS.items()}
END_NS = 15_000_000_000


def rule(config=CONFIG, starts=("r1", "r2")):
    found = MapPublisher(SubmapFold(config, b"settings"))
    for name in starts:
        found.store.add_start(STARTS[name])
    return found


def with_all(found):
    for submap in SUBMAPS.every():
        found.store.add_submap(submap)
    return found


def whole(config=CONFIG):
    return with_all(rule(config))


def final(found):
    return of(found.publish_final(END_NS), ch.FINAL_MAP)[0]


def test_broadcasts_lie_so_far_apart_and_name_their_set():
    found, maps, priors = rule(), [], []
    for k in range(5):
        for name in ("r1", "r2"):
            found.store.add_submap(SUBMAPS[name][k])
        now_ns = (k + 1) * 3_000_000_000
        out = found.publish_due(now_ns, now_ns)
        maps += of(out, ch.FUSED_MAP)
        priors += of(out, ch.PRIOR)
    assert [each.stamp_ns // 10**9 for each in maps] == [3, 9, 15]
    for each in maps:
        last = each.stamp_ns // 3_000_000_000 - 1
        assert each.members == build.version(r1=last, r2=last)
        assert (each.final, each.provisional, each.frame) == (False, False, "r1/1")
    assert {p.digest for p in priors} == {each.digest for each in maps}
    assert len({each.digest for each in maps}) == 3
    assert [(p.robot, p.sequence) for p in priors[:2]] == [("r1", 0), ("r2", 0)]
    for each in [*maps, *priors]:
        assert decoded(encoded(each)) == each


def test_a_map_has_what_the_watermark_has_passed_though_its_tick_is_not_whole():
    found, maps = rule(CentralConfig(tick_s=100.0, broadcast_s=3.0)), []
    for k in range(3):
        for name, behind_ns in (("r1", 3_000_000_000), ("r2", 0)):
            submap = SUBMAPS[name][k]
            found.store.add_submap(submap)
            said = of(found.publish_due(submap.stamp_ns - behind_ns, submap.stamp_ns), ch.FUSED_MAP)
            assert bool(said) == (name == "r2"), "r1's waits for r2's, nothing is said twice"
            maps += said
    assert [each.members for each in maps] == [build.version(r1=k, r2=k) for k in range(3)]
    assert not any(each.provisional for each in maps)
    config = CentralConfig(tick_s=100.0, broadcast_s=3.0)
    assert encoded(final(with_all(found))) == encoded(final(whole(config))), "it leaves no trace"


def test_a_map_that_is_asked_for_waits_for_no_teammate_and_is_said_once():
    config = CentralConfig(tick_s=100.0, broadcast_s=100.0)
    found, said = rule(config), []
    for name, k in (("r1", 0), ("r2", 0), ("r1", 1)):
        found.store.add_submap(SUBMAPS[name][k])
        said.append(found.publish_newest(float("-inf"), 0))
        assert not found.publish_newest(float("-inf"), 0)
    maps = [of(out, ch.FUSED_MAP)[0] for out in said]
    assert [sum(each.sequence + 1 for each in fused.members) for fused in maps] == [1, 2, 3]
    assert all(fused.provisional for fused in maps)
    assert encoded(final(with_all(found))) == encoded(final(whole(config))), "it leaves no trace"


def test_no_map_has_less_than_the_one_before_it():
    found, maps = rule(CentralConfig(tick_s=3.0, broadcast_s=3.0)), []
    for k in range(5):
        found.store.add_submap(SUBMAPS["r1"][k])
        maps += of(found.publish_due(0.0, SUBMAPS["r1"][k].stamp_ns), ch.FUSED_MAP)
    assert [each.provisional for each in maps] == [True]
    ahead = {each.robot: each.sequence for each in maps[-1].members}
    for k in range(5):
        found.store.add_submap(SUBMAPS["r2"][k])
        end_ns = SUBMAPS["r2"][k].stamp_ns
        maps += of(found.publish_due(end_ns, END_NS + end_ns), ch.FUSED_MAP)
    assert ahead["r1"] > 0
    assert len(maps) > 3
    for before, after in pairwise(maps):
        now = {(each.robot, each.incarnation): each.sequence for each in after.members}
        assert all(now[each.robot, each.incarnation] >= each.sequence for each in before.members)
    assert not maps[-1].provisional
    withdrawal = build.withdrawal(stamp_ns=END_NS)
    found.withdraw(withdrawal)
    (last,) = of(found.publish_final(END_NS), ch.FINAL_MAP)
    assert {each.robot for each in last.members} == {"r2"}


def test_when_a_robot_stalls_there_is_a_provisional_map_also_without_a_closed_one():
    found = rule()
    out = []
    for submap in SUBMAPS["r1"]:
        found.store.add_submap(submap)
        out += of(found.publish_due(float("-inf"), submap.stamp_ns), ch.FUSED_MAP)
    assert not out, "not before three broadcasts would have been due"
    late_ns = SUBMAPS["r1"][0].stamp_ns + 18_000_000_000
    (fused,) = of(found.publish_due(float("-inf"), late_ns), ch.FUSED_MAP)
    assert fused.provisional
    assert fused.members == build.version(r1=4)
    assert found.publish_due(float("-inf"), late_ns + 1) == []
    assert found.publish_due(float("-inf"), 10 * late_ns) == [], "there is nothing new to say"
    assert encoded(final(with_all(found))) == encoded(final(whole())), "it leaves no trace"


def sequences(found, robot):
    return [each.sequence for each in found.store.messages_of(robot) if isinstance(each, m.Submap)]


def test_nobody_need_wait_for_what_was_refused_and_what_follows_it():
    found = rule()
    found.store.add_submap(SUBMAPS["r1"][0])
    torn = msgspec.structs.replace(SUBMAPS["r1"][1], first_measurement=0)
    assert "overlap" in found.store.add_submap(torn)
    assert found.store.acknowledged(("r1", 1)) == 2
    found.store.add_submap(SUBMAPS["r1"][2])
    assert found.store.acknowledged(("r1", 1)) == 3
    assert found.store.processed(("r1", 1)) == 3
    assert sequences(found, "r1") == [0]
    assert final(found).members == build.version(r1=0)
    assert found.store.add_submap(SUBMAPS["r1"][1]) is None, "the right one may still come"
    assert found.store.acknowledged(("r1", 1)) == 3
    assert sequences(found, "r1") == [0, 1, 2]


def test_the_final_map_comes_with_the_paths_and_its_cost():
    found = whole()
    out = found.publish_final(END_NS)
    fused = out[-1].message
    assert fused.final
    assert fused.joint
    assert fused.dof > 0
    assert found.fold.figures["joint_cost_per_dof"] == pytest.approx(
        fused.chi2 / fused.dof, rel=0.05
    )
    paths = {t.robot: translate.trajectory_of(t) for t in of(out, ch.TRAJECTORY)}
    assert sorted(paths) == ["r1", "r2"]
    for name, (stamps_ns, poses) in paths.items():
        assert stamps_ns.tolist() == [s.stamp_ns for s in SUBMAPS[name]]
        assert np.abs(poses[-1, :2] - STREAMS[name].truth[-1, :2]).max() < 2.0
    ids, means = translate.landmarks_of(fused)
    assert len(ids) >= 4
    assert np.isfinite(means).all()


def test_a_final_map_whose_covariances_are_too_small_names_that_cause_and_warns_of_no_other():
    right = final(whole())
    assert (right.reasons, right.diagnosis) == ((), ())
    tight = final(whole(msgspec.structs.replace(CONFIG, covariance_factor=0.02)))
    assert "noise_underestimated" in {each.cause for each in tight.diagnosis}
    assert not any("the covariances are too small" in words for words in tight.reasons)


HERE = np.zeros(3)
ROBOT = ("r1", 1)


def blocks(shift=0.0, variance=0.01, count=40, sigmas=0.0):
    ids = np.arange(count, dtype=np.uint32)
    means = np.column_stack([np.arange(count) * 1.0, np.zeros(count)])
    means[2, 1] += shift
    means[:, 0] += sigmas * np.sqrt(variance)
    return LandmarkBlocks(ids, means, np.tile(variance * np.eye(2), (count, 1, 1)))


def test_a_robot_that_comes_to_landmarks_that_it_was_not_told_is_told():
    sent_priors = SentPriors(30)
    sent_priors.is_worth(ROBOT, HERE, blocks())
    assert not sent_priors.is_worth(ROBOT, np.array([20.0, 0.0, 0.0]), blocks())
    assert sent_priors.is_worth(ROBOT, np.array([30.0, 0.0, 0.0]), blocks())


def test_a_withdrawal_that_is_revoked_and_decided_again_is_announced_twice(monkeypatch):
    found, convicted = rule(), dict[str, str]()
    monkeypatch.setattr(SubmapFold, "convicted", property(lambda _: dict(convicted)))
    said = []
    for reason in ({"r2": "it slips"}, {"r2": "it slips"}, {}, {"r2": "it slips again"}):
        convicted.clear()
        convicted.update(reason)
        told = of(found.publish_final(0), ch.WITHDRAWAL)
        said.append([(each.robot, each.reason) for each in told])
    assert said == [[("r2", "it slips")], [], [], [("r2", "it slips again")]]
    assert found.warnings == [
        "r2 withdrawn by central: it slips",
        "r2 is withdrawn no more: what came late speaks for it",
        "r2 withdrawn by central: it slips again",
    ]


# Landmarks that too few submaps have.


FALSE = 9  # the name of a landmark that is not there


def misread(submap, name=FALSE, **fields):
    seen = [*ids(submap.ids, "ids")[:-1], name]
    return msgspec.structs.replace(submap, ids=from_ids(seen), **fields)


def spoilt(*names, **options):
    """A rule that has all submaps; these have a misread landmark."""
    found = rule(CentralConfig(tick_s=3.0, broadcast_s=3.0, **options))
    for name, submaps in SUBMAPS.items():
        for k, submap in enumerate(submaps):
            found.store.add_submap(misread(submap) if (name, k) in names else submap)
    return found


def left_out(fused):
    return [text for text in fused.reasons if "left out" in text]


@pytest.mark.parametrize(("least", "stands"), [(1, True), (2, False)])
def test_what_one_submap_alone_has_stands_in_the_map_only_if_one_is_enough(least, stands):
    fused = final(spoilt(("r1", 3), landmark_submaps=least))
    assert (FALSE in ids(fused.ids, "ids")) == stands
    assert len(left_out(fused)) == (not stands)
    assert all(f"of 6 landmarks ({FALSE})" in text for text in left_out(fused))


def test_what_two_submaps_agree_on_enters_the_map_with_both():
    fused = final(spoilt(("r1", 3), ("r2", 3), landmark_submaps=2))
    assert FALSE in ids(fused.ids, "ids")
    assert left_out(fused) == []


def test_running_maps_and_priors_have_the_same_landmarks():
    found = spoilt(("r1", 3), landmark_submaps=2)
    out = found.publish_due(END_NS, END_NS)
    (fused,) = of(out, ch.FUSED_MAP)
    shown = ids(fused.ids, "ids").tolist()
    assert shown
    assert FALSE not in shown
    priors = of(out, ch.PRIOR)
    assert len(priors) == 2
    assert all(ids(each.ids, "ids").tolist() == shown for each in priors)


def test_what_one_submap_has_without_a_name_is_in_running_maps_and_not_in_the_final_one():
    found = rule(CentralConfig(tick_s=3.0, broadcast_s=3.0), ["r1"])
    for k, submap in enumerate(SUBMAPS["r1"]):
        seen_twice = {"counts": from_ids([2]), "seen": b"\1", "keyframes": 1}
        found.store.add_submap(misread(submap, UNNAMED, **seen_twice) if k == 2 else submap)
    (running,) = of(found.publish_due(END_NS, END_NS), ch.FUSED_MAP)
    last = final(found)
    tentative, kept = (int(ids(each.ids, "ids")[-1]) for each in (running, last))
    assert tentative >= UNNAMED > kept
    assert [text.startswith("left out, 2 submaps") for text in left_out(last)] == [True]
