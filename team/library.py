"""The estimators as a library: values in, values out, no process and no network.

`from team import …` gives every name listed here. Names and meanings are stable: a removal or
change is announced in the changelog one version before.

All poses are (x [m], y [m], theta [rad]), theta counter-clockwise in (−π, π]. Landmarks are points
with numbers, measured by range [m] and bearing [rad].
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float, UInt32

from team import translate
from team.config import FrontEnd, MotionModel, MotionNoise, Sensor
from team.estimation.contribution import Contribution, InitialPoseFactor, Stream, named
from team.estimation.geometry import compose, inverse
from team.estimation.hybrid_slam import window as windows
from team.estimation.hybrid_slam.fastslam import (
    Particles,
    Proposal,
    StepInfo,
    propagated_and_updated,
)
from team.estimation.hybrid_slam.fastslam import at_poses as particles_at
from team.estimation.map_joining import joining, marginals
from team.estimation.map_joining.gauss_newton import JoinSettings
from team.estimation.map_joining.marginals import LandmarkMap, Trajectory
from team.estimation.models import Increment, increment_of, located, scanned
from team.estimation.models import predicted as measurement_of
from team.estimation.submap import LocalMap
from team.recording.reader import Log, LogError, open_log
from team.registry import loaded
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.codec import WireError, decoded

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
]

_INCARNATION = 1
"""Of every stream here: an array has one life."""


@dataclass(frozen=True, kw_only=True)
class Keyframe:
    """The motion since the last keyframe, and the landmarks that were measured at its end.

    increment: of the odometry (`increment_of`, `Increment.then`).
    ids:       numbers of the n landmarks; one may occur twice.
    ranges:    [m], bearings: [rad], as the sensor reported them.
    """

    increment: Increment
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]

    def calibrated(self, sensor: Sensor) -> "Keyframe":
        """The measurements within the sensor's limits, with its calibration applied."""
        valid, ranges, bearings = scanned(sensor, self.ranges, self.bearings)
        ranges, bearings = ranges[valid], bearings[valid]
        return Keyframe(
            increment=self.increment, ids=self.ids[valid], ranges=ranges, bearings=bearings
        )


@dataclass(frozen=True, kw_only=True)
class InitialPose:
    """Where a robot begins in the common frame: exactly (covariance None) or N(pose, covariance).

    The covariance is of (x [m], y [m], theta [rad]).
    """

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"] | None = None


@dataclass(frozen=True, kw_only=True)
class JoinedMap:
    """The team's map.

    landmarks:    means and joint covariance in the common frame.
    trajectories: of each robot in that frame the poses at which its submaps end.
    chi2, dof:    how well the submaps agree: chi2/dof is about 1 where the models are right.
    apart:        why a robot's submaps are not in the map, by robot.
    """

    landmarks: LandmarkMap
    trajectories: dict[str, Trajectory]
    chi2: float
    dof: float
    apart: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class BatchMap:
    """The least-squares solution over all measurements at once: the batch reference.

    landmarks:    means and joint covariance in the common frame.
    trajectories: each robot's pose at its start and at each of its keyframes.
    chi2, dof:    of all measurements: chi2/dof is about 1 where the models are right.
    converged:    False where the iterations ended before the solution was reached.
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
    """One step of FastSLAM: the particles after a keyframe.

    They are resampled first where their effective number is below `resample_below` of all.
    proposal: "fastslam2" draws poses given the measurements, "fastslam1" by the odometry alone.
    Raises NotACovarianceError if the increment's covariance is not positive semi-definite.
    Montemerlo 2003; Thrun et al. 2005, chapter 13.
    """
    taken = keyframe.calibrated(sensor)
    return propagated_and_updated(
        particles=particles,
        increment=taken.increment,
        sensor=sensor,
        ids=taken.ids,
        ranges=taken.ranges,
        bearings=taken.bearings,
        proposal=proposal,
        resample_below=resample_below,
        generator=generator,
    )


def submap_of(
    keyframes: Sequence[Keyframe],
    sensor: Sensor,
    generator: np.random.Generator,
    front_end: FrontEnd | None = None,
) -> LocalMap:
    """One window of Hybrid-SLAM: the Gaussian over (end pose, landmarks) that its particles become.

    Its frame is the pose at which the first keyframe's motion begins; that pose is exactly zero.
    The submap depends on its arguments alone, so submaps of consecutive windows are independent.
    front_end: number of particles and more; its rules on when a window ends are not used here.
    Raises NotACovarianceError where the window has no sound Gaussian.
    Brooks and Bailey 2009, HybridSLAM.
    """
    window = windows.opened(front_end or FrontEnd(), sensor)
    for keyframe in keyframes:
        taken = keyframe.calibrated(sensor)
        window = windows.advanced(
            window, taken.increment, taken.ids, taken.ranges, taken.bearings, generator
        )
    return windows.gaussian(window)


def join(
    submaps: Mapping[str, Sequence[LocalMap]],
    initial_poses: Mapping[str, InitialPose],
    settings: JoinSettings | None = None,
) -> JoinedMap:
    """The team's map of each robot's consecutive submaps, by sparse nonlinear least squares.

    Each submap of a robot begins where its last one ended. initial_poses: of the robots of which it
    is known; without any, the first robot's is the common frame. A robot without one is tied by
    landmarks that it shares with the others; where these do not suffice, `apart` says why.
    Raises ValueError without submaps, or for an initial pose of a robot that has none.
    """
    unknown = sorted(set(initial_poses) - set(submaps))
    if unknown or not any(submaps.values()):
        missing = f"of {unknown[0]}, which has an initial pose" if unknown else "at all"
        raise ValueError(f"there are no submaps {missing}: give each robot's in their order")
    fold = joining.EMPTY_FOLD
    for robot, initial in sorted(initial_poses.items()):
        start = InitialPoseFactor(robot, _INCARNATION, initial.pose, initial.covariance)
        fold = joining.started(fold, start)
    chosen = settings or JoinSettings()
    for tick in _ticks(submaps):
        fold = joining.folded(fold, tick, chosen)
    fold = joining.converged(fold, chosen)
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
    """The first submaps of all robots, then the second ones, and so on."""
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
    """All poses of all robots and one map, by least squares over every measurement.

    robust_c: Cauchy's scale on √χ² of a landmark's measurement; None for plain least squares.
    Each robot needs an initial pose. Raises ValueError for one that has none.
    Dellaert and Kaess 2006, Square root SAM.
    """
    solve = loaded("sim.studies.batch_map:solved_map", "batch_map")
    return cast("BatchMap", solve(keyframes, sensors, initial_poses, robust_c))


def submap_in(payload: bytes) -> tuple[str, int, LocalMap]:
    """(robot, sequence, submap) of a message on a key `team/…/robot/…/submap`, as it was received.

    Raises WireError, with the reason, for bytes that are no sound submap.
    """
    message = decoded(payload, m.Submap)
    return message.robot, message.sequence, translate.local_map_of(message)


def submaps_in(log: Log | Path | str) -> dict[str, list[LocalMap]]:
    """Each robot's submaps in their order, from a log of a run.

    Of a robot whose stream began anew, those of its first incarnation. Raises LogError for a file
    that is no log.
    """
    opened = log if isinstance(log, Log) else open_log(log)
    found: dict[str, dict[int, LocalMap]] = {}
    for sample in opened.samples([ch.SUBMAP]):
        message = decoded(sample.payload, m.Submap)
        if message.incarnation == _INCARNATION:
            found.setdefault(message.robot, {})[message.sequence] = translate.local_map_of(message)
    return {robot: [of[k] for k in sorted(of)] for robot, of in sorted(found.items())}
