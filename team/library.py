"""The estimators as a library of functions on arrays, without processes or network.

Poses are (x [m], y [m], theta [rad]), theta counter-clockwise in (−π, π]. Landmarks are points with
ids, measured by range [m] and bearing [rad]. The changelog announces a change of a name or its
meaning one version ahead.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from teamslam.team import core, translate
from teamslam.team.config import BIASES, BiasSigmas, FrontEnd, MotionModel, MotionNoise, Sensor
from teamslam.team.core import located, predicted as measurement_of
from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor, Stream, named
from teamslam.team.estimation.hybrid_slam import window as windows
from teamslam.team.estimation.hybrid_slam.fastslam import (
    Particles,
    Proposal,
    StepInfo,
    at_poses as particles_at,
    filter_step,
    resampled,
)
from teamslam.team.estimation.map_joining import joining, marginals
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings
from teamslam.team.estimation.map_joining.marginals import LandmarkMap, Trajectory
from teamslam.team.estimation.models import Increment, increment_of, scanned
from teamslam.team.estimation.se2 import compose, inverse
from teamslam.team.estimation.submap import LocalMap
from teamslam.team.recording.reader import Log, LogError, open_log
from teamslam.team.registry import load
from teamslam.team.shapes import Float, UInt32
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import WireError, decoded

__all__ = [
    "BatchMap",
    "FrontEnd",
    "Increment",
    "InitialPose",
    "JoinSettings",
    "JoinedMap",
    "Keyframe",
    "LandmarkMap",
    "LocalMap",
    "Log",
    "LogError",
    "MotionModel",
    "MotionNoise",
    "Particles",
    "Sensor",
    "StepInfo",
    "Trajectory",
    "WireError",
    "batch_map",
    "compose",
    "fastslam_step",
    "increment_of",
    "inverse",
    "join",
    "located",
    "measurement_of",
    "open_log",
    "particles_at",
    "submap_in",
    "submap_of",
    "submaps_in",
    "word_likelihoods",
]

_INCARNATION = 1  # incarnation of every stream here
MOST_WORDS = 64
UNEXPLAINED = 1e-4  # share of descriptors that no word explains


@dataclass(frozen=True, kw_only=True)
class Keyframe:
    """The motion since the last keyframe, and the landmarks measured at its end.

    increment: odometry (`increment_of`, `Increment.then`). ids: one may occur twice. ranges [m],
    bearings [rad]: as reported by the sensor.
    """

    increment: Increment
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]

    def calibrated(self, sensor: Sensor) -> "Keyframe":
        """Apply the sensor's calibration and drop measurements outside its limits."""
        valid, ranges, bearings = scanned(sensor, self.ranges, self.bearings)
        ranges, bearings = ranges[valid], bearings[valid]
        return Keyframe(
            increment=self.increment, ids=self.ids[valid], ranges=ranges, bearings=bearings
        )


@dataclass(frozen=True, kw_only=True)
class InitialPose:
    """A robot's first pose in the common frame: N(pose, covariance); covariance None: exact."""

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"] | None = None


@dataclass(frozen=True, kw_only=True)
class JoinedMap:
    """The team's map.

    landmarks: means and joint covariance in the common frame. trajectories: each robot's poses at
    the ends of its submaps. chi2/dof is about 1 for right models. apart: robots whose submaps are
    not in the map, each with the reason.
    """

    landmarks: LandmarkMap
    trajectories: dict[str, Trajectory]
    chi2: float
    dof: float
    apart: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class BatchMap:
    """The least-squares solution over all measurements at once: the batch reference.

    As `JoinedMap`, with each robot's poses at its start and at its keyframes. converged: whether
    the iterations reached the solution.
    """

    landmarks: LandmarkMap
    trajectories: dict[str, Trajectory]
    chi2: float
    dof: int
    converged: bool


def fastslam_step(
    particles: Particles,
    keyframe: Keyframe,
    sensor: Sensor,
    generator: np.random.Generator,
    *,
    proposal: Proposal = "fastslam2",
    resample_below: float = 0.5,
) -> tuple[Particles, StepInfo]:
    """Advance the particles by one keyframe of FastSLAM.

    They are resampled first if their effective number is below `resample_below` times their number.
    proposal: "fastslam2" draws poses given the measurements, "fastslam1" from the odometry alone.
    Raises NotACovarianceError if the increment's covariance is not positive semi-definite.

    Montemerlo 2003; Thrun et al. 2005, chapter 13.
    """
    taken = keyframe.calibrated(sensor)
    seen = taken.ids, taken.ranges, taken.bearings
    parents = None
    if core.effective_sample_size(particles.log_weights) < resample_below * len(particles.poses):
        particles, parents = resampled(particles, generator)
    moved, log_evidence = filter_step(
        particles, taken.increment, sensor, *seen, proposal, generator
    )
    effective = core.effective_sample_size(moved.log_weights)
    return moved, StepInfo(effective, parents, log_evidence)


def submap_of(
    keyframes: Sequence[Keyframe],
    sensor: Sensor,
    generator: np.random.Generator,
    front_end: FrontEnd | None = None,
) -> LocalMap:
    """Run one window of Hybrid-SLAM; return the Gaussian over (end pose, landmarks).

    The frame is the pose at which the first keyframe's motion begins. Submaps of consecutive
    windows are independent. front_end: its rules for closing a window are not used. Raises
    NotACovarianceError for a degenerate window.

    Brooks and Bailey 2009, HybridSLAM.
    """
    window = windows.open_window(front_end or FrontEnd(), sensor)
    random = core.Random(generator.bytes(16))
    for keyframe in keyframes:
        taken = keyframe.calibrated(sensor)
        windows.advance(window, taken.increment, taken.ids, taken.ranges, taken.bearings, random)
    return windows.gaussian(window)


def join(
    submaps: Mapping[str, Sequence[LocalMap]],
    initial_poses: Mapping[str, InitialPose],
    settings: JoinSettings | None = None,
) -> JoinedMap:
    """Join each robot's consecutive submaps to the team's map by sparse nonlinear least squares.

    initial_poses: known ones; without any, the first robot's is the common frame. A robot without
    one is joined by landmarks that it shares with the others; where these do not suffice, `apart`
    has the reason. Raises ValueError without submaps, or for an initial pose of a robot without
    submaps.
    """
    unknown = sorted(set(initial_poses) - set(submaps))
    if unknown or not any(submaps.values()):
        missing = f"of {unknown[0]}, which has an initial pose" if unknown else "at all"
        raise ValueError(f"there are no submaps {missing}: give each robot's in their order")
    fold = joining.EMPTY_FOLD
    for robot, initial in sorted(initial_poses.items()):
        start = InitialPoseFactor(robot, _INCARNATION, initial.pose, initial.covariance)
        fold = joining.add_start(fold, start)
    sigmas = msgspec.structs.asdict(BiasSigmas())
    chosen = settings or JoinSettings(bias_sigma={bias: sigmas[bias] for bias in BIASES})
    for tick in _ticks(submaps):
        fold = joining.fold_submaps(fold, tick, chosen)
    fold = joining.solve_fold(fold, chosen)
    cost = marginals.joint_cost(fold)
    inside = {robot for robot, _ in fold.main.graph.streams}
    return JoinedMap(
        landmarks=marginals.landmark_map(fold),
        trajectories={
            robot: Trajectory(*marginals.trajectory(fold, robot, _INCARNATION)[:2])
            for robot in sorted(inside)
        },
        chi2=cost.chi2,
        dof=cost.dof,
        apart={robot: _why(fold, (robot, _INCARNATION)) for robot in sorted({*submaps} - inside)},
    )


def _ticks(submaps: Mapping[str, Sequence[LocalMap]]) -> Iterator[list[Contribution]]:
    robots = sorted(submaps)
    for sequence, row in enumerate(zip_longest(*(submaps[robot] for robot in robots))):
        yield [
            Contribution(robot, _INCARNATION, sequence, sequence, local)
            for robot, local in zip(robots, row, strict=True)
            if local is not None
        ]


def _why(fold: joining.Fold, stream: Stream) -> str:
    if stream not in fold.home:
        return "it has no submaps"
    frame = min(fold.islands[fold.home[stream]].graph.streams)
    return fold.reasons.get(frame, f"{named(frame)} not joined")


def batch_map(
    keyframes: Mapping[str, Sequence[Keyframe]],
    sensors: Mapping[str, Sensor],
    initial_poses: Mapping[str, InitialPose],
    *,
    robust_c: float | None = None,
) -> BatchMap:
    """Estimate all poses and one map by least squares over every measurement.

    robust_c: scale of the Cauchy loss on √χ² of a landmark measurement; None: plain least squares.
    Raises ValueError for a robot without an initial pose.

    Dellaert and Kaess 2006, Square root SAM.
    """
    solve = load("teamslam.sim.studies.batch_reference.growing:solved_map", "batch_map")
    return cast("BatchMap", solve(keyframes, sensors, initial_poses, robust_c))


def word_likelihoods(
    descriptors: ArrayLike, words: ArrayLike, sigma: float
) -> Float[np.ndarray, "n C"]:
    """Compute p(descriptor | word), n × C, up to a factor by row: classes for `Driver.detect`.

    exp(−|d − w|² / 2σ²), divided by the row's largest and at least 10⁻⁴, the share of descriptors
    that no word explains. descriptors: n × D. words: vocabulary, C × D with C from 2 to 64, such as
    cluster centres of a training set, the same for the whole team. sigma: standard deviation of a
    component about the nearest word, from the same training set. Raises ValueError for other
    shapes or a sigma that is not above 0.

    Sivic and Zisserman 2003, Video Google.
    """
    d, w = np.asarray(descriptors, np.float64), np.asarray(words, np.float64)
    if d.ndim != 2 or w.ndim != 2 or d.shape[1] != w.shape[1] or not 2 <= len(w) <= MOST_WORDS:
        raise ValueError(
            f"descriptors have the shape {d.shape} and words {w.shape}: give n × D and C × D, with "
            f"2 to {MOST_WORDS} words"
        )
    if not sigma > 0.0:
        raise ValueError(f"sigma is {sigma}: give a standard deviation above 0")
    squared = ((d[:, np.newaxis] - w) ** 2).sum(axis=2) / sigma**2
    nearest = squared.min(axis=1, keepdims=True)
    return np.asarray(np.maximum(np.exp(0.5 * (nearest - squared)), UNEXPLAINED))


def submap_in(payload: bytes) -> tuple[str, int, LocalMap]:
    """Decode (robot, sequence, submap) from a message on a key `team/…/robot/…/submap`.

    Raises WireError for any other bytes.
    """
    message = decoded(payload, m.Submap)
    return message.robot, message.sequence, translate.local_map_of(message)


def submaps_in(log: Log | Path | str) -> dict[str, list[LocalMap]]:
    """Read each robot's submaps of its first incarnation from a log. Raises LogError."""
    opened = log if isinstance(log, Log) else open_log(log)
    found: dict[str, dict[int, LocalMap]] = {}
    for sample in opened.samples([ch.SUBMAP]):
        message = decoded(sample.payload, m.Submap)
        if message.incarnation == _INCARNATION:
            found.setdefault(message.robot, {})[message.sequence] = translate.local_map_of(message)
    return {robot: [of[k] for k in sorted(of)] for robot, of in sorted(found.items())}
