"""Teams whose submaps are drawn from their own Gaussians about a known truth.

The truth is made with complex numbers (x + iy), not with the estimator's geometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.map_joining.conditioning import RobotPrior
from teamslam.team.estimation.map_joining.gauss_newton import solve_island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.landmark_view import known
from teamslam.team.estimation.map_joining.marginals import main_priors
from teamslam.team.estimation.submap import LocalMap


@dataclass
class Team:
    """True landmarks (L, 2), true end poses by robot, exact starts, submaps in canonical order."""

    landmarks: np.ndarray
    paths: dict
    starts: list
    submaps: list


def seen_from(pose, points):
    """Points (x + iy) in the frame of a pose (x, y, θ)."""
    return (points - (pose[0] + 1j * pose[1])) * np.exp(-1j * pose[2])


def wrap(angle):
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def local_truth(start, end, points):
    """(end pose, landmarks) in the frame of `start`; points (n, 2)."""
    step = seen_from(start, end[0] + 1j * end[1])
    local = seen_from(start, points[:, 0] + 1j * points[:, 1])
    pairs = np.column_stack([local.real, local.imag]).ravel()
    return np.concatenate([[step.real, step.imag, wrap(end[2] - start[2])], pairs])


def correlated(sigmas, rng):
    n = len(sigmas)
    root = np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n)
    covariance = root @ root.T
    scale = sigmas / np.sqrt(np.diag(covariance))
    covariance = scale[:, None] * covariance * scale
    return 0.5 * (covariance + covariance.T)


def drawn(truth, covariance, rng):
    mean = truth + np.linalg.cholesky(covariance) @ rng.normal(size=len(truth))
    mean[2] = wrap(mean[2])
    return mean


def solved(fold, settings):
    """The fold with the full solution of its main island, without a search for other minima."""
    island, _, _ = solve_island(replace(fold.main, settings=settings))
    return replace(fold, islands={**fold.islands, fold.main_key: island})


def team(seed, robots=2, submaps=8, landmarks=6, size=20.0, reach=12.0, sigmas=(0.1, 0.02, 0.2)):
    """sigmas: end position [m], end heading [rad], landmark [m]."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, size, (landmarks, 2))
    paths, starts, made = {}, [], []
    for r in range(robots):
        robot = f"r{r}"
        pose = np.array([*rng.uniform(0.3 * size, 0.7 * size, 2), rng.uniform(-3.0, 3.0)])
        starts.append(InitialPoseFactor(robot, 0, pose))
        paths[robot] = []
        for k in range(submaps):
            to_middle = (1 + 1j) * size / 2.0 - (pose[0] + 1j * pose[1])
            turn = 0.5 * np.sin(np.angle(to_middle) - pose[2]) + 0.3 * rng.normal()
            ahead = pose[0] + 1j * pose[1] + 0.15 * size * np.exp(1j * (pose[2] + turn / 2))
            end = np.array([ahead.real, ahead.imag, wrap(pose[2] + turn)])
            seen = np.flatnonzero(np.hypot(*(points - pose[:2]).T) < reach)
            truth = local_truth(pose, end, points[seen])
            spread = [sigmas[0], sigmas[0], sigmas[1], *[sigmas[2]] * (2 * len(seen))]
            covariance = correlated(np.array(spread), rng)
            local = LocalMap(seen.astype(np.uint32), drawn(truth, covariance, rng), covariance)
            made.append(Contribution(robot, 0, k, 1000 * (k + 1), local))
            paths[robot].append(end)
            pose = end
        paths[robot] = np.array(paths[robot])
    return Team(points, paths, starts, sorted(made, key=lambda each: each.key))


def prior_for(
    fold: Fold, robot: str, incarnation: int, ids: Sequence[int] | None = None
) -> RobotPrior:
    """A robot's prior with these landmarks of the main island; None: all."""
    chosen = known(fold.main) if ids is None else sorted(ids)
    stream = robot, incarnation
    return main_priors(fold, [stream], len(chosen), chosen)[stream]
