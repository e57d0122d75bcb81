from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.stats import chi2, kstest

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.paths import follow_way_points, move_pose
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import (
    OBSERVATIONS,
    ODOMETRY,
    SIGHTINGS,
    START,
    RobotStream,
    WorldStreams,
)
from teamslam.team.config import MotionModel, RobotConfig, Sensor
from tests.scenarios import with_world


def world_of(scenario: Scenario, seed: int = 1) -> WorldStreams:
    return simulate(scenario.world, scenario.robots, seed)


def content(stream: RobotStream) -> list[bytes]:
    seen, odometry = stream.landmark_detections, stream.intervals
    arrays = [odometry.forward, odometry.yaw_rate, seen.offsets, seen.ids, seen.ranges]
    assert stream.truth is not None
    return [array.tobytes() for array in (*arrays, seen.bearings, stream.truth)]


def true_detections(stream: RobotStream, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    seen = stream.landmark_detections
    step = np.repeat(np.arange(1, len(seen.offsets)), np.diff(seen.offsets))
    across = landmarks[seen.ids.astype(int) - 1] - stream.truth[step, :2]
    bearing = np.arctan2(across[:, 1], across[:, 0]) - stream.truth[step, 2]
    return np.hypot(*across.T), np.angle(np.exp(1j * bearing))


def inside_two_sided(normalised: np.ndarray) -> bool:
    low, high = chi2.ppf([0.0005, 0.9995], normalised.size)
    return bool(low < np.sum(normalised**2) < high)


def test_measurements_are_numbered_by_time_with_what_was_seen_before_the_interval_that_ends():
    stream = world_of(load("thesis")).streams[0]
    assert stream.kinds[0] == START
    assert np.all(np.diff(stream.stamps_ns) >= 0)
    order = [(int(s), int(k)) for s, k in zip(stream.stamps_ns, stream.kinds, strict=True)]
    assert order == sorted(order)
    assert np.count_nonzero(stream.kinds == ODOMETRY) == 500
    assert np.count_nonzero(stream.kinds == OBSERVATIONS) == 500, "empty messages too"


def test_the_thesis_world_is_the_one_that_the_figures_were_measured_in():
    world = world_of(load("thesis"))
    assert world.landmarks is not None
    first, second = world.streams
    assert np.allclose(first.truth[0, :2], [80.238, 39.645])
    assert np.allclose(first.truth[-1, :2], [70.003, 76.697])
    assert np.allclose(second.truth[0, :2], [10.238, 39.645])
    assert np.allclose(second.truth[-1, :2], [76.697, 70.003])
    steps = np.hypot(*np.diff(first.truth[:, :2], axis=0).T)
    assert np.allclose(np.median(steps), 496.26 / 500, atol=1e-4)
    assert len(first.landmark_detections.ids) / 500 == pytest.approx(2.9, abs=0.05)
    assert np.count_nonzero(first.kinds == SIGHTINGS) == 139


@pytest.mark.parametrize("name", ["thesis-b", "waypoints"])
def test_observations_differ_from_the_truth_by_the_noise_that_the_robot_is_told(name):
    ranges, bearings = [], []
    for seed in range(8):
        scenario = load(name)
        world = world_of(scenario, seed)
        for robot, stream in zip(scenario.robots, world.streams, strict=True):
            true_range, true_bearing = true_detections(stream, world.landmarks)
            sigma = np.hypot(robot.sensor.range_sigma, robot.sensor.range_sigma_per_m * true_range)
            seen = stream.landmark_detections
            ranges.append((seen.ranges - true_range) / sigma)
            apart = np.angle(np.exp(1j * (seen.bearings - true_bearing)))
            bearings.append(apart / robot.sensor.bearing_sigma)
    for noise in (np.concatenate(ranges), np.concatenate(bearings)):
        assert abs(noise.mean()) < 3.3 / np.sqrt(noise.size)
        assert inside_two_sided(noise)
        assert not inside_two_sided(1.1 * noise), "noise that is 10 % too large is found out"
        assert not inside_two_sided(0.9 * noise)


def test_sight_is_limited_by_the_true_range_so_that_the_noise_does_not_select():
    noise_far, kept_far = [], []
    for seed in range(8):
        world = world_of(load("thesis"), seed)
        for stream in world.streams:
            true_range, _ = true_detections(stream, world.landmarks)
            assert true_range.min() >= 3.0
            assert true_range.max() <= 20.0
            far = true_range > 18.0
            noise = (stream.landmark_detections.ranges - true_range)[far] / 2.0
            noise_far.append(noise)
            kept_far.append(noise[stream.landmark_detections.ranges[far] <= 20.0])
    noise, kept = np.concatenate(noise_far), np.concatenate(kept_far)
    assert abs(noise.mean()) < 3.3 / np.sqrt(noise.size)
    assert kept.mean() < -20.0 / np.sqrt(kept.size), "a gate on the measurements would bias them"


def test_a_robot_sees_its_teammates_where_they_are():
    scenario = load("thesis-b")
    world = world_of(scenario)
    first, second = world.streams
    met = first.teammate_detections
    step = (met.stamps_ns // 10**9).astype(int)
    across = second.truth[step, :2] - first.truth[step, :2]
    bearing = np.arctan2(across[:, 1], across[:, 0]) - first.truth[step, 2]
    range_noise = (met.ranges - np.hypot(*across.T)) / 0.2
    bearing_noise = np.angle(np.exp(1j * (met.bearings - bearing))) / np.deg2rad(2.0)
    assert inside_two_sided(range_noise)
    assert inside_two_sided(bearing_noise)


def test_a_sensor_is_simulated_with_its_calibration_and_field_of_view():
    sensor = Sensor(
        range_sigma=1e-9,
        bearing_sigma=1e-9,
        range_offset=0.3,
        range_scale=0.9,
        bearing_offset=0.2,
        field_of_view=np.pi,
        min_range=2.0,
        max_range=30.0,
    )
    world = SimulatedWorld(steps=50, landmark_count=200)
    streams = simulate(world, [RobotConfig(id="r1", sensor=sensor)], 3)
    true_range, true_bearing = true_detections(streams.streams[0], streams.landmarks)
    seen = streams.streams[0].landmark_detections
    assert len(seen.ids) > 100
    assert np.allclose((seen.ranges - 0.3) / 0.9, true_range, atol=1e-6)
    assert np.allclose(np.angle(np.exp(1j * (seen.bearings - 0.2 - true_bearing))), 0.0, atol=1e-6)
    assert np.abs(true_bearing).max() <= np.pi / 2
    assert true_range.min() >= 2.0
    assert 28.0 < true_range.max() <= 30.0


def test_the_same_seed_gives_the_same_bytes_and_another_seed_other_noise():
    first, again, other = (world_of(load("waypoints"), seed) for seed in (5, 5, 6))
    assert [content(s) for s in first.streams] == [content(s) for s in again.streams]
    assert content(first.streams[0])[0] != content(other.streams[0])[0]


@pytest.mark.parametrize("name", ["thesis", "waypoints"])
def test_a_further_robot_changes_nothing_of_the_others(name):
    scenario = load(name)
    count = len(scenario.robots)
    few = world_of(scenario).streams
    more = world_of(with_options(scenario, robots=count + 2)).streams
    for before, after in zip(few, more[:count], strict=True):
        assert content(before) == content(after)
        known = np.flatnonzero(after.teammate_detections.ids < count)
        assert np.array_equal(
            after.teammate_detections.ranges[known], before.teammate_detections.ranges
        )


@pytest.mark.parametrize(
    ("named", "unknown"),
    [((), ""), (("*",), "abc"), (("*", "!a"), "bc"), (("c", "a"), "ac"), (("*", "!a", "!b"), "c")],
)
def test_unknown_starts_are_named_or_all_or_all_but_some(named, unknown):
    robots = [RobotConfig(id=name) for name in "abc"]
    streams = simulate(SimulatedWorld(steps=5, unknown_starts=named), robots, 1).streams
    assert "".join(each.robot for each in streams if each.start is None) == unknown
    for each in streams:
        assert each.kinds[0] == START
        if each.start is not None:
            assert (each.start.pose == each.truth[0]).all()
            assert each.start.covariance is None


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=8, unique=True
    ),
    st.integers(1, 200),
)
def test_a_followed_path_is_driven_by_its_own_steps(path, steps):
    drive = follow_way_points(np.array(path), steps)
    pose = tuple(drive.poses[0].tolist())
    for k in range(steps):
        pose = move_pose(pose, tuple(drive.steps[k].tolist()), "turn-then-drive")
        assert np.allclose(pose[:2], drive.poses[k + 1, :2], atol=1e-9)
    assert np.allclose(drive.poses[-1, :2], path[-1])


def errors_by_landmark(sensor: Sensor) -> list[np.ndarray]:
    """Normalised (range, bearing) errors of a standing robot, a row per step, by landmark."""
    world = SimulatedWorld(steps=4000, step_s=0.5, landmark_count=12, paths=(((0, 0), (1e-9, 0)),))
    motion = MotionModel(kind="turn-then-drive")
    streams = simulate(world, [RobotConfig("r1", motion, sensor)], 5)
    stream = streams.streams[0]
    true_range, true_bearing = true_detections(stream, streams.landmarks)
    seen = stream.landmark_detections
    errors = np.column_stack(
        [
            (seen.ranges - true_range) / sensor.range_sigma,
            np.angle(np.exp(1j * (seen.bearings - true_bearing))) / sensor.bearing_sigma,
        ]
    )
    return [errors[seen.ids == i] for i in range(1, 13)]


def correlation(errors: list[np.ndarray], steps: int) -> np.ndarray:
    """Correlate each error with the one `steps` later, in units of the declared variance."""
    return np.mean([np.mean(e[:-steps] * e[steps:], axis=0) for e in errors], axis=0)


def test_errors_that_persist_have_the_declared_variance_share_and_time():
    sensor = Sensor(
        range_white=0.2, bearing_white=0.6, range_correlation_s=5.0, bearing_correlation_s=2.0
    )
    errors = errors_by_landmark(sensor)
    assert np.mean([np.var(e, axis=0) for e in errors], axis=0) == pytest.approx(1.0, abs=0.06)
    for steps in (1, 4, 10):
        after = 0.5 * steps
        expected = [0.8 * np.exp(-after / 5.0), 0.4 * np.exp(-after / 2.0)]
        assert correlation(errors, steps) == pytest.approx(expected, abs=0.05)
    apart = np.mean([a[:, 0] @ b[:, 0] / len(a) for a, b in pairwise(errors)])
    assert abs(apart) < 0.06, "each landmark has an error of its own"


def world_with(outlier_share: float, kind: str, name: str = "thesis-b") -> WorldStreams:
    scenario = load(name)
    return streams_of(with_world(scenario, outlier_share=outlier_share, outlier_kind=kind))


@pytest.fixture(scope="module")
def clean():
    return world_with(0.0, "measurement")


def joined(world: WorldStreams, field: str) -> np.ndarray:
    return np.concatenate([getattr(s.landmark_detections, field) for s in world.streams])


def test_three_in_ten_measurements_are_spoilt_the_same_ones_for_every_kind(clean):
    spoilt = world_with(0.3, "measurement")
    other = world_with(0.3, "identity")
    dropped = world_with(0.3, "drop")
    bad = joined(spoilt, "ranges") != joined(clean, "ranges")
    assert np.mean(bad) == pytest.approx(0.3, abs=3.3 * np.sqrt(0.21 / len(bad)))
    assert np.array_equal(joined(other, "ids") != joined(clean, "ids"), bad)
    for field in ("ids", "ranges", "bearings"):
        assert np.array_equal(joined(dropped, field), joined(clean, field)[~bad])
        assert np.array_equal(joined(spoilt, field)[~bad], joined(clean, field)[~bad])
    assert np.array_equal(joined(spoilt, "ids"), joined(clean, "ids"))
    assert np.array_equal(joined(other, "ranges"), joined(clean, "ranges"))


def test_what_is_spoilt_is_the_landmarks_measurements_alone(clean):
    for kind in ("measurement", "identity", "drop"):
        for before, after in zip(clean.streams, world_with(0.3, kind).streams, strict=True):
            assert np.array_equal(before.stamps_ns, after.stamps_ns), "no message is lost"
            assert np.array_equal(before.intervals.forward, after.intervals.forward)
            assert np.array_equal(
                before.teammate_detections.ranges, after.teammate_detections.ranges
            )
            assert np.array_equal(before.truth, after.truth)


def test_a_spoilt_measurement_is_uniform_over_what_can_be_seen(clean):
    spoilt = world_with(1.0, "measurement")
    assert kstest((joined(spoilt, "ranges") - 3.0) / 17.0, "uniform").pvalue > 1e-3
    assert kstest(joined(spoilt, "bearings") / (2.0 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert kstest((joined(clean, "ranges") - 3.0) / 17.0, "uniform").pvalue < 1e-3


def test_a_world_without_outliers_is_as_it_was_whatever_its_kind(clean):
    for before, after in zip(clean.streams, world_with(0.0, "drop").streams, strict=True):
        assert content(before) == content(after)
