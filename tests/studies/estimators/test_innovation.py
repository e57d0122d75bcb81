import numpy as np
import pytest

from teamslam.sim.studies.estimators.robot_step import RobotStep, innovation
from teamslam.team.config import Sensor
from teamslam.team.core import predicted
from teamslam.team.estimation.hybrid_slam.fastslam import Particles
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.se2 import compose, exponential
from tests.estimation.hybrid_slam.test_window import wrap

SENSOR = Sensor(range_sigma=0.1, range_sigma_per_m=0.02, bearing_sigma=0.03)
FACTOR = np.array([[0.04, 0.0, 0.0], [0.01, 0.03, 0.0], [-0.01, 0.02, 0.05]])
INCREMENT = Increment(np.array([0.5, 0.1, 0.2]), FACTOR @ FACTOR.T)
IDS = np.array([4, 9, 4], np.uint32)
RANGES, BEARINGS = np.array([5.1, 7.2, 5.3]), np.array([0.3, -1.2, 0.35])


def particles(count, spread=0.05):
    rng = np.random.default_rng(count)
    roots = rng.normal(0.0, 0.1, (count, 2, 2, 2))
    P = roots @ roots.transpose(0, 1, 3, 2) + 0.01 * np.eye(2)
    logs = np.log(rng.uniform(0.5, 1.5, count))
    return Particles(
        rng.normal([1.0, 2.0, 3.1], spread, (count, 3)),
        logs - np.log(np.exp(logs).sum()),
        np.array([9, 4], np.uint32),
        np.array([[-0.6, 8.9], [-4.3, 0.4]]) + rng.normal(0.0, spread, (count, 2, 2)),
        np.stack((P[..., 0, 0], P[..., 0, 1], P[..., 1, 1]), axis=-1),
    )


def by_differences(of, ids, measurements):
    """ν and S of `innovation`'s docstring with every Jacobian by central differences."""
    slots = [int(np.flatnonzero(of.ids == i)[0]) for i in ids]
    weights = np.exp(of.log_weights)
    predictions, covariances = [], []
    for i in range(len(weights)):

        def told(unknowns, i=i):
            start = compose(of.poses[i], INCREMENT.mean)
            pose = compose(start, exponential(unknowns[:3]))
            landmarks = of.means[i] + unknowns[3:].reshape(-1, 2)
            return np.array([predicted(pose, landmarks[k]) for k in slots]).ravel()

        P = np.zeros((7, 7))
        P[:3, :3] = INCREMENT.covariance
        for slot, (xx, xy, yy) in enumerate(of.covariances[i]):
            P[3 + 2 * slot : 5 + 2 * slot, 3 + 2 * slot : 5 + 2 * slot] = [[xx, xy], [xy, yy]]
        steps = 1e-6 * np.eye(7)
        J = np.stack([(told(h) - told(-h)) / 2e-6 for h in steps], axis=1)
        z = told(np.zeros(7))
        per_m = SENSOR.range_sigma_per_m * z[::2]
        R = np.column_stack((SENSOR.range_sigma**2 + per_m**2, np.full(len(per_m), 0.03**2)))
        predictions.append(z)
        covariances.append(J @ P @ J.T + np.diag(R.ravel()))
    mean = weights @ np.array(predictions)
    d = np.array(predictions) - mean
    S = np.einsum("i,ijk->jk", weights, covariances) + (d * weights[:, None]).T @ d
    error = measurements.ravel() - mean
    error[1::2] = wrap(error[1::2])
    return error, S


@pytest.mark.parametrize("count", [1, 7])
def test_it_is_the_error_in_the_metric_of_the_mixtures_prediction(count):
    of = particles(count)
    error, S = by_differences(of, IDS, np.column_stack((RANGES, BEARINGS)))
    found = innovation(of, RobotStep("r1", INCREMENT, SENSOR, IDS, RANGES, BEARINGS))
    assert found.dof == 6
    assert found.squared == pytest.approx(error @ np.linalg.solve(S, error), rel=1e-3)
