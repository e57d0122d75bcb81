from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.verification.verification import verify
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team import translate
from teamslam.team.config import MotionModel, MotionNoise
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, opened
from tests.scenarios import with_front_ends, with_robots, with_world
from tests.sim.reruns import written

MOUNT = (0.8, -0.3, 0.2)
MOTION = MotionModel(
    forward=MotionNoise(0.02), turn=MotionNoise(0.002), lateral=MotionNoise(0.01)
)  # fmt: skip


def scenario(estimator: str = "hybrid", fusion: str = "join", **world: object) -> Scenario:
    base = with_options(load("thesis-b"), estimator=estimator, fusion=fusion)
    forms = {"odometry": "increments", "odometry_claims": True, "landmark_form": "points",
             "landmark_claims": (0.5, 2.0), "steps": 40} | world  # fmt: skip
    sensor = msgspec.structs.replace(base.robots[0].sensor, mount=MOUNT)
    base = with_robots(with_world(base, **forms), pose_s=10.0, sensor=sensor, motion=MOTION)
    return with_front_ends(base, particles=60)


@cache
def run(of: Scenario) -> list[Sample]:
    return list(run_team(of, streams_of(of)))


def rmse(of: Scenario, samples: list[Sample]) -> float:
    truth = streams_of(of)
    ids, means = translate.landmarks_of(final_map(samples))
    error = means - truth.landmarks[ids.astype(np.int64) - 1]
    return float(np.sqrt((error**2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("estimator", "fusion"), [("hybrid", "join"), ("hybrid", "batch"), ("fastslam2", "alone")]
)
def test_a_team_of_mounted_sensors_that_claim_is_mapped(estimator, fusion):
    of = scenario(estimator, fusion)
    samples = run(of)
    if fusion != "alone":
        assert rmse(of, samples) < 0.5
    poses = [x for x in (opened(s)[2] for s in samples) if isinstance(x, m.PoseEstimate)]
    truth = {s.robot: (s.truth_ns, s.truth) for s in streams_of(of).streams}
    last = {p.robot: p for p in poses}
    for robot, pose in last.items():
        stamps, path = truth[robot]
        assert stamps is not None
        there = path[int(np.searchsorted(stamps, pose.stamp_ns))]
        here = np.frombuffer(pose.pose, "<f8")
        assert np.hypot(*(here - there)[:2]) < 0.6, "the base's pose, not the sensor's"


def test_what_they_said_is_computed_again_to_the_last_bit(tmp_path):
    of = scenario()
    assert verify(written(tmp_path / "log.mcap", run(of))).first is None
