"""Submaps of a simulated drive without landmark identities, and their truth."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from teamslam.team.config import UNNAMED
from teamslam.team.estimation.association.landmark_sets import Landmarks
from teamslam.team.estimation.association.member_log import LocalLandmark
from teamslam.team.estimation.contribution import Contribution
from teamslam.team.estimation.se2 import between, inverse, transformed
from teamslam.team.estimation.submap import LocalMap, Unnamed

POSE_SD = (0.03, 0.03, 0.004)
LANDMARK_SD = 0.03


def drive(
    robot: str,
    path: Float[np.ndarray, "k 3"],
    world: Float[np.ndarray, "L 2"],
    rng: np.random.Generator,
    reach: float = 6.0,
    named: bool = False,
    pose_sd: tuple[float, float, float] = POSE_SD,
) -> tuple[list[Contribution], dict[LocalLandmark, int]]:
    """A submap between each two poses of a path, and its truth.

    Contains all landmarks within reach in random order; named: with their numbers.
    """
    submaps, truth = [], {}
    for k, (start, end) in enumerate(pairwise(path)):
        away = np.hypot(*(world - start[:2]).T)
        seen = np.flatnonzero(away < reach)
        if not named:
            seen = rng.permutation(seen)
        local = [transformed(inverse(start), world[at]) for at in seen]
        sd = np.concatenate([pose_sd, np.full(2 * len(seen), LANDMARK_SD)])
        mean = np.concatenate([between(start, end), np.ravel(local)])
        ids = seen if named else UNNAMED + np.arange(len(seen))
        unnamed = Unnamed(
            np.full(0 if named else len(seen), 5, np.uint32),
            np.ones((0 if named else len(seen), 1), np.bool_),
        )
        each = LocalMap(
            ids.astype(np.uint32),
            mean + sd * rng.normal(size=len(sd)),
            np.diag(sd**2),
            unnamed=unnamed,
        )
        submaps.append(Contribution(robot, 1, k, (k + 1) * 10**10, each))
        truth |= {LocalLandmark(robot, 1, k, n): int(at) for n, at in enumerate(seen)}
    return submaps, truth


def circle(
    centre: tuple[float, float], radius: float, steps: int, turns: float, phase: float = 0.0
) -> Float[np.ndarray, "k 3"]:
    angle = phase + np.linspace(0.0, 2.0 * np.pi * turns, steps + 1)
    x, y = centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)
    return np.column_stack([x, y, (angle + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi])


def ring(rng: np.random.Generator, count: int) -> Float[np.ndarray, "k 2"]:
    angle = 2.0 * np.pi * (np.arange(count) + 0.6 * rng.uniform(size=count)) / count
    r = rng.uniform(17.0, 23.0, count)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


def wrong(landmarks: Landmarks, truth: dict[LocalLandmark, int]) -> int:
    """Members whose set contains more of another true landmark."""
    count = 0
    for members in landmarks.sets.values():
        found = [truth[member] for member in members]
        count += len(found) - max(found.count(each) for each in found)
    return count


def duplicates(landmarks: Landmarks, truth: dict[LocalLandmark, int]) -> int:
    """Sets beyond one for each true landmark."""
    members = (member for of in landmarks.sets.values() for member in of)
    return len(landmarks.sets) - len({truth[member] for member in members})
