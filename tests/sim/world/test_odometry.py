import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario, load
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.measuring import (
    Visible,
    draw_covariances,
    measured_increments,
    measured_steering,
    with_errors,
)
from teamslam.sim.world.simulator import simulate
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.models import increment_of
from teamslam.team.estimation.se2 import compose, inverse, logarithm
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import messages as m
from tests.scenarios import final_only, with_world
from tests.teams import driven, published

SLIP = {"lateral": MotionNoise(per_s=0.004), "final_turn": MotionNoise(per_s=0.003)}
MODELS = {
    "alphas": MotionModel(alphas=(4e-4, 1e-4, 2e-4, 3e-3, 1e-4, 1e-3), **SLIP),
    "turn-then-drive": MotionModel(
        kind="turn-then-drive", forward=MotionNoise(0.02, 0.02), turn=MotionNoise(0.02, 0.01),
        **SLIP,
    ),
    "wheels": MotionModel(
        kind="differential-drive", wheel_base=0.5, left_wheel=0.004, right_wheel=0.012, **SLIP
    ),
    "calibrated": MotionModel(
        forward=MotionNoise(0.02, 0.01), turn=MotionNoise(0.02, 0.0, 0.01), forward_scale=1.1,
        yaw_scale=0.9, turn_drag=0.2, veer=-0.05, **SLIP,
    ),
}  # fmt: skip


def whitened(truth: MotionModel, filters: MotionModel) -> np.ndarray:
    """L⁻¹ log(mean⁻¹ ∘ true step), L Lᵀ the filter's covariance, of every step of a team."""
    world = SimulatedWorld(steps=1500, step_s=0.5, size_m=60.0, turn_rate_rad_s=0.8)
    errors = []
    for stream in simulate(world, [RobotConfig(id="r1", motion=truth)], 11).streams:
        steps = stream.intervals
        for k in range(len(steps.end_ns)):
            speed, yaw_rate = float(steps.forward[k]), float(steps.yaw_rate[k])
            increment = increment_of(filters, 0.5, speed, yaw_rate)
            moved = compose(inverse(stream.truth[k]), stream.truth[k + 1])
            error = logarithm(compose(inverse(increment.mean), moved))
            errors.append(np.linalg.solve(np.linalg.cholesky(increment.covariance), error))
    return np.array(errors)


def moments_agree(errors: np.ndarray) -> bool:
    """Test whitened errors for mean 0 and covariance 1: all nine entries within 99.9 %."""
    count = len(errors)
    mean = np.sqrt(count) * errors.mean(axis=0)
    second = errors.T @ errors / count - np.eye(3)
    spread = np.sqrt(count) * second / np.sqrt(np.where(np.eye(3) > 0, 2.0, 1.0))
    entries = np.concatenate([mean, spread[np.triu_indices(3)]])
    low, high = chi2.ppf([0.0005, 0.9995], 3 * count)
    return bool(np.all(np.abs(entries) < 4.0) and low < np.sum(errors**2) < high)


@pytest.mark.parametrize("name", MODELS)
def test_samples_of_simulated_odometry_have_the_filters_moments(name):
    assert moments_agree(whitened(MODELS[name], MODELS[name]))


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("alphas", {"alphas": (1e-4, 4e-4, 2e-4, 3e-3, 1e-4, 1e-3)}),
        ("alphas", {"alpha_interval_s": 0.8}),
        ("turn-then-drive", {"kind": "velocity"}),
        ("wheels", {"left_wheel": 0.012, "right_wheel": 0.004}),
        ("wheels", {"wheel_base": 0.6}),
        ("calibrated", {"turn_drag": 0.1}),
        ("calibrated", {"veer": 0.0}),
    ],
)
def test_a_filter_with_another_model_is_found_out(name, wrong):
    other = msgspec.structs.replace(MODELS[name], **wrong)
    assert not moments_agree(whitened(MODELS[name], other))


def mixed_team(**of_first: object) -> Scenario:
    sensors = (Sensor(), Sensor(range_sigma=0.3), Sensor(range_sigma_per_m=0.02))
    kinds = ("alphas", "turn-then-drive", "wheels")
    robots = tuple(
        RobotConfig(f"r{i}", MODELS[kind], sensor, FrontEnd(particles=60, window_s=8.0))
        for i, (kind, sensor) in enumerate(zip(kinds, sensors, strict=True), 1)
    )
    robots = (msgspec.structs.replace(robots[0], **of_first), *robots[1:])
    world = SimulatedWorld(
        steps=120, size_m=40.0, landmark_count=25, visible_from_m=1.0, visible_to_m=12.0
    )
    return msgspec.structs.replace(load("waypoints"), name="mixed", world=world, robots=robots)


def test_a_team_of_three_different_robots_has_one_consistent_map():
    scenario = mixed_team()
    world = streams_of(scenario)
    found = final_map(list(run_team(final_only(scenario), world)))
    ids = np.frombuffer(found.ids, "<u4")
    error = np.frombuffer(found.means).reshape(-1, 2) - world.landmarks[ids.astype(int) - 1]
    upper = np.frombuffer(found.covariance)
    P = np.zeros((2 * len(ids), 2 * len(ids)))
    P[np.triu_indices(len(P))] = upper
    P = P + P.T - np.diag(P.diagonal())
    nees = error.ravel() @ np.linalg.solve(P, error.ravel())
    low, high = chi2.ppf([0.0005, 0.9995], error.size)
    assert len(ids) >= 20
    assert low < nees < high
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.5


@pytest.mark.parametrize("offset_s", [0.25, -0.75, 3.0])
def test_a_clock_offset_that_the_robot_knows_changes_nothing_of_its_submaps(offset_s):
    exact, off = mixed_team(), mixed_team(clock_offset_s=offset_s)
    one, other = (submaps_of(each.robots[0], streams_of(each)) for each in (exact, off))
    assert len(one) == 15
    assert [(s.ids, s.mean, s.covariance) for s in one] == [
        (s.ids, s.mean, s.covariance) for s in other
    ]


def test_a_clock_offset_that_the_robot_does_not_know_is_found_out():
    off, ignorant = mixed_team(clock_offset_s=0.75), mixed_team()
    world = streams_of(off)
    good, bad = (final_map(list(run_team(final_only(each), world))) for each in (off, ignorant))
    assert max(map(cost_per_dof, (good, bad))) < 1.2
    assert (good.withdrawn, good.diagnosis, bad.withdrawn) == ((), (), ())
    (found,) = bad.diagnosis
    assert (found.cause, found.robot) == ("clock_offset", "r1")
    assert found.value[0] == pytest.approx(0.75, abs=2.0 * found.sigma[0])
    assert found.sigma[0] < 0.1


def submaps_of(robot: RobotConfig, world: WorldStreams) -> list[m.Submap]:
    sent = driven(RobotNode(robot), published(world.streams[0]))
    return [each.message for each in sent if isinstance(each.message, m.Submap)]


def cost_per_dof(of: m.FusedMap) -> float:
    return of.chi2 / of.dof


WORLD = SimulatedWorld(steps=30, size_m=20.0, landmark_count=8, turn_rate_rad_s=0.4)


NOISY = MotionModel(forward=MotionNoise(0.1), turn=MotionNoise(0.05), lateral=MotionNoise(0.04))


def rotation(pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def test_told_increments_err_by_what_they_claim():
    count = 4000
    rng = np.random.default_rng(1)
    poses = np.tile([[0.0, 0.0, 0.3], [0.8, 0.5, 0.9]], (count, 1))
    steps = np.tile([[0.9, 0.6]], (len(poses) - 1, 1))
    normals = rng.standard_normal((len(steps), 3))
    told, C = measured_increments(NOISY, poses, steps, np.ones(len(steps)), normals, 0.7)
    errors = []
    for k in range(0, len(steps), 2):
        rest = (
            np.linalg.inv(rotation(told[k]))
            @ np.linalg.inv(rotation(poses[k]))
            @ rotation(poses[k + 1])
        )
        errors.append([rest[0, 2], rest[1, 2], np.arctan2(rest[1, 0], rest[0, 0])])
    np.testing.assert_allclose(np.cov(np.array(errors).T), C[0], atol=6e-4)
    assert C[0, 1, 2] == pytest.approx(0.7 * 0.04 * 0.05)


@pytest.mark.parametrize("points", [False, True])
def test_measurements_err_by_the_covariances_that_come_with_them(points):
    rng = np.random.default_rng(2)
    count = 6000
    seen = Visible(*np.zeros((2, count), np.int64), np.full(count, 5.0), np.zeros(count))
    sensor = Sensor(range_sigma=0.2, bearing_sigma=0.03)
    of = draw_covariances(seen, sensor, (0.5, 2.0), rng.random((count, 3)), points=points)
    errors = with_errors(np.zeros((count, 2)), of, rng.standard_normal((count, 2)))
    full = of[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(full), errors)
    assert squared.mean() == pytest.approx(2.0, abs=0.1)
    assert np.abs(of[:, 1]).max() > 0.0


def test_a_car_that_circles_reads_the_angle_and_the_speed_of_its_circle():
    car = MotionModel("ackermann", wheel_base=2.0, wheel_offset=0.5, steering_offset=0.1)
    wheel, angle = measured_steering(car, np.array([2.0, 0.0]), np.array([0.2, 0.0]))
    radius = 10.0
    np.testing.assert_allclose(angle, [np.arctan(2.0 / radius) - 0.1, -0.1])
    np.testing.assert_allclose(wheel, [0.2 * (radius - 0.5), 0.0])


def test_forms_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="odometry_claims"):
        msgspec.structs.replace(WORLD, odometry_claims=True)
    with pytest.raises(ValueError, match="outliers"):
        msgspec.structs.replace(WORLD, landmark_form="points", outlier_share=0.1)
    steered = msgspec.structs.replace(WORLD, odometry="steering")
    with pytest.raises(ValueError, match="r1 needs motion"):
        simulate(steered, [RobotConfig("r1")], 1)


def streams(form: str, identities: str):
    scenario = load("waypoints")
    return streams_of(
        with_world(
            scenario,
            steps=60,
            landmark_form=form,
            landmark_claims=(0.5, 2.0),
            identities=identities,
        )
    ).streams


@pytest.mark.parametrize("form", ["ranges", "points"])
def test_hidden_detections_have_the_covariances_of_their_range_and_bearing(form):
    known, hidden = streams(form, "known")[0], streams(form, "hidden")[0]
    seen, unnamed = known.landmark_detections, hidden.landmark_detections
    assert len(unnamed.ranges) > 20
    np.testing.assert_allclose(unnamed.ranges, seen.ranges)
    rr, rb, bb = unnamed.covariances.T
    # A point's covariance, turned into the line of sight: along it, and across it by the range.
    if form == "ranges":
        np.testing.assert_array_equal(unnamed.covariances, seen.covariances)
        return
    c, s = np.cos(seen.bearings), np.sin(seen.bearings)
    xx, xy, yy = seen.covariances.T
    np.testing.assert_allclose(rr, c * c * xx + 2 * c * s * xy + s * s * yy, rtol=1e-9)
    across = s * s * xx - 2 * c * s * xy + c * c * yy
    np.testing.assert_allclose(bb, across / seen.ranges**2, rtol=1e-9)
    np.testing.assert_allclose(
        rb * seen.ranges, c * s * (yy - xx) + (c * c - s * s) * xy, atol=1e-9
    )
