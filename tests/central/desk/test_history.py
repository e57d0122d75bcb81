"""The history of a run: its figures equal those computed from the log."""

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.history import history
from teamslam.sim.in_memory.team import run_team
from teamslam.team import translate
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from teamslam.team.wire.bus import Outgoing, Sample, opened
from tests import build
from tests.sim.logs import final_map, joined_log, samples, scenario, streams
from tests.support import fused_map, submap

MS = 1_000_000


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


def measurement(k: int, wall_ms: int) -> Sample:
    (sample,) = samples(
        [
            Outgoing(
                ch.ODOMETRY,
                "r1",
                build.odometry(
                    stamp_ns=k * MS, incarnation=0, number=k, duration_ns=MS, forward=0.5
                ),
            )
        ]
    )
    return msgspec.structs.replace(sample, wall_ns=wall_ms * MS)


def at(outgoing: Outgoing, wall_ms: int) -> Sample:
    return msgspec.structs.replace(samples([outgoing])[0], wall_ns=wall_ms * MS)


def fused(stamp_ns: int, last: int, **fields: object) -> Outgoing:
    values = {
        "members": (m.VersionEntry(robot="r1", incarnation=0, sequence=last),),
        "reasons": (),
        "final": False,
    } | fields
    message = fused_map(
        stamp_ns=stamp_ns,
        frame="r1/0",
        final=values["final"],
        members=values["members"],
        ids=from_ids([1]),
        means=from_floats([0.0, 0.0]),
        covariance=from_floats([1.0, 0.0, 1.0]),
        chi2=3.0,
        dof=2,
        reasons=values["reasons"],
    )
    return Outgoing(ch.FUSED_MAP, "", message)


def test_latency_runs_from_a_measurements_publication_to_the_first_map_that_used_it():
    windows = [submap(k, "r1") for k in range(2)]  # of measurements 0-9 and 10-19
    log = [measurement(k, 100 + 10 * k) for k in range(20)]
    log += [at(Outgoing(ch.SUBMAP, "r1", w), 400) for w in windows]
    log += [at(fused(9, 0), 450), at(fused(10, 0), 700), at(fused(11, 1), 900)]
    found = history(log).latencies["r1"]
    np.testing.assert_allclose(found.last_s, [0.450 - 0.190, 0.900 - 0.290])
    np.testing.assert_allclose(found.first_s, [0.350, 0.700])


def test_without_truth_there_is_the_cost_and_no_nees():
    of = scenario()
    hidden = (ch.TRUTH.key("r1"), ch.TRUTH_LANDMARKS.key())
    blind = history([s for s in joined_log(of, 0.1) if s.key not in hidden])
    assert len(blind.map_nees.values) == 0
    assert blind.map_cost.values.tolist() == [1.5]
    assert final_map([1], np.zeros((1, 2)), np.eye(2)).message.dof == 20
