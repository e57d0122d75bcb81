"""Teams whose submaps have a pose node in their middle, from where teammates are seen."""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.inter_robot import InterRobotFactor
from teamslam.team.estimation.map_joining.joining import EMPTY_FOLD, add_start, fold_submaps
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.submap_world import correlated, drawn, local_truth, seen_from, wrap


@dataclass
class Met:
    landmarks: np.ndarray
    starts: list
    submaps: list
    sightings: list


def local_pose(start, pose):
    step = seen_from(start, pose[0] + 1j * pose[1])
    return np.array([step.real, step.imag, wrap(pose[2] - start[2])])


def meeting(seed, robots=2, submaps=6, landmarks=5, reach=12.0, sigmas=(0.1, 0.02)):
    """Robots that wander in 20 m × 20 m; at each node every robot sees every other one.

    sigmas: of a sighting's range [m] and bearing [rad].
    """
    rng = np.random.default_rng([seed, 77])
    points = rng.uniform(0.0, 20.0, (landmarks, 2))
    starts, made, poses = [], [], {}
    for r in range(robots):
        robot = f"r{r}"
        pose = np.array([*rng.uniform(6.0, 14.0, 2), rng.uniform(-3.0, 3.0)])
        starts.append(InitialPoseFactor(robot, 0, pose))
        for k in range(submaps):
            to_middle = 10.0 + 10.0j - (pose[0] + 1j * pose[1])
            way = [pose]
            for _ in range(2):
                turn = 0.3 * np.sin(np.angle(to_middle) - pose[2]) + 0.2 * rng.normal()
                ahead = way[-1][0] + 1j * way[-1][1] + 1.5 * np.exp(1j * (way[-1][2] + turn / 2))
                way.append(np.array([ahead.real, ahead.imag, wrap(way[-1][2] + turn)]))
            seen = np.flatnonzero(np.hypot(*(points - pose[:2]).T) < reach)
            local = seen_from(pose, points[seen, 0] + 1j * points[seen, 1])
            truth = np.concatenate(
                [
                    local_pose(pose, way[2]),
                    local_pose(pose, way[1]),
                    np.column_stack([local.real, local.imag]).ravel(),
                ]
            )
            spread = [0.1, 0.1, 0.02, 0.07, 0.07, 0.015, *[0.2] * (2 * len(seen))]
            covariance = correlated(np.array(spread), rng)
            mean = drawn(truth, covariance, rng)
            mean[5] = wrap(mean[5])
            node_ns = 1000 * k + 500
            local_map = LocalMap(seen.astype(np.uint32), mean, covariance, np.array([node_ns]))
            made.append(Contribution(robot, 0, k, 1000 * (k + 1), local_map))
            poses[robot, k] = way[1]
            pose = way[2]
    sightings = []
    for (robot, k), pose in poses.items():
        for other in (f"r{r}" for r in range(robots) if f"r{r}" != robot):
            to = seen_from(pose, poses[other, k][0] + 1j * poses[other, k][1])
            noise = np.array(sigmas) * rng.normal(size=2)
            measurement = np.array([abs(to) + noise[0], wrap(np.angle(to) + noise[1])])
            covariance = np.diag(np.square(sigmas))
            stamp = 1000 * k + 500
            sightings.append(InterRobotFactor(robot, 0, k, stamp, other, measurement, covariance))
    canonical = sorted(made, key=lambda each: each.key)
    return Met(points, starts, canonical, sorted(sightings, key=lambda each: each.key))


def joined_with(submaps, starts, sightings, options, tick=4):
    """Fold the submaps, `tick` at a time, with the sightings from the tick's submaps."""
    fold = EMPTY_FOLD
    for start in starts:
        fold = add_start(fold, start)
    for begin in range(0, len(submaps), tick):
        taken = submaps[begin : begin + tick]
        names = {(each.robot, each.sequence) for each in taken}
        seen = [each for each in sightings if (each.robot, each.sequence) in names]
        fold = fold_submaps(fold, taken, options, seen)
    return fold


def mirrored(bearing_sigma, options):
    """r1 drives straight beside r0, who measures its range but hardly its bearing.

    Two islands: the true one, and r1 on the other side.
    """
    ranges_seen = []
    stamps = np.arange(1, 5) * 1000
    submaps = []
    paths = {"r0": np.zeros(3), "r1": np.array([0.0, 3.0, 0.2])}
    nodes = {}
    for robot, start in paths.items():
        c, s = np.cos(start[2]), np.sin(start[2])
        along = [np.array([start[0] + k * c, start[1] + k * s, start[2]]) for k in range(1, 6)]
        nodes[robot] = along[:4]
        mean = np.concatenate(
            [local_truth(start, pose, np.zeros((0, 2))) for pose in (along[4], *along[:4])]
        )
        local = LocalMap(np.zeros(0, np.uint32), mean, 1e-4 * np.eye(len(mean)), stamps)
        submaps.append(Contribution(robot, 0, 0, 5000, local))
    for stamp, observer, seen in zip(stamps.tolist(), nodes["r0"], nodes["r1"], strict=True):
        to = seen_from(observer, seen[0] + 1j * seen[1])
        bearing = np.angle(to) if bearing_sigma < 1.0 else 0.0
        measurement = np.array([abs(to), bearing])
        covariance = np.diag([0.01, bearing_sigma]) ** 2
        ranges_seen.append(InterRobotFactor("r0", 0, 0, stamp, "r1", measurement, covariance))
    starts = [
        InitialPoseFactor("r0", 0, np.zeros(3)),
        InitialPoseFactor("r1", 0, paths["r1"], np.diag([100.0, 100, 9])),
    ]
    island = joined_with(submaps, starts, ranges_seen, options).main
    across = island.state.copy()
    for node in (*island.graph.streams["r1", 0], *island.graph.poses.values()):
        across[island.graph.offset[node] + 1] *= -1.0
        across[island.graph.offset[node] + 2] *= -1.0
    return [island, replace(island, state=across)]
