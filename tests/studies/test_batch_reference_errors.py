"""The batch with the profile's noise: factors of the declared density, persistent errors."""

from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from teamslam.sim.recorded.chains import Chain, Scan
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.studies.batch_reference.errors import (
    add_errors,
    bias_key,
    detections_of,
    profile_graph,
)
from teamslam.sim.studies.batch_reference.graph import values_of
from teamslam.sim.studies.batch_reference.reference import batch_map
from teamslam.team.config import BiasSigmas, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting
from teamslam.team.estimation.models import increment_of
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
