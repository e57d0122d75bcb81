import math
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.desk.ledger import ledger
from teamslam.central.desk.verification.recorded import index_log
from teamslam.central.desk.verification.verification import verify
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.node import CentralNode
from teamslam.central.submap_fold import SubmapFold
from teamslam.central.tick_fold import TickFold
from teamslam.central.withdrawal import disagreement
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, with_options
from teamslam.sim.world.config import OutlierKind, SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.team import translate
from teamslam.team.config import CALIBRATED, FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.map_joining.joining import solve_fold
from teamslam.team.estimation.map_joining.marginals import (
    Agreement,
    SubmapCosts,
    joint_cost,
    landmark_map,
)
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import encoded
from tests import build
from tests.scenarios import with_front_ends, with_world
from tests.sim.reruns import written

SENSOR = Sensor(range_sigma=0.1, bearing_sigma=0.02)
MOTION = MotionModel(forward=MotionNoise(per_s=0.05), turn=MotionNoise(per_s=0.02))


def scenario(robots: int = 3, steps: int = 60, **central: object) -> Scenario:
    """A small world in which robots meet; submaps have one or two pose nodes.

    Self-calibration is off: it would explain wheels that are a third too large.
    """
    front = FrontEnd(particles=20, window_s=5.0, node_s=5.0, biases=())
    world = SimulatedWorld(
        steps=steps, size_m=25.0, landmark_count=15, visible_from_m=1.0, visible_to_m=10.0
    )
    team = tuple(RobotConfig(f"r{i + 1}", MOTION, SENSOR, front, pose_s=1e4) for i in range(robots))
    centre = CentralConfig(tick_s=10.0, broadcast_s=10.0, **central)
    return with_options(
        Scenario(name="small", team="small", world=world, robots=team, central=centre), seed=3
    )


def run(of: Scenario, wrong: str = "") -> list[Sample]:
    sensor = SENSOR
    if wrong == "bearing":
        sensor = msgspec.structs.replace(SENSOR, bearing_offset=0.3)
    if wrong == "range":
        sensor = msgspec.structs.replace(SENSOR, range_scale=1.25)
    robots = [msgspec.structs.replace(r, sensor=sensor) if r.id == "r3" else r for r in of.robots]
    streams = simulate(of.world, robots, of.seed)
    if wrong == "odometry":
        *others, last = streams.streams
        fast = replace(last.intervals, forward=1.3 * last.intervals.forward)
        streams = replace(streams, streams=(*others, replace(last, intervals=fast)))
    return list(run_team(of, streams))


@cache
def team_run(wrong: str = "") -> tuple[Sample, ...]:
    return tuple(run(scenario(), wrong))


def messages(samples: tuple[Sample, ...], kind: type[m.Message]) -> list[m.Message]:
    return [each for _, _, each in map(opened, samples) if isinstance(each, kind)]


def of_set(
    samples: tuple[Sample, ...],
    without: str = "",
    central: CentralConfig | None = None,
    instead: m.Submap | None = None,
    into: TickFold | None = None,
) -> TickFold:
    """The fold over a run's submaps; without: robot left out from the beginning.

    instead: a submap in place of the one of its name. into: the fold, else a new one.
    """
    ticks = into or TickFold(scenario().central if central is None else central)
    for start in messages(samples, m.InitialPose):
        ticks.add_start(translate.start_of(start))
    sightings = messages(samples, m.SightingFactor)
    for each in messages(samples, m.Submap):
        if each.robot != without:
            name = (each.robot, each.incarnation, each.sequence)
            own = [s for s in sightings if (s.robot, s.incarnation, s.sequence) == name]
            if instead and name == (instead.robot, instead.incarnation, instead.sequence):
                each = instead
            ticks.add_submap(each, bytes(8), [s for s in own if s.teammate != without])
    return ticks


def bits(ticks: TickFold) -> bytes:
    ticks.fold_until(math.inf)
    fold = solve_fold(ticks.fold, ticks.settings)
    found = landmark_map(fold)
    return b"".join(x.tobytes() for x in (fold.main.state, *found))


@pytest.mark.parametrize("when", ["before", "in the middle", "at the end"])
def test_the_fold_after_a_withdrawal_is_that_of_a_team_that_never_had_the_robot(when):
    samples = team_run()
    met = messages(samples, m.SightingFactor)
    assert any(s.robot == "r3" for s in met)
    assert any(s.teammate == "r3" for s in met)
    whole = TickFold(scenario().central)
    if when == "before":
        whole.withdraw_robot("r3")
    of_set(samples, into=whole)
    if when != "before":
        whole.fold_until(30e9 if when == "in the middle" else math.inf)
        whole.withdraw_robot("r3")
    assert whole.withdrawn == ("r3",)
    assert bits(whole) == bits(of_set(samples, without="r3"))
    assert bits(whole) != bits(of_set(samples))


def test_the_fold_without_a_robot_leaves_the_fold_with_it_as_it_was():
    samples = team_run()
    ticks = of_set(samples)
    ticks.fold_until(30e9)
    other = ticks.leave_out({"r3"}, 30e9)
    assert {c.robot for c in other.fold.contributions} == {"r1", "r2"}
    assert {c.robot for c in ticks.fold.contributions} == {"r1", "r2", "r3"}
    assert bits(ticks) == bits(of_set(samples))


def rule_with(samples: tuple[Sample, ...], *withdrawals: m.Withdrawal) -> MapPublisher:
    rule = MapPublisher(SubmapFold(scenario(withdraw_above=None).central, bytes(8)))
    for order in withdrawals:
        rule.withdraw(order)
    for kind in (m.InitialPose, m.SightingFactor, m.Submap):
        for message in messages(samples, kind):
            rule.store.add(message)
    return rule


def test_a_map_names_who_was_withdrawn_in_its_digest_too():
    samples = team_run()
    orders = [build.withdrawal(stamp_ns=k, robot="r3", reason=f"reason {k}") for k in range(2)]
    plain, once, twice = (rule_with(samples, *orders[:k]) for k in range(3))
    maps = [rule.publish_final(0)[-1].message for rule in (plain, once, twice)]
    assert [fused.withdrawn for fused in maps] == [(), ("r3",), ("r3",)]
    assert maps[1] == maps[2]
    assert maps[0].digest != maps[1].digest
    assert {member.robot for member in maps[1].members} == {"r1", "r2"}
    assert once.warnings == ["r3 withdrawn by operator: reason 0"]


@pytest.mark.parametrize("wrong", ["odometry", "bearing", "range"])
def test_a_robot_that_is_wrong_is_withdrawn_by_itself_and_exactly(wrong):
    samples = team_run(wrong)
    final = final_map(list(samples))
    assert final.withdrawn == ("r3",)
    (said,) = messages(samples, m.Withdrawal)
    assert not messages(samples, m.WithdrawalHeard), "no robot publishes another's order"
    assert (said.robot, said.by) == ("r3", "central")
    assert_map_without("r3", final, samples)


def assert_map_without(robot: str, final: m.FusedMap, samples: tuple[Sample, ...]) -> None:
    never = of_set(samples, without=robot)
    never.fold_until(math.inf)
    found = landmark_map(solve_fold(never.fold, never.settings))
    assert final.means == found.means.tobytes()
    assert final.covariance == translate.joint_bytes(found.covariance)


def test_a_robot_whose_wheels_are_a_third_too_large_stays_where_that_is_estimated():
    final = final_map(run(with_front_ends(scenario(), biases=CALIBRATED), "odometry"))
    assert final.withdrawn == ()
    (found,) = final.diagnosis
    assert (found.cause, found.robot) == ("odometry_scale", "r3")
    assert found.value[0] == pytest.approx(-0.25, abs=4.0 * found.sigma[0])


def test_no_number_of_robots_withdraws_a_robot_by_what_they_report():
    node = CentralNode(CentralConfig(), ["r1", "r2", "r3", "r4"])
    for robot in ("r1", "r2", "r3", "r4"):
        report = build.withdrawal_heard(robot=robot, withdrawn="r2", reason="it never was")
        assert node.handle(report) == []
    order = build.withdrawal(robot="r2", reason="a flat wheel")
    (repeated,) = node.handle(order)
    assert (repeated.key, repeated.message) == ("central/withdrawal/r2", order)


@cache
def one_closes_windows_often() -> list[m.Message]:
    """r3's wheels are wrong, and it has many submaps before the others have enough for a verdict.

    Initial poses, inter-robot measurements and submaps until UNTIL_S, by their stamps.
    """
    of = scenario()
    front = msgspec.structs.replace(of.robots[2].front_end, window_s=2.0, node_s=2.0)
    often = msgspec.structs.replace(of.robots[2], front_end=front)
    of = msgspec.structs.replace(of, robots=(*of.robots[:2], often))
    said = [
        opened(each)[2]
        for each in run(msgspec.structs.replace(of, central=OPERATOR), "odometry")
        if each.key.endswith(("/start", "/submap", "/sighting_factor"))
    ]
    known = [each for each in said if each.stamp_ns <= UNTIL_S * 10**9]
    return sorted(known, key=lambda each: (each.stamp_ns, isinstance(each, m.Submap)))


OPERATOR = CentralConfig(tick_s=10.0, broadcast_s=10.0, withdraw_above=None)
UNTIL_S = 40


def delivered(order: list[m.Message], watermarks: dict[int, float]) -> tuple[MapPublisher, bytes]:
    rule = MapPublisher(SubmapFold(CentralConfig(tick_s=5.0, broadcast_s=5.0), bytes(8)))
    for start in one_closes_windows_often():
        if isinstance(start, m.InitialPose):
            rule.store.add(start)
    out = []
    for k, message in enumerate(order):
        rule.store.add(message)
        if k in watermarks:
            out += rule.publish_due(1e9 * watermarks[k], round(1e9 * watermarks[k]))
    out += rule.publish_final(10**12)
    return rule, encoded(out[-1].message)


def test_who_is_withdrawn_depends_on_the_set_and_not_on_when_maps_were_sent():
    by_time = [each for each in one_closes_windows_often() if not isinstance(each, m.InitialPose)]
    ends = {k: each.stamp_ns * 1e-9 for k, each in enumerate(by_time)}
    at_once, expected = delivered(by_time, {})
    assert at_once.withdrawn == ("r3",)
    rng = np.random.default_rng(0)
    for _ in range(2):
        few = sorted(rng.choice(len(by_time), 6, replace=False).tolist())
        assert delivered(by_time, {k: ends[k] for k in few})[1] == expected
    last = {max(k for k, end in ends.items() if end <= 35.0): 35.0}
    assert delivered(by_time, last)[1] == expected
    # r2's submaps come long after the watermark: the fold without them is repeated.
    late = [each for each in by_time if each.robot == "r2"]
    early = [each for each in by_time if each.robot != "r2"]
    assert delivered([*early, *late], {len(early) - 1: 40.0})[1] == expected


def test_who_was_convicted_without_what_comes_late_is_acquitted():
    samples = team_run("odometry")
    ticks = of_set(samples)
    ticks.fold_until(math.inf)
    assert list(ticks.convicted) == ["r3"]
    again = next(each for each in messages(samples, m.Submap) if each.robot == "r3")
    sightings = messages(samples, m.SightingFactor)
    own = [each for each in sightings if (each.robot, each.sequence) == ("r3", again.sequence)]
    ticks.add_submap(again, bytes(8), own)
    assert (ticks.convicted, ticks.withdrawn) == ({}, ())
    ticks.fold_until(math.inf)
    assert list(ticks.convicted) == ["r3"]
    assert bits(ticks) == bits(of_set(samples, without="r3"))


def test_nobody_is_withdrawn_from_a_team_in_which_nobody_is_wrong():
    samples = team_run()
    assert final_map(list(samples)).withdrawn == ()
    assert messages(samples, m.Withdrawal) == []


def with_outliers(kind: OutlierKind, seed: int) -> Scenario:
    of = with_front_ends(scenario(landmark_submaps=2), particles=40)
    of = with_world(of, outlier_share=0.3, outlier_kind=kind)
    return msgspec.structs.replace(of, seed=seed)


@pytest.mark.parametrize("kind", ["measurement", "identity"])
def test_no_good_robot_is_withdrawn_for_the_outliers_among_its_measurements(kind):
    """None is a suspect either; by windows without rejection all would be (2000 and more)."""
    of = with_outliers(kind, 3)
    samples = tuple(run(of))
    assert final_map(list(samples)).withdrawn == ()
    ticks = of_set(samples, central=of.central)
    ticks.fold_until(math.inf)
    found = disagreement(joint_cost(solve_fold(ticks.fold, ticks.settings)))
    assert set(found) == {"r1", "r2", "r3"}, "each has submaps enough to be judged"
    assert max(found.values()) < 2.0


@pytest.mark.parametrize("kind", ["measurement", "identity"])
def test_a_robot_that_is_wrong_is_withdrawn_with_outliers_too(kind):
    assert final_map(run(with_outliers(kind, 3), "odometry")).withdrawn == ("r3",)


def test_a_log_with_a_withdrawal_is_computed_again_and_its_ledger_tells_of_it(tmp_path):
    log = written(tmp_path / "log.mcap", list(team_run("odometry")))
    result = verify(log)
    assert result.first is None, str(result.first)
    assert all(c.equal == c.messages for c in result.channels)
    found = ledger(index_log(log))
    assert found.offenders == ()
    assert found.withdrawn == ("r3",)
    held = found.totals("r3")["in a submap"]
    assert f"{held:,} of those in submaps are withdrawn with r3" in found.statement()


# --- the verdict ---


def agreement(**ratios: float) -> Agreement:
    rows = [
        (5.0 * ratio * (0.8 + 0.04 * k), 5.0, 1.0, 4.35)
        for ratio in ratios.values()
        for k in range(10)
    ]
    streams = tuple((robot, 0) for robot in ratios for _ in range(10))
    return Agreement(0.0, 1.0, {}, SubmapCosts(streams, np.array(rows).T))


def test_a_robot_with_few_submaps_is_judged_by_three_of_its_newest_four():
    bad, good = (agreement(a=ratio).submaps for ratio in (9.0, 1.0))

    def judged(first: SubmapCosts, last: SubmapCosts) -> float | None:
        return disagreement(Agreement(0.0, 1.0, {}, first.followed_by(last))).get("a")

    def of_last_four(k: int) -> float:
        return 9.0 * (0.8 + 0.04 * (k + 3))

    none = SubmapCosts()
    assert np.isclose(judged(none, bad.select(range(7))), of_last_four(1))
    assert judged(good.select(range(5)), bad.select((5, 6))) <= 1.0
    assert judged(bad.select(range(3)), good.select(range(4))) <= 1.0
    assert np.isclose(judged(none, bad.select(range(3))), 9.0 * 0.8)
    assert judged(bad.select((0,)), good.select((0, 1))) <= 1.0
    assert judged(none, bad.select((0,))) is None


def test_a_withdrawn_robots_pose_is_taken_back_and_all_of_it_is_recomputed(tmp_path):
    of = scenario()
    posing = tuple(msgspec.structs.replace(each, pose_s=0.0) for each in of.robots)
    samples = tuple(run(msgspec.structs.replace(of, robots=posing), "odometry"))
    final = final_map(list(samples))
    assert final.withdrawn == ("r3",)
    newest = {robot: poses_of(samples, robot)[-1] for robot in ("r1", "r2", "r3")}
    assert {name: each.in_team_frame for name, each in newest.items()} == {
        "r1": True, "r2": True, "r3": False,
    }  # fmt: skip
    assert {newest[name].frame for name in ("r1", "r2")} == {final.frame}
    result = verify(written(tmp_path / "log.mcap", samples))
    assert result.first is None, str(result.first)
    assert {c.channel for c in result.channels if c.equal} >= {"prior", "team_pose", "own_pose"}


def poses_of(samples: tuple[Sample, ...], robot: str) -> list[m.PoseEstimate]:
    found = [opened(sample) for sample in samples if sample.key == ch.TEAM_POSE.key(robot)]
    return [message for _, _, message in found if isinstance(message, m.PoseEstimate)]
