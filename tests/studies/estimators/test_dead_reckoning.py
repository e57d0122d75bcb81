import numpy as np

from teamslam.sim.studies.estimators import dead_reckoning
from teamslam.sim.studies.estimators.robot_step import RobotStep
from teamslam.team.config import MotionModel, MotionNoise, Sensor
from teamslam.team.estimation.consistency import chi2_interval, nees
from teamslam.team.estimation.models import increment_of
from teamslam.team.estimation.se2 import between, compose, exponential, logarithm

MOTION = MotionModel(
    "turn-then-drive", forward=MotionNoise(per_s=0.05), turn=MotionNoise(per_s=np.deg2rad(3.0))
)
SENSOR = Sensor()
START = np.array([3.0, -2.0, 2.5])


def reckoned(steps, start=START, measurements=()):
    state = dead_reckoning.initial_state(start)
    for step in steps:
        state = dead_reckoning.filter_step(state, RobotStep("r1", step, SENSOR, *measurements))
    return state


def drive(seed, steps=20):
    rng = np.random.default_rng(seed)
    told = [increment_of(MOTION, 1.0, 0.98, rng.uniform(-0.15, 0.15)) for _ in range(steps)]
    truth = START
    for step in told:
        xi = rng.multivariate_normal(np.zeros(3), step.covariance, method="svd")
        truth = compose(compose(truth, step.mean), exponential(xi))
    return told, truth


def mean_nees(covariance_of, runs=80):
    """Mean over runs of ξᵀ C⁻¹ ξ / 3 with truth = mean ∘ Exp(ξ)."""
    total = 0.0
    for seed in range(runs):
        told, truth = drive(seed)
        error = logarithm(between(reckoned(told).pose.mean, truth))
        total += nees(error, covariance_of(told))
    return total / (3 * runs)


def test_its_covariance_is_true_and_one_that_is_only_added_up_is_not():
    low, high = chi2_interval(3, 0.999, 80)
    assert low < mean_nees(lambda told: reckoned(told).pose.covariance) < high
    assert not low < mean_nees(added_up) < high


def added_up(told):
    """Covariance of a robot that never turns, enlarged a little since it is singular."""
    covariance = sum(step.covariance for step in told)
    return covariance + 1e-9 * np.diag(np.diag(covariance))


def test_measurements_change_nothing_and_no_landmark_is_known():
    told, _ = drive(0)
    seen = (np.array([4], np.uint32), np.array([5.0]), np.array([0.1]))
    blind, seeing = reckoned(told), reckoned(told, measurements=seen)
    assert blind.pose.mean.tobytes() == seeing.pose.mean.tobytes()
    assert blind.pose.covariance.tobytes() == seeing.pose.covariance.tobytes()
    ids, means, covariance = dead_reckoning.landmark_gaussian(seeing)
    assert (ids.shape, means.shape, covariance.shape) == ((0,), (0, 2), (0, 0))
