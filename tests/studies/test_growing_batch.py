"""The growing batch MAP: the dense solution that it must equal, and its consistency."""

import numpy as np
import pytest

from teamslam.sim.studies.batch_reference import growing as batch
from teamslam.sim.studies.batch_reference.graph import FLOOR_SIGMAS
from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation.models import noise
from teamslam.team.estimation.se2 import (
    adjoint,
    between,
    compose,
    exponential,
    inverse,
    logarithm,
    tangent,
)
from tests.estimation.team_rounds import LANDMARKS, STARTS, team_run, wrap

KNOWN = {robot: (pose, None) for robot, pose in STARTS.items()}
UNSURE = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]])
RISING = Sensor(range_sigma=0.1, range_sigma_per_m=0.05, bearing_sigma=0.02)


def turns_of(rounds):
    return [turn for turns in rounds for turn in turns]


def converged(start, turns):
    found = batch.solved(batch.extended(start, turns), 100, 1e-5)
    assert found.converged(1e-5)
    return found


def moved(pose, xi):
    return compose(pose, exponential(xi))


def right_jacobian(xi):
    """Σ (−ad)ᵏ/(k + 1)!, by its series."""
    forward, left, turn = xi
    ad = np.array([[0.0, -turn, left], [turn, 0.0, -forward], [0.0, 0.0, 0.0]])
    total, term = np.zeros((3, 3)), np.eye(3)
    for k in range(30):
        total = total + term
        term = -term @ ad / (k + 2)
    return total


def dense_solution(starts, turns):
    """Gauss-Newton on dense matrices, factor by factor: values, their covariance, nodes by name."""
    x, column, size = {}, {}, 0
    for robot, (pose, _) in starts.items():
        x[robot, 0], column[robot, 0], size = pose, size, size + 3
    count = dict.fromkeys(starts, 0)
    factors = [("start", robot) for robot in starts]
    for turn in turns:
        robot, k = turn.robot, count[turn.robot]
        count[robot] += 1
        x[robot, k + 1] = compose(x[robot, k], turn.increment.mean)
        column[robot, k + 1], size = size, size + 3
        factors.append(("motion", (robot, k), (robot, k + 1), turn.increment))
        for id_, r, b in zip(turn.ids.tolist(), turn.ranges, turn.bearings, strict=True):
            if id_ not in x:
                x[id_], column[id_], size = LANDMARKS[id_], size, size + 2
            factors.append(("reading", (robot, k + 1), id_, r, b, turn.sensor))
    for _ in range(30):
        A, g = np.zeros((size, size)), np.zeros(size)
        for kind, *rest in factors:
            J = np.zeros((2 if kind == "reading" else 3, size))
            if kind == "start":
                node = (rest[0], 0)
                pose, covariance = starts[rest[0]]
                G = tangent(pose[2])
                P = np.eye(3) * 1e-10 if covariance is None else G.T @ covariance @ G
                r = logarithm(between(pose, x[node]))
                J[:, column[node] : column[node] + 3] = np.linalg.inv(right_jacobian(r))
            elif kind == "motion":
                a, b, increment = rest
                P = increment.covariance + np.diag(FLOOR_SIGMAS) ** 2
                h = between(x[a], x[b])
                r = logarithm(between(increment.mean, h))
                of_b = np.linalg.inv(right_jacobian(r))
                J[:, column[a] : column[a] + 3] = -of_b @ adjoint(inverse(h))
                J[:, column[b] : column[b] + 3] = of_b
            else:
                node, id_, distance, bearing, sensor = rest
                (z,), (of_pose,), (of_landmark,) = core.predict(x[node], x[id_][None])
                d, beta = z
                P = np.diag(noise(sensor, d))
                r = np.array([d - distance, wrap(beta - bearing)])
                J[:, column[node] : column[node] + 3] = of_pose
                J[:, column[id_] : column[id_] + 2] = of_landmark
            W = np.linalg.inv(P)
            A, g = A + J.T @ W @ J, g + J.T @ W @ r
        step = -np.linalg.solve(A, g)
        for node, value in x.items():
            at, delta = column[node], step[column[node] : column[node] + len(value)]
            x[node] = value + delta if len(value) == 2 else moved(value, step[at : at + 3])
    return x, np.linalg.inv(A), column


@pytest.mark.parametrize("sensor", [None, RISING], ids=["their sensors", "noise with the range"])
def test_it_is_the_dense_gauss_newton(sensor):
    rounds, _ = team_run(5, steps=4)
    turns = turns_of(rounds)
    if sensor is not None:
        turns = [turn._replace(sensor=sensor) for turn in turns]
    starts = {"r1": (STARTS["r1"], UNSURE), "r2": KNOWN["r2"]}
    x, P, column = dense_solution(starts, turns)
    found = converged(batch.initial_state(starts, None), turns)
    landmarks = batch.landmark_gaussian(found)
    ids = landmarks.ids.tolist()
    at = np.array([column[id_] + axis for id_ in ids for axis in range(2)])
    sigma = np.sqrt(np.diag(P)[at])
    expected = np.concatenate([x[id_] for id_ in ids])
    assert np.abs((landmarks.means.ravel() - expected) / sigma).max() < 1e-4
    scale = np.outer(sigma, sigma)
    assert np.abs((landmarks.covariance - P[np.ix_(at, at)]) / scale).max() < 1e-4
    for robot in starts:
        means, covariances = batch.trajectory(found, robot)
        assert len(means) == 5
        for k, (mean, covariance) in enumerate(zip(means, covariances, strict=True)):
            own = column[robot, k] + np.arange(3)
            G = tangent(mean[2])
            dense = G @ P[np.ix_(own, own)] @ G.T
            np.testing.assert_allclose(mean, x[robot, k], atol=1e-5)
            np.testing.assert_allclose(covariance, dense, rtol=1e-3, atol=1e-4 * dense.max())
        newest = batch.pose_gaussian(found, robot)
        np.testing.assert_array_equal(newest.mean, means[-1])
        np.testing.assert_allclose(newest.covariance, covariances[-1], rtol=1e-9)


def test_how_it_has_grown_does_not_matter():
    rounds, _ = team_run(7, steps=9)
    whole = converged(batch.initial_state(KNOWN, None), turns_of(rounds))
    grown = batch.initial_state(KNOWN, None)
    for k in range(0, 9, 3):
        grown = batch.extended(grown, turns_of(rounds[k : k + 3]))
        grown = batch.solved(grown, 2, 1e-2)
    grown = converged(grown, [])
    for one, other in zip(
        batch.landmark_gaussian(whole), batch.landmark_gaussian(grown), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("robust", [True, False], ids=["Cauchy", "mutant: plain squares"])
def test_a_robust_batch_leaves_outliers_out(robust):
    rounds, _ = team_run(11, steps=12)
    turns = turns_of(rounds)
    victim = turns[9]
    ranges = victim.ranges.copy()
    ranges[0] += 20.0
    spoilt = [*turns[:9], victim._replace(ranges=ranges), *turns[10:]]
    clean = batch.landmark_gaussian(converged(batch.initial_state(KNOWN, None), turns))
    found = batch.solved(
        batch.extended(batch.initial_state(KNOWN, 2.0 if robust else None), spoilt), 200, 1e-6
    )
    assert found.converged(1e-6)
    off = (batch.landmark_gaussian(found).means - clean.means).ravel()
    sigmas = float(np.abs(off / np.sqrt(np.diag(clean.covariance))).max())
    assert (sigmas < 1.0) == robust, sigmas
