import numpy as np
import pytest

from teamslam.central.desk.evaluation.history import history
from teamslam.sim.in_memory.team import run_team
from teamslam.team import translate
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import opened
from tests.sim.logs import final_map, joined_log, scenario, streams


@pytest.fixture(scope="module")
def log():
    of = scenario(robots=2)
    return list(run_team(of, streams(of)))


@pytest.fixture(scope="module")
def run(log):
    return history(log)


def test_nis_is_what_the_robots_said_of_their_windows(run, log):
    said = [opened(s)[2] for s in log if s.key == ch.INNOVATION.key("r1")]
    submaps = [opened(s)[2] for s in log if s.key == ch.SUBMAP.key("r1")]
    found = run.innovations["r1"]
    assert found.stamps_ns.tolist() == [s.stamp_ns for s in submaps]
    assert found.per_dof == sum(i.squared for i in said) / sum(i.dof for i in said)
    assert found.dof.sum() > 50
    resumed = history([*log, *(s for s in log if s.key == ch.INNOVATION.key("r1"))])
    assert resumed.innovations["r1"].per_dof == found.per_dof


def test_the_cost_and_the_nees_are_those_of_each_map(run, log):
    keys = (ch.FUSED_MAP.key(), ch.FINAL_MAP.key())
    maps = [opened(s)[2] for s in log if s.key in keys]
    assert len(run.map_cost.values) == len([x for x in maps if x.dof])
    assert run.map_cost.values[-1] == maps[-1].chi2 / maps[-1].dof
    ids, means = translate.landmarks_of(maps[-1])
    world = streams(scenario(robots=2))
    true = dict(zip(world.landmark_ids.tolist(), world.landmarks, strict=True))
    errors = [mean - true[i] for i, mean in zip(ids.tolist(), means, strict=True)]
    e, P = np.concatenate(errors), translate.landmark_covariance_of(maps[-1])
    assert maps[-1].joint
    assert run.map_nees.values[-1] == pytest.approx(e @ np.linalg.solve(P, e) / len(e))
    assert (np.diff(run.map_nees.stamps_ns) >= 0).all()


def test_without_truth_there_is_the_cost_and_no_nees():
    of = scenario()
    hidden = (ch.TRUTH.key("r1"), ch.TRUTH_LANDMARKS.key())
    blind = history([s for s in joined_log(of, 0.1) if s.key not in hidden])
    assert len(blind.map_nees.values) == 0
    assert blind.map_cost.values.tolist() == [1.5]
    assert final_map([1], np.zeros((1, 2)), np.eye(2)).message.dof == 20
