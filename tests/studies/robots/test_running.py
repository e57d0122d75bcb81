"""Robots that run an estimator over a stream, with and without landmark names."""

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.association import AssociationResult, association_result
from teamslam.central.desk.evaluation.log import collect_log
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.estimators import (
    dead_reckoning,
    ekf_slam,
    localisation,
    nearest_neighbour,
    plain_fastslam,
)
from teamslam.sim.studies.robots.estimator import (
    NOTHING_KNOWN,
    AbsorbsMaps,
    InitialPose,
    KnownMap,
    estimator_of,
)
from teamslam.sim.studies.robots.running import POSE_FLOOR
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.gaussian import NO_LANDMARKS, LandmarkGaussian
from teamslam.team.estimation.models import Increment, corrected, increment_of
from teamslam.team.estimation.odometry import OdometryInterval
from teamslam.team.estimation.randomness import generator
from teamslam.team.pairs import PAIRS, rules_for
from teamslam.team.robot.node import robot_node
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from tests.teams import LANDMARKS, LOCALISERS, config, driven, of, published, stream

STREAM = stream("r1", 12)
MEASUREMENTS = published(STREAM)
KNOWN = KnownMap(np.arange(1, len(LANDMARKS) + 1, dtype=np.uint32), LANDMARKS)
TOLD = m.KnownMap(stamp_ns=0, ids=from_ids(KNOWN.ids), positions=from_floats(KNOWN.landmarks))
ALL = sorted({estimator for estimator, _ in PAIRS})
WHOLE = sorted({"ekf-slam", "fastslam1", "fastslam2", *LOCALISERS})
UNKNOWN = InitialPose(None, None)
SPREAD = np.diag([0.2, 0.1, 0.02])


def of_name(estimator, **options):
    return config(estimator=estimator, fusion="alone", **options)


def fed(member, measurements=MEASUREMENTS):
    """Everything that is new, in order."""
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
    nothing = np.empty(0)
    if start is not None:
        still = Increment(np.zeros(3), start)
        none = np.empty(0, np.uint32)
        state = filter_step(state, still, robot.sensor, none, nothing, nothing, *more)
    told, seen = STREAM.intervals, STREAM.landmark_detections
    for k in range(len(told.end_ns)):
        step = told.duration_ns[k] * 1e-9, told.forward[k], told.yaw_rate[k]
        rows = seen.rows(k)
        measurements = corrected(robot.sensor, seen.ranges[rows], seen.bearings[rows])
        increment = increment_of(robot.motion, *map(float, step))
        state = filter_step(state, increment, robot.sensor, seen.ids[rows], *measurements, *more)
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


def test_an_uncertain_start_is_turned_into_the_axes_of_the_pose():
    """A start that is uncertain across the heading alone stays so, wherever it points."""
    turned = np.array([3.0, 1.0, np.pi / 2])
    initial = InitialPose(turned, np.diag([4.0, 1e-4, 1e-4]))
    member = estimator_of(of_name("ekf-slam"), 1, initial)
    np.testing.assert_allclose(
        member.own_pose().covariance, np.diag([4.0, 1e-4, 1e-4]) + POSE_FLOOR, atol=1e-12
    )


def test_a_map_is_said_once_per_window_and_at_the_end():
    member = estimator_of(of_name("ekf-slam"), 1)
    said = [each.map_ns for each in fed(member, MEASUREMENTS[:-2]) if each.map_ns is not None]
    assert said == [3_000_000_000, 6_000_000_000, 9_000_000_000]
    ended, _ = member.finish()
    assert ended.map_ns == 11_000_000_000
    assert member.finish()[0].map_ns is None, "the last map has been said"


@pytest.mark.parametrize("estimator", ALL)
def test_a_node_says_how_well_its_measurements_were_predicted(estimator):
    node = robot_node(config(estimator=estimator, fusion=rules_for(estimator)[-1]))
    said = of(node.handle(TOLD, 0) + driven(node, MEASUREMENTS), ch.INNOVATION)
    if estimator == "dead-reckoning":
        assert not said, "it predicts no measurements"
        return
    dof = sum(each.dof for each in said)
    squared = sum(each.squared for each in said)
    assert len({(each.incarnation, each.sequence) for each in said}) == len(said) >= 4
    figures = node.status().figures
    assert figures["nis_dof"] == dof
    assert figures["nis_per_dof"] == pytest.approx(squared / dof)
    seen = STREAM.landmark_detections.ids
    first = 0 if estimator == "localisation" else len(np.unique(seen))
    predicted = 2 * (len(seen) - first)
    if estimator == "hybrid":
        assert 0 < dof < predicted, "each window sees its landmarks for the first time"
    else:
        assert dof == predicted, "each but the first of a landmark"


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
    out = node.handle(TOLD, 0) + driven(node, MEASUREMENTS)
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


def test_localisation_waits_for_the_map_that_it_is_told():
    node = robot_node(of_name("localisation"))
    assert driven(node, MEASUREMENTS) == []
    out = node.handle(TOLD, 0)
    assert len(of(out, ch.OWN_POSE)) == 12
    assert len(of(out, ch.ROBOT_DONE)) == 1


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


def test_the_last_word_names_the_last_map():
    out = driven(robot_node(of_name("ekf-slam")), MEASUREMENTS[:-2])
    maps, (done,) = of(out, ch.OWN_MAP), of(out, ch.ROBOT_DONE)
    assert (done.incarnation, done.last_map) == (maps[-1].incarnation, maps[-1].sequence)
    assert [x.sequence for x in maps] == [3, 6, 9, 11]
    assert all(x.joint for x in maps)
    own = driven(robot_node(config()), MEASUREMENTS)
    assert of(own, ch.ROBOT_DONE)[0].last_map == -1, "under `join` nobody consumes own maps"


@pytest.mark.parametrize("estimator", ["ekf-slam", "dead-reckoning"])
def test_what_has_no_meaning_is_refused_with_the_estimators_name(estimator):
    member = estimator_of(of_name(estimator), 1)
    assert not isinstance(member, AbsorbsMaps)
    node = robot_node(of_name(estimator))
    (submap,) = of(driven(robot_node(config()), MEASUREMENTS), ch.SUBMAP)[:1]
    with pytest.raises(ValueError, match="no submaps to resume from"):
        node.resume(MEASUREMENTS[0], [submap])


def test_the_thesis_member_starts_where_it_is_told_and_replaces_what_it_absorbs():
    robot = config(estimator="hybrid-thesis", fusion="kalman-per-axis")
    member = estimator_of(robot, 1, InitialPose(np.array([1.0, 2.0, 0.5]), None))
    np.testing.assert_array_equal(member.own_pose().mean, [1.0, 2.0, 0.5])
    fed(member, MEASUREMENTS[1:])
    assert member.sequence == sum(isinstance(r, m.Observations) for r in MEASUREMENTS)
    before = member.own_map()
    assert len(before.ids) > 0
    told = LandmarkGaussian(before.ids[:1], np.array([[50.0, 60.0]]), 4.0 * np.eye(2))
    member.absorb(told)
    after = member.own_map()
    np.testing.assert_array_equal(after.means, [[50.0, 60.0], *before.means[1:]])
    np.testing.assert_array_equal(after.covariance[:2, :2], 4.0 * np.eye(2))


STEPS = 60


def scores(estimator: str, error: float) -> AssociationResult:
    """One robot of thesis-b, its sensor's errors `error` times as large."""
    scenario = with_options(
        load("thesis-b"),
        robots=1,
        seed=2,
        estimator=estimator,
        fusion="alone",
        identities="hidden",
    )
    (robot,) = scenario.robots
    sensor = msgspec.structs.replace(
        robot.sensor,
        range_sigma=error * robot.sensor.range_sigma,
        bearing_sigma=error * robot.sensor.bearing_sigma,
    )
    scenario = msgspec.structs.replace(
        scenario,
        world=msgspec.structs.replace(scenario.world, steps=STEPS),
        robots=(msgspec.structs.replace(robot, sensor=sensor),),
    )
    found = association_result(collect_log(run_team(scenario, streams_of(scenario))))
    assert found is not None
    return found


@pytest.mark.parametrize("estimator", ["ekf-slam", "fastslam1"])
def test_with_a_good_sensor_they_find_the_landmarks_and_with_a_poor_one_not(estimator):
    good, poor = scores(estimator, 1.0), scores(estimator, 20.0)
    assert good.pairs.precision == 1.0
    assert (good.pairs.recall or 0.0) > 0.9
    assert good.landmarks >= 4
    assert (poor.pairs.wrong_percent or 0.0) > 3.0


def test_the_nis_of_nearest_neighbour_is_of_the_landmarks_that_detections_were_taken_for():
    sensor = load("thesis").robots[0].sensor
    near, far = (10.0, 0.0), (10.0, np.pi / 2.0)
    state = nearest_neighbour.initial_state(np.zeros(3))
    rows = np.arange(2, dtype=np.uint32) + UNNAMED
    for first, second in ((near, far), (far, near)):  # the same two, in the other order
        ranges, bearings = np.array([first[0], second[0]]), np.array([first[1], second[1]])
        scan = (Increment.identity(), sensor, rows, ranges, bearings)
        found = nearest_neighbour.innovation(state, *scan)
        state = nearest_neighbour.filter_step(state, *scan)
    assert (found.dof, found.squared) == (4, pytest.approx(0.0, abs=1e-9))
