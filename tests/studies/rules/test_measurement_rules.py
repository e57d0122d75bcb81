from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.central.config import CentralConfig
from teamslam.central.node import make_centre
from teamslam.sim.studies.estimators import joint_fastslam
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.sim.studies.rules.measurement_rules import RESAMPLE_BELOW
from teamslam.team import translate
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.estimation.models import increment_of
from teamslam.team.wire import channels as ch
from teamslam.team.wire.arrays import floats
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.teams import config, published, stream

PARTICLES = 20
RULES = ["joint-fastslam", "batch"]
STREAMS = {"r1": stream("r1", 9), "r2": stream("r2", 7, y=1.0)}
CONFIGS = {name: config(name) for name in STREAMS}
MEASUREMENTS = {name: published(each) for name, each in STREAMS.items()}
LAST_WORDS = [build.done(robot=name, measurements=len(each)) for name, each in MEASUREMENTS.items()]


def announced(name):
    return announce_configuration(ch.robot_node(name), 0, 0, CONFIGS[name])


def end(measurements=MEASUREMENTS):
    return build.end(**{name: len(each) for name, each in measurements.items()})


def heard(fusion, messages, robots=("r1", "r2")):
    node = make_centre(CentralConfig(fusion=fusion, particles=PARTICLES, broadcast_s=4.0), robots)
    out: list[Outgoing] = []
    for message in messages:
        out += node.handle(message)
    return node, out


def everything(measurements=MEASUREMENTS):
    every = [x for name in measurements for x in (announced(name), *measurements[name])]
    return [*every, *LAST_WORDS, end(measurements)]


def said(out):
    return [(o.key, encoded(o.message)) for o in out]


@cache
def expected(fusion):
    return said(heard(fusion, everything())[1])


@pytest.mark.parametrize("fusion", RULES)
@settings(deadline=None, max_examples=15)
@given(st.permutations(range(len(everything()))), st.lists(st.integers(0, 20), max_size=5))
def test_any_order_of_arrival_and_duplicates_give_the_same_messages(fusion, order, again):
    messages = everything()
    _, out = heard(fusion, [messages[i] for i in [*order[:-1], *again, order[-1]]])
    assert sorted(said(out)) == sorted(expected(fusion))
    assert [x for x in said(out) if "robot" not in x[0]][-1] == expected(fusion)[-1]


def test_its_map_and_poses_are_those_of_algorithm_1_on_the_teams_keyframes():
    state = joint_fastslam.initial_state(
        {name: np.array([0.0, y, 0.0]) for name, y in (("r1", 0.0), ("r2", 1.0))},
        PARTICLES,
        "fastslam1",
        RESAMPLE_BELOW,
    )
    drawn = generator(1, "team", 0, 0)
    poses = {name: [] for name in STREAMS}
    for k in range(9):
        turns = []
        for name, each in STREAMS.items():
            told = each.intervals
            if k >= len(told.end_ns):
                continue
            rows = each.landmark_detections.rows(k)
            seen = (each.landmark_detections.ids, each.landmark_detections.ranges)
            step = told.duration_ns[k] * 1e-9, told.forward[k], told.yaw_rate[k]
            increment = increment_of(CONFIGS[name].motion, *map(float, step))
            looks = (*(x[rows] for x in seen), each.landmark_detections.bearings[rows])
            turns.append(RobotStep(name, increment, CONFIGS[name].sensor, *looks))
        state = joint_fastslam.filter_step(state, turns, drawn)
        for turn in turns:
            poses[turn.robot].append(joint_fastslam.pose_gaussian(state, turn.robot).mean)
    node, out = heard("joint-fastslam", everything())
    ids, means = translate.landmarks_of(node.final)
    expected = joint_fastslam.landmark_gaussian(state)
    np.testing.assert_array_equal(ids, expected.ids)
    np.testing.assert_array_equal(means, expected.means)
    covariance = translate.landmark_covariance_of(node.final)
    np.testing.assert_allclose(covariance, expected.covariance, rtol=1e-12)
    for name in STREAMS:
        mine = [floats(o.message.pose, "pose") for o in out if o.key == ch.CENTRAL_POSE.key(name)]
        np.testing.assert_array_equal(mine, poses[name])


@pytest.mark.parametrize("fusion", RULES)
def test_missing_measurements_are_asked_for(fusion):
    node, _ = heard(fusion, (x for x in everything() if x not in MEASUREMENTS["r1"][4:6]))
    assert node.requests() == [
        build.measurements_request(stamp_ns=node.status().stamp_ns, first=4, last=5)
    ]
    for measurement in MEASUREMENTS["r1"][4:6]:
        node.handle(measurement)
    assert node.finished
    assert node.requests() == []


@pytest.mark.parametrize("fusion", RULES)
def test_a_robot_at_an_unknown_start_is_left_out_and_named(fusion):
    free = {"r1": MEASUREMENTS["r1"], "r2": published(stream("r2", 7, y=1.0, known=False))}
    node, out = heard(fusion, everything(free))
    assert node.final.reasons == ("r2: its start pose is not known",)
    assert [x.robot for x in node.final.members] == ["r1"]
    assert not [o for o in out if o.key == ch.CENTRAL_POSE.key("r2")]
    both = {name: published(stream(name, 7, known=False)) for name in STREAMS}
    node, _ = heard(fusion, everything(both))
    assert node.final.frame == "r1/1"
    assert node.final.reasons == ("r2: its start pose is not known",)
