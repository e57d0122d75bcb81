from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.results import MapResult
from teamslam.central.monitor import miscalibrations
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, with_options
from teamslam.sim.world.config import SimulatedWorld
from teamslam.sim.world.simulator import simulate
from teamslam.team.config import Bias, FrontEnd, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.estimation.map_joining.marginals import BiasEstimate
from tests.scenarios import final_only

SPEED = 0.25  # [m/s]; the models below were calibrated at up to 0.09


def fast_team(biases: tuple[Bias, ...]) -> Scenario:
    motion = MotionModel(
        forward=MotionNoise(per_m=0.01),
        turn=MotionNoise(per_m=0.02, per_rad=0.02),
        calibrated_speed=(0.0, 0.09),
    )
    sensor = Sensor(range_sigma=0.05, bearing_sigma=0.02)
    front_end = FrontEnd(particles=30, window_s=10.0, biases=biases)
    world = SimulatedWorld(
        steps=160,
        size_m=12.0,
        landmark_count=15,
        speed_m_s=SPEED,
        visible_from_m=0.5,
        visible_to_m=6.0,
    )
    robots = tuple(RobotConfig(f"r{i}", motion, sensor, front_end) for i in (1, 2, 3))
    return with_options(Scenario(name="fast", team="fast", world=world, robots=robots), seed=3)


@dataclass(frozen=True)
class Run:
    map: MapResult
    scale: float


def joined(biases: tuple[Bias, ...], true_scale: float) -> Run:
    """The team's map, and its size over the true one, where each true path is so much longer."""
    told = fast_team(biases)
    truly = tuple(
        msgspec.structs.replace(
            robot, motion=msgspec.structs.replace(robot.motion, forward_scale=true_scale)
        )
        for robot in told.robots
    )
    fused = evaluate(run_team(final_only(told), simulate(told.world, truly, 11))).map
    a, b = (of - of.mean(axis=0) for of in (fused.means, fused.truth))
    along, across = np.sum(a * b), np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return Run(fused, float(np.hypot(along, across) / np.sum(b * b)))


def test_an_odometry_that_is_5_percent_off_at_unseen_speeds_spoils_the_map_and_is_told():
    run = joined(("range_scale",), 1.05)
    assert run.scale < 0.985
    assert any(
        "not calibrated, covariance not valid" in words and "+" in words
        for words in run.map.reasons
    )


def test_the_scale_of_unseen_speeds_is_estimated_from_the_ranges():
    run = joined(("forward_scale", "range_scale"), 1.05)
    assert run.scale == pytest.approx(1.0, abs=0.008)
    assert run.map.errors.in_band
    told = [each for each in run.map.diagnosis if each.cause == "odometry_scale"]
    assert len({each.robot for each in told}) == len(told) == 3
    assert all(each.value[0] > 0.0 for each in told)
    assert not any("not valid" in words for words in run.map.reasons)


def test_models_that_fit_give_no_alarm():
    run = joined(("range_scale",), 1.0)
    assert run.scale == pytest.approx(1.0, abs=0.008)
    assert not any("calibrated" in words for words in run.map.reasons)


@pytest.mark.parametrize(
    ("scales", "sigma", "told"),
    [
        ((0.03, -0.03, 0.001), 0.003, False),
        ((0.02, 0.016, 0.018), 0.003, True),
        ((-0.02, -0.016, -0.018), 0.003, True),
        ((0.02, 0.016, 0.018), 0.02, False),
        ((0.014, 0.014, 0.014), 0.001, False),
    ],
    ids=["they differ", "all long", "all short", "hardly known", "small"],
)
def test_the_alarm_is_of_the_mean_beyond_its_level_and_its_uncertainty(scales, sigma, told):
    biases = [BiasEstimate((f"r{i}", 1), "range_scale", v, sigma) for i, v in enumerate(scales)]
    assert bool(miscalibrations(biases)) == told
