import math
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pytest

from teamslam.central import tick_fold, withdrawal
from teamslam.central.desk.verification.verification import verify
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.submap_fold import SubmapFold
from teamslam.central.withdrawal import Trial, disagreement, hold_trial
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.world.simulator import simulate
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.estimation.map_joining.condensed import SubmapCosts
from teamslam.team.estimation.map_joining.joining import solve_fold
from teamslam.team.estimation.map_joining.marginals import Agreement, landmark_map
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_floats, stamps
from teamslam.team.wire.bus import Outgoing, Sample, opened
from tests.central.test_withdrawal import assert_map_without, messages, of_set, scenario, team_run
from tests.scenarios import scenario_in
from tests.sim.reruns import team_samples, written
from tests.trials.stress_world import StressWorld, write

LIES = ("still", "micrometre", "far", "modest", "swap")
"""It never moved; its landmarks lie 2 m off, or 100 km, with sigmas of 1 µm; 1 m off with 5 cm;
their names are exchanged."""
BEFORE = 3  # number of a liar's first submaps that are true


def lie(true: m.Submap, base: m.Submap, kind: str) -> m.Submap:
    poses = 1 + len(stamps(true.nodes, "nodes"))
    base_poses = 1 + len(stamps(base.nodes, "nodes"))
    points = floats(base.mean, "mean")[3 * base_poses :].copy()
    motion = floats(true.mean, "mean")[: 3 * poses].copy()
    variance = {"modest": 0.05**2, "swap": 1e-4}.get(kind, 1e-12)
    match kind:
        case "still":
            motion[:] = 0.0
        case "micrometre":
            points += 2.0
        case "far":
            points += 1e5
        case "modest":
            points += 1.0
        case "swap":
            points = points.reshape(-1, 2)[::-1].ravel()
    mean = np.concatenate((motion, points))
    return msgspec.structs.replace(
        true,
        ids=base.ids,
        mean=from_floats(mean),
        covariance=from_floats(variance * np.eye(len(mean))[np.triu_indices(len(mean))]),
        sightings=0,
    )


class Liar(RobotNode):
    kind = ""
    _base: m.Submap | None = None

    def begin(self) -> list[Outgoing]:
        return list(self._spoilt(super().begin()))

    def handle(self, message: m.Message) -> list[Outgoing]:
        return list(self._spoilt(super().handle(message)))

    def _spoilt(self, out: list[Outgoing]) -> Iterator[Outgoing]:
        for each in out:
            said = each.message
            is_late = getattr(said, "sequence", 0) >= BEFORE
            if isinstance(said, m.Submap) and is_late:
                assert self._base is not None
                yield each._replace(message=lie(said, self._base, self.kind))
            elif not (isinstance(said, m.SightingFactor) and is_late):
                self._base = said if isinstance(said, m.Submap) else self._base
                yield each


@cache
def run_with(liar: str, kind: str) -> tuple[Sample, ...]:
    def robot(config: RobotConfig, exchange: Exchange) -> RobotNode:
        node = (Liar if config.id == liar else RobotNode)(config, exchange)
        if isinstance(node, Liar):
            node.kind = kind
        return node

    of: Scenario = scenario()
    talking = tuple(msgspec.structs.replace(each, pose_s=0.0) for each in of.robots)
    of = msgspec.structs.replace(of, robots=talking)
    return tuple(run_team(of, simulate(of.world, of.robots, of.seed), robot))


def online_errors(samples: tuple[Sample, ...], *robots: str) -> np.ndarray:
    true: dict[tuple[str, int], np.ndarray] = {}
    for each in messages(samples, m.Truth):
        poses = floats(each.poses, "poses").reshape(-1, 3)
        true |= {
            (each.robot, stamp): pose
            for stamp, pose in zip(stamps(each.stamps, "stamps").tolist(), poses, strict=True)
        }
    found = []
    for channel, robot, each in map(opened, samples):
        at = true.get((robot, each.stamp_ns))
        if channel is ch.TEAM_POSE and robot in robots and each.in_team_frame and at is not None:
            found.append(np.hypot(*(floats(each.pose, "pose") - at)[:2]))
    return np.array(found)


@pytest.mark.parametrize(("liar", "kind"), [*(("r1", kind) for kind in LIES), ("r2", "modest")])
def test_a_liar_is_withdrawn_and_meanwhile_moves_nobody(liar, kind):
    samples = run_with(liar, kind)
    final = final_map(list(samples))
    assert final.withdrawn == (liar,)
    assert [each.robot for each in messages(samples, m.Withdrawal)] == [liar]
    assert_map_without(liar, final, samples)
    others = {"r1", "r2", "r3"} - {liar}
    errors = online_errors(samples, *others)
    assert len(errors) > 20
    assert errors.max() < online_errors(run_with("", ""), *others).max() + 1.0


def test_a_robot_with_few_submaps_is_suspended_and_tested_again():
    samples = run_with("r1", "still")
    ticks = of_set(samples)
    ticks.fold_until(30e9)
    assert list(ticks.suspended) == ["r1"]
    assert (list(ticks.convicted), ticks.withdrawn) == ([], ("r1",))
    assert {each.robot for each in ticks.fold.contributions} == {"r2", "r3"}
    for until_s in (35, 45, 60):
        ticks.fold_until(until_s * 1e9)
    at_once = of_set(samples)
    at_once.fold_until(60e9)
    assert (ticks.convicted, ticks.suspended) == (at_once.convicted, at_once.suspended)
    assert ticks.fold.main.state.tobytes() == at_once.fold.main.state.tobytes()
    assert list(ticks.convicted) == ["r1"]


@pytest.mark.parametrize("kind", ["micrometre", "swap"])
def test_a_robust_loss_does_not_hide_a_liar_with_few_submaps(kind):
    samples = run_with("r1", kind)
    ticks = of_set(samples, central=scenario().central)
    ticks.fold_until(30e9)
    assert list(ticks.suspended) == ["r1"]
    ticks.fold_until(math.inf)
    assert list(ticks.convicted) == ["r1"]
    assert final_map(list(samples)).withdrawn == ("r1",)


def test_a_trial_without_a_verdict_is_repeated_once_the_provisional_set_has_grown(monkeypatch):
    trials: list[float] = []

    def undecided(agreement: Agreement, *_: object) -> Trial:
        trials.append(agreement.dof)
        return Trial(undecided="r1, r2 contradict each other")

    samples = run_with("r1", "swap")
    monkeypatch.setattr(withdrawal, "hold_trial", undecided)
    early = tuple(each for each in samples if each.stamp_ns <= 30e9)
    ticks = of_set(early)
    first = ticks.fold_ahead()
    for _ in range(2):
        assert ticks.accuse(first) == {}
        assert len(trials) == 1
    for each in messages(samples, m.Submap):
        if each.stamp_ns > 30e9:
            ticks.add_submap(msgspec.structs.replace(each, sightings=0), bytes(8))
    assert ticks.accuse(ticks.fold_ahead()) == {}
    assert len(trials) == 2


def test_a_suspended_robot_that_comes_to_agree_is_in_the_map_again():
    """Three of its first submaps exchange landmark ids; the true ones outvote them."""
    samples = team_run()
    ticks = of_set(samples)
    for each in messages(samples, m.Submap):
        if each.robot == "r1" and 1 <= each.sequence <= 3:
            ticks.add_submap(lie(each, each, "swap"), bytes(8))
    ticks.fold_until(20e9)
    assert (list(ticks.suspended), ticks.withdrawn) == (["r1"], ("r1",))
    ticks.fold_until(40e9)
    assert (ticks.suspended, ticks.convicted, ticks.withdrawn) == ({}, {}, ())
    assert {each.robot for each in ticks.fold.contributions} == {"r1", "r2", "r3"}
    ticks.solve()
    assert ticks.withdrawn == ()


@pytest.mark.parametrize("until_s", [20.0, 30.0, math.inf])
def test_one_wrong_submap_costs_no_robot(until_s: float):
    samples = team_run()
    (wrong,) = (s for s in messages(samples, m.Submap) if (s.robot, s.sequence) == ("r1", 2))
    mean = floats(wrong.mean, "mean").copy()
    mean[0] += 0.8
    ticks = of_set(samples, instead=msgspec.structs.replace(wrong, mean=from_floats(mean)))
    ticks.fold_until(until_s * 1e9)
    assert ticks.withdrawn == ()
    true = of_set(samples)
    true.fold_until(until_s * 1e9)
    found, expected = (landmark_map(solve_fold(x.fold, x.settings)) for x in (ticks, true))
    assert np.abs(found.means - expected.means).max() < 0.3


def test_a_liar_ahead_of_the_watermark_is_not_in_the_provisional_map():
    """All submaps are there, but only the first tick and a half is closed."""
    samples = run_with("r1", "still")
    rule = MapPublisher(SubmapFold(scenario().central, bytes(8)))
    for kind in (m.InitialPose, m.SightingFactor, m.Submap):
        for message in messages(samples, kind):
            rule.store.add(message)
    out = rule.publish_due(15e9, 10**11)
    (fused,) = (each.message for each in out if isinstance(each.message, m.FusedMap))
    assert fused.provisional
    assert fused.withdrawn == ("r1",)
    assert {each.robot for each in fused.members} == {"r2", "r3"}
    assert [w for w in rule.fold.findings if w.startswith("r1 is left out of running maps")]
    assert not [each for each in out if isinstance(each.message, m.Withdrawal)]
    assert not rule._has_news(math.inf), "a map that leaves it out lacks nothing"


def test_two_robots_that_contradict_each_other_are_named_and_stay():
    small = {"r1": (50.0, 50.0), "r2": (50.0, 50.0), "r3": (50.0, 50.0)}
    quiet = Agreement(0.0, 1.0, small, SubmapCosts())
    loud = Agreement(0.0, 1.0, small | {"r1": (1e4, 50.0), "r2": (60.0, 50.0)}, SubmapCosts())

    def without(robots: Collection[str]) -> Agreement:
        left = quiet if {"r1", "r2"} & {*robots} else loud
        rest = {each: cost for each, cost in left.robots.items() if each not in robots}
        return Agreement(0.0, 1.0, rest, SubmapCosts())

    found = hold_trial(loud, 4.0, without)
    assert found.robot is None
    assert found.undecided.startswith("r1, r2 contradict each other: cost 200.0 per degree")


def test_a_robot_that_the_map_follows_is_found_though_only_others_disagree():
    def without(robots: Collection[str]) -> Agreement:
        liar_is_there = "r1" not in robots
        costs = {"r1": (1e-9, 50.0), "r2": (1e5 if liar_is_there else 50.0, 50.0)}
        costs["r3"] = (1e6 if liar_is_there else 50.0, 50.0)
        return Agreement(0.0, 1.0, {r: costs[r] for r in costs if r not in robots}, SubmapCosts())

    assert hold_trial(without(()), 4.0, without).robot == "r1"


def test_a_submap_that_claims_less_than_the_least_spread_is_raised_and_its_robot_named():
    lying = of_set(run_with("r1", "still"), central=scenario(withdraw_above=None).central)
    lying.fold_until(math.inf)
    count = sum(each.robot == "r1" for each in messages(team_run(), m.Submap))
    assert dict(lying.inputs.raised(lying.withdrawn)) == {"r1": count - BEFORE}
    for each in lying.fold.contributions:
        variances = np.linalg.eigvalsh(each.local.covariance)
        assert variances.min() >= 5e-5**2 * 0.99
    true = of_set(team_run())
    true.fold_until(math.inf)
    assert dict(true.inputs.raised(true.withdrawn)) == {}


# Robots apart from the others.


@cache
def mirrored_run(robot: str) -> tuple[Sample, ...]:
    with TemporaryDirectory() as place:
        world = StressWorld(seed=3, seconds=60.0, mirrored=(robot,) if robot else ())
        return tuple(team_samples(scenario_in(write(world, Path(place)))))


@pytest.mark.parametrize("wrong", ["r1", "r2", "r3"])
def test_nobodys_pose_is_harmed_by_a_mirrored_robot(wrong):
    """Its first submaps do not show it yet. r1 fixes the frame."""
    samples = mirrored_run(wrong)
    assert final_map(list(samples)).withdrawn == (wrong,)
    for robot in {"r1", "r2", "r3"} - {wrong}:
        errors = online_errors(samples, robot)
        assert len(errors) > 50
        assert errors.max() < online_errors(mirrored_run(""), robot).max() + 1.0


def test_robots_that_agree_are_in_each_others_priors_and_those_that_contradict_are_not():
    for robot, apart in (("", False), ("r2", True)):
        samples = mirrored_run(robot)
        ticks = of_set(samples)
        ticks.fold_until(10e9)
        folds = ticks.fold_apart(ticks.fold, ahead=False)
        assert bool(folds) == apart
        for name, fold in folds.items():
            assert {each.robot for each in fold.contributions} == {name}


def test_too_small_covariances_by_themselves_are_no_contradiction():
    ticks = of_set(team_run())
    for each in messages(team_run(), m.Submap):
        covariance = floats(each.covariance, "covariance") / 25.0
        ticks.add_submap(
            msgspec.structs.replace(each, covariance=covariance.tobytes(), sightings=0), bytes(8)
        )
    ticks.convicts = False
    ticks.fold_until(math.inf)
    assert min(disagreement(ticks.agreement(ticks.fold)).values()) > 8.0
    assert ticks.fold_apart(ticks.fold, ahead=False) == {}


def test_priors_of_robots_apart_are_recomputed_from_the_log(tmp_path):
    result = verify(written(tmp_path / "log.mcap", mirrored_run("r2")))
    assert result.first is None, str(result.first)
    assert {c.channel for c in result.channels if c.equal} >= {"prior", "final_map"}


def test_a_trial_continues_the_folds_of_earlier_ones(monkeypatch):
    """Folded ticks: at most those of the nominal run for each robot left out, each robot alone,
    and a restart with each of the few suspensions.
    """
    counts = []
    for robot in ("", "r2"):
        samples, ticks = mirrored_run(robot), []
        fold = tick_fold.fold_tick
        monkeypatch.setattr(
            tick_fold, "fold_tick", lambda *given, f=fold, n=ticks: n.append(1) or f(*given)
        )
        final = of_set(samples)
        final.fold_until(60e9)
        final.fold_apart(final.fold, ahead=False)
        counts.append(len(ticks))
        monkeypatch.undo()
    assert counts[1] <= 12 * counts[0]
