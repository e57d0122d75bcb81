import msgspec
import numpy as np
import pytest

from teamslam.sim.studies.estimators import dead_reckoning, ekf_slam, localisation, plain_fastslam
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.sim.studies.robots.filters import (
    NOTHING_KNOWN,
    InitialPose,
    KnownMap,
    estimator_of,
)
from teamslam.sim.studies.robots.running import POSE_FLOOR
from teamslam.team import translate
from teamslam.team.core import OdometryInterval
from teamslam.team.estimation.gaussian import NO_LANDMARKS
from teamslam.team.estimation.hybrid_slam.window import generator
from teamslam.team.estimation.models import Increment, corrected, increment_of
from teamslam.team.robot.node import robot_node
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from tests.teams import LANDMARKS, LOCALISERS, config, driven, of, published, stream

STREAM = stream("r1", 12)
MEASUREMENTS = published(STREAM)
KNOWN = KnownMap(np.arange(1, len(LANDMARKS) + 1, dtype=np.uint32), LANDMARKS)
TOLD = m.KnownMap(stamp_ns=0, ids=from_ids(KNOWN.ids), positions=from_floats(KNOWN.landmarks))
WHOLE = sorted({"ekf-slam", "fastslam1", "fastslam2", *LOCALISERS})
UNKNOWN = InitialPose(None, None)
SPREAD = np.diag([0.2, 0.1, 0.02])


def of_name(estimator, **options):
    return config(estimator=estimator, fusion="alone", **options)


def fed(member, measurements=MEASUREMENTS):
    driven = []
    for measurement in measurements:
        if isinstance(measurement, m.Observations):
            member.observe(measurement.stamp_ns, translate.scan_of(measurement))
        if isinstance(measurement, m.Odometry):
            interval = OdometryInterval(
                measurement.stamp_ns,
                measurement.duration_ns,
                measurement.forward,
                measurement.yaw_rate,
            )
            driven.append(member.drive(interval))
    return driven


def by_hand(estimator, robot, start=None):
    """(pose, landmarks) after the stream's keyframes; `start` is the pose's covariance."""
    drawn = generator(robot.seed, robot.id, 1, 0)
    front = robot.front_end
    initial_state, filter_step, of_pose, of_map, draws = {
        "dead-reckoning": (
            dead_reckoning.initial_state, dead_reckoning.filter_step, dead_reckoning.pose_gaussian,
            dead_reckoning.landmark_gaussian, False,
        ),
        "ekf-slam": (
            ekf_slam.initial_state, ekf_slam.filter_step, ekf_slam.pose_gaussian,
            ekf_slam.landmark_gaussian, False,
        ),
        "localisation": (
            lambda pose: localisation.initial_state(pose, front.particles, *KNOWN),
            localisation.filter_step, localisation.pose_gaussian, lambda _: NO_LANDMARKS, True,
        ),
        "fastslam1": plain(front, "fastslam1"),
        "fastslam2": plain(front, "fastslam2"),
    }[estimator]  # fmt: skip
    state, more = initial_state(np.zeros(3)), (drawn,) if draws else ()
    if start is not None:
        still = RobotStep(robot.id, Increment(np.zeros(3), start), robot.sensor)
        state = filter_step(state, still, *more)
    told, seen = STREAM.intervals, STREAM.landmark_detections
    for k in range(len(told.end_ns)):
        step = told.duration_ns[k] * 1e-9, told.forward[k], told.yaw_rate[k]
        rows = seen.rows(k)
        measurements = corrected(robot.sensor, seen.ranges[rows], seen.bearings[rows])
        increment = increment_of(robot.motion, *map(float, step))
        step = RobotStep(robot.id, increment, robot.sensor, seen.ids[rows], *measurements)
        state = filter_step(state, step, *more)
    return of_pose(state), of_map(state)


def plain(front, proposal):
    def initial_state(pose):
        return plain_fastslam.initial_state(pose, front.particles, proposal, front.resample_below)

    gaussians = plain_fastslam.pose_gaussian, plain_fastslam.landmark_gaussian
    return initial_state, plain_fastslam.filter_step, *gaussians, True


@pytest.mark.parametrize("start", [None, SPREAD], ids=["known start", "uncertain start"])
@pytest.mark.parametrize("estimator", WHOLE)
def test_a_member_gives_what_its_estimator_gives_on_the_streams_keyframes(estimator, start):
    robot = of_name(estimator)
    member = estimator_of(robot, 1, InitialPose(np.zeros(3), start), KNOWN)
    fed(member)
    pose, landmarks = by_hand(estimator, robot, start)
    mine = member.own_pose()
    np.testing.assert_allclose(mine.mean, pose.mean, atol=1e-12)
    np.testing.assert_allclose(mine.covariance, pose.covariance + POSE_FLOOR, atol=1e-12)
    own = member.own_map()
    np.testing.assert_array_equal(own.ids, landmarks.ids)
    np.testing.assert_allclose(own.means, landmarks.means, atol=1e-12)
    np.testing.assert_allclose(own.covariance, landmarks.covariance, atol=1e-12)


@pytest.mark.parametrize("keyframe_s", [0.0, 2.5])
def test_the_last_keyframe_is_used_at_the_end(keyframe_s):
    front = msgspec.structs.replace(config().front_end, keyframe_s=keyframe_s)
    member = estimator_of(of_name("ekf-slam", front_end=front), 1)
    fed(member, MEASUREMENTS[:-2])
    before = member.sequence
    ended, uncovered = member.finish()
    assert uncovered == 0
    assert member.sequence == before + (keyframe_s > 0)
    assert (ended.pose_ns is not None) == (keyframe_s > 0)


@pytest.mark.parametrize("estimator", LOCALISERS)
def test_who_only_localises_himself_says_no_map(estimator):
    node = robot_node(of_name(estimator))
    out = node.handle(TOLD) + driven(node, MEASUREMENTS)
    assert of(out, ch.OWN_POSE)
    assert not of(out, ch.OWN_MAP)
    (done,) = of(out, ch.ROBOT_DONE)
    assert done.last_map == -1


def test_dead_reckoning_has_a_pose_at_every_interval_and_rejects_landmarks():
    node = robot_node(of_name("dead-reckoning"))
    out = driven(node, MEASUREMENTS)
    assert [x.stamp_ns for x in of(out, ch.OWN_POSE)] == STREAM.intervals.end_ns.tolist()
    (done,) = of(out, ch.ROBOT_DONE)
    told = {entry.disposition: entry.measurements for entry in done.ledger}
    assert told["rejected: this estimator uses no landmarks"] == 12
    assert told["in the running pose"] == 12


def test_localisation_finds_itself_from_an_unknown_start():
    front = msgspec.structs.replace(config().front_end, particles=50_000)
    robot = of_name("localisation", front_end=front)
    member = estimator_of(robot, 1, UNKNOWN, KNOWN)
    fed(member)
    end = STREAM.truth[-1]
    assert np.hypot(*(member.own_pose().mean - end)[:2]) < 0.5
    blind = estimator_of(robot, 1, UNKNOWN, NOTHING_KNOWN)
    fed(blind)
    assert np.isfinite(blind.own_pose().mean).all(), "without a map it is dead reckoning"


@pytest.mark.parametrize("estimator", ["ekf-slam", "dead-reckoning"])
def test_what_has_no_meaning_is_refused_with_the_estimators_name(estimator):
    member = estimator_of(of_name(estimator), 1)
    with pytest.raises(TypeError, match=f"the estimator {estimator} absorbs no map"):
        member.absorb(NO_LANDMARKS)
    node = robot_node(of_name(estimator))
    (submap,) = of(driven(robot_node(config()), MEASUREMENTS), ch.SUBMAP)[:1]
    with pytest.raises(ValueError, match="no submaps to resume from"):
        node.resume(MEASUREMENTS[0], [submap])
