import math
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pytest

from teamslam.central import tick_fold
from teamslam.central.desk.verification.verification import verify
from teamslam.central.withdrawal import disagreement
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, stamps
from teamslam.team.wire.bus import Sample, opened
from tests.central.test_withdrawal import messages, of_set, team_run
from tests.scenarios import scenario_in
from tests.sim.reruns import written
from tests.trials.stress_world import StressWorld, write


@cache
def mirrored_run(robot: str) -> tuple[Sample, ...]:
    with TemporaryDirectory() as place:
        world = StressWorld(seed=3, seconds=60.0, mirrored=(robot,) if robot else ())
        of = scenario_in(write(world, Path(place) / "world"))
        return tuple(run_team(of, streams_of(of)))


def worst_error(samples: tuple[Sample, ...], robot: str) -> float:
    times, places = [], []
    for each in messages(samples, m.Truth):
        if each.robot == robot:
            times.append(stamps(each.stamps, "stamps"))
            places.append(floats(each.poses, "poses").reshape(-1, 3)[:, :2])
    when, where = np.concatenate(times), np.concatenate(places)
    errors = []
    for channel, _, each in map(opened, samples):
        if channel is ch.TEAM_POSE and each.robot == robot and each.in_team_frame:
            at = int(np.abs(when - each.stamp_ns).argmin())
            errors.append(math.hypot(*(floats(each.pose, "pose")[:2] - where[at])))
    assert len(errors) > 50
    return max(errors)


@pytest.mark.parametrize("wrong", ["r1", "r2", "r3"])
def test_nobodys_pose_is_harmed_by_a_mirrored_robot(wrong):
    """Its first submaps do not show it yet. r1 fixes the frame."""
    samples = mirrored_run(wrong)
    assert final_map(list(samples)).withdrawn == (wrong,)
    for robot in {"r1", "r2", "r3"} - {wrong}:
        assert worst_error(samples, robot) < worst_error(mirrored_run(""), robot) + 1.0


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
