"""The batch with the profile's noise: factors of the declared density, persistent errors."""

from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from teamslam.sim.recorded.chains import Chain, Scan, chains_of
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.studies.batch_reference.errors import (
    add_errors,
    bias_key,
    detections_of,
    profile_graph,
)
from teamslam.sim.studies.batch_reference.graph import pose_key, values_of
from teamslam.sim.studies.batch_reference.reference import batch_map
from teamslam.team.config import BiasSigmas, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting
from teamslam.team.estimation.models import increment_of, noise, predicted
from teamslam.team.estimation.se2 import Pose
from tests.sim.logs import joined_log, scenario

LANDMARKS = {7: np.array([4.0, 1.0]), 9: np.array([2.0, -3.0])}
LASTING = Sensor(
    range_sigma=0.1,
    range_sigma_per_m=0.05,
    bearing_sigma=0.02,
    range_white=0.2,
    bearing_white=0.4,
    range_correlation_s=3.0,
    bearing_correlation_s=5.0,
)


def standing(sensor: Sensor, robot: str = "r1", start: Pose | None = None) -> Chain:
    """Poses 1 s apart; landmark 7 is seen from three of them and landmark 9 from one."""
    config = RobotConfig(robot, MotionModel(forward=MotionNoise(per_s=0.1)), sensor)
    config = msgspec.structs.replace(
        config,
        front_end=msgspec.structs.replace(config.front_end, biases=("bearing", "range_scale")),
    )
    step = increment_of(config.motion, 1.0, 0.0, 0.0)
    seen = [[7], [7, 9], [7]]
    scans = [
        Scan(
            np.array(ids, np.uint32),
            np.array([4.2, 3.5][: len(ids)]),
            np.array([0.26, -0.96][: len(ids)]),
        )
        for ids in seen
    ]
    stamps = np.arange(4) * 10**9
    return Chain(
        config=config,
        incarnation=1,
        start=np.zeros(3) if start is None else start,
        start_covariance=None,
        stamps_ns=stamps,
        increments=(step,) * 3,
        scans=tuple(scans),
    )


def marginal_cost(chain: Chain, shares: tuple[float, float]) -> float:
    """rᵀ(C + H B Hᵀ)⁻¹r of all measurements at once, by the definition of the process."""
    looks = detections_of([chain])
    times = 1e-9 * chain.stamps_ns[[look.pose for look in looks]]
    same = np.equal.outer([look.landmark for look in looks], [look.landmark for look in looks])
    gaps = np.abs(np.subtract.outer(times, times))
    s = chain.config.sensor
    residuals, variances, shifts = [], [], []
    for look in looks:
        distance, bearing = predicted(np.zeros(3), LANDMARKS[look.landmark])
        residuals.append((bearing - look.bearing, distance - look.distance))
        range_var, bearing_var = noise(s, distance)
        variances.append((bearing_var, range_var))
        shifts.append((1.0, distance))
    r, v, h = np.array(residuals), np.array(variances), np.array(shifts)
    total = 0.0
    for k, (white, tau, sigma) in enumerate(
        zip(
            shares,
            (s.bearing_correlation_s, s.range_correlation_s),
            (BiasSigmas().bearing, BiasSigmas().range_scale),
            strict=True,
        )
    ):
        lasting = same * np.exp(-gaps / tau) * (1.0 - white) + white * np.eye(len(r))
        C = np.sqrt(np.outer(v[:, k], v[:, k])) * lasting + sigma**2 * np.outer(h[:, k], h[:, k])
        total += float(r[:, k] @ np.linalg.solve(C, r[:, k]))
    return total


def held_cost(chain: Chain) -> float:
    """The least cost over error states and biases with the poses and landmarks held at theirs."""
    poses = [np.zeros((4, 3))]
    graph = profile_graph(gtsam, [chain], poses, LANDMARKS, None, BiasSigmas())
    exact = gtsam.noiseModel.Isotropic
    for i in range(4):
        graph.push_back(gtsam.PriorFactorPose2(pose_key(0, i), gtsam.Pose2(), exact.Sigma(3, 1e-7)))
    for key, at in LANDMARKS.items():
        graph.push_back(gtsam.PriorFactorPoint2(key, at, exact.Sigma(2, 1e-7)))
    values = add_errors(gtsam, values_of(gtsam, poses, LANDMARKS), [chain])
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return 2.0 * float(graph.error(optimum))


@pytest.mark.parametrize("mutant", [False, True], ids=["as declared", "mutant: all white"])
def test_the_error_states_eliminated_are_the_processes_covariance(mutant):
    shares = (1.0, 1.0) if mutant else (LASTING.bearing_white, LASTING.range_white)
    same = held_cost(standing(LASTING)) == pytest.approx(
        marginal_cost(standing(LASTING), shares), rel=1e-4
    )
    assert same == (not mutant)


def mounted(chain: Chain, mount: tuple[float, float, float]) -> Chain:
    sensor = msgspec.structs.replace(chain.config.sensor, mount=mount)
    return replace(chain, config=msgspec.structs.replace(chain.config, sensor=sensor))


def test_the_derivatives_are_those_of_the_residuals():
    chain = standing(LASTING)
    poses = [np.array([[0.1 * i, 0.2, 0.3 * i] for i in range(4)])]
    graph = profile_graph(gtsam, [chain], poses, LANDMARKS, None, BiasSigmas())
    values = add_errors(gtsam, values_of(gtsam, poses, LANDMARKS), [chain])
    values.update(bias_key(0), np.array([0.02, 0.01, 0.03]))
    for look in detections_of([chain]):
        values.update(look.key, np.array([0.7, -0.4]))
    linear = graph.linearize(values)
    step = linear.optimize()
    slope = 2.0 * linear.gradientAtZero().dot(step)
    h = 1e-5
    ahead = graph.error(values.retract(step.scale(h)))
    behind = graph.error(values.retract(step.scale(-h)))
    assert (ahead - behind) / h == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.5, -0.2, 0.3)])
def test_a_sighting_ties_the_bases_poses_of_one_time(mount):
    there = np.array([3.0, 4.0, 1.0])
    seen = NodeSighting(
        2 * 10**9, "r2", np.array([5.5, 0.9]), np.array([[0.04, 0.001], [0.001, 0.01]]), (1,)
    )
    chains = [
        replace(standing(LASTING), sightings=(seen,)),
        standing(LASTING, "r2", there),
    ]
    chains = [mounted(chain, mount) for chain in chains]
    poses = [chain.of_sensor(np.tile(base, (4, 1))) for chain, base in
             zip(chains, (np.zeros(3), there), strict=True)]  # fmt: skip
    values = add_errors(gtsam, values_of(gtsam, poses, LANDMARKS), chains)
    costs = []
    for team in (chains, [replace(chains[0], sightings=()), chains[1]]):
        graph = profile_graph(gtsam, team, poses, LANDMARKS, None, BiasSigmas())
        costs.append(2.0 * graph.error(values))
    r = np.array([5.0 - 5.5, np.arctan2(4.0, 3.0) - 0.9])
    assert costs[0] - costs[1] == pytest.approx(r @ np.linalg.solve(seen.covariance, r), rel=1e-6)


def lasting_scenario(seed: int) -> Scenario:
    """The small world with errors that persist for longer than its robots look."""
    of = scenario(seed)
    sensor = msgspec.structs.replace(
        of.robots[0].sensor,
        range_white=0.1,
        bearing_white=0.1,
        range_correlation_s=10.0,
        bearing_correlation_s=10.0,
    )
    robots = tuple(msgspec.structs.replace(robot, sensor=sensor) for robot in of.robots)
    world = msgspec.structs.replace(of.world, steps=8)
    return msgspec.structs.replace(of, robots=robots, world=world)


@pytest.mark.parametrize("kind", ["profile", "white"], ids=["profile", "mutant: white"])
def test_the_map_is_consistent_where_errors_last_and_not_if_they_are_taken_as_white(kind):
    """The mutant is found among fewer runs."""
    runs = [
        batch_map(joined_log(lasting_scenario(seed), 0.02), kind)
        for seed in range(100, 130 if kind == "white" else 180)
    ]
    errors = [run.errors for run in runs if run.errors is not None]
    dof = sum(2 * e.count for e in errors)
    total = sum(e.nees_per_dof * 2 * e.count for e in errors)
    inside = chi2.ppf(0.0005, dof) <= total <= chi2.ppf(0.9995, dof)
    assert inside == (kind == "profile"), f"NEES/dof {total / dof:.3f} over {dof}"


def test_the_figures_name_the_noise_and_stand_beside_the_teams():
    figures = batch_map(joined_log(scenario(), 1.0), "profile").to_json()
    assert figures["noise"] == "profile"
    assert figures["landmark_rmse_m"] < figures["team"]["landmark_rmse_m"]


def test_the_chains_have_poses_at_the_grids_times_if_sightings_are_asked_for():
    of = scenario()
    robots = tuple(
        msgspec.structs.replace(
            robot, front_end=msgspec.structs.replace(robot.front_end, node_s=2.5)
        )
        for robot in of.robots
    )
    of = msgspec.structs.replace(of, robots=robots)
    log = joined_log(of, 0.1)
    plain, tied = chains_of(log, of)[0], chains_of(log, of, sightings=True)[0]
    added = set(tied.stamps_ns.tolist()) - set(plain.stamps_ns.tolist())
    assert added
    assert all(stamp % 2_500_000_000 == 0 for stamp in added)
    seen = [np.concatenate([s.ranges for s in chain.scans]) for chain in (plain, tied)]
    np.testing.assert_array_equal(seen[0], seen[1])
