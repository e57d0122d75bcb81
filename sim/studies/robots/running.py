"""Run an estimator with one state over a whole stream."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import msgspec
import numpy as np

from teamslam.sim.studies.estimators.robot_step import POSE_FLOOR, RobotStep
from teamslam.sim.studies.robots.filters import FILTERS, Estimates, KnownMap
from teamslam.team import core
from teamslam.team.config import UNNAMED, RobotConfig
from teamslam.team.core import Scan
from teamslam.team.estimation.gaussian import (
    LandmarkGaussian,
    NotACovarianceError,
    PoseGaussian,
    start_of_sensor,
)
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation, generator
from teamslam.team.estimation.models import Increment, segmenter_of
from teamslam.team.estimation.se2 import inverse
from teamslam.team.estimation.submap import Became
from teamslam.team.pairs import FEEDBACK
from teamslam.team.rejection import BY_CORE, Rejection
from teamslam.team.robot.maps import Cloud, InitialPose, thin_out

NOTHING_SEEN = Scan(np.empty(0, np.uint32), np.empty(0), np.empty(0))


class RunningEstimator:
    """State after every keyframe; its map is published once per window, or at every keyframe.

    sequence: number of keyframes. associates: accepts scans without identities.
    """

    def __init__(
        self, config: RobotConfig, incarnation: int, initial: InitialPose, known: KnownMap
    ) -> None:
        self._config = config
        self._filter = FILTERS[config.estimator]
        self.associates = self._filter.took is not None and config.fusion == "alone"
        self._taken: list[slice] = []
        self._looks: list[core.TimedScan] = []
        maps_at_keyframes = config.fusion in FEEDBACK
        self._map_every_ns = 0 if maps_at_keyframes else round(config.front_end.window_s * 1e9)
        keyframe_s = config.front_end.keyframe_s
        self._segmenter = segmenter_of(config.motion, config.sensor, keyframe_s)
        self._generator = generator(config.seed, config.id, incarnation, 0)
        self._map_ns: int | None = None
        self._innovation = NOTHING
        self._unsaid = NOTHING
        self._mount = np.array(config.sensor.mount)
        start = initial
        if initial.pose is not None:
            start = InitialPose(*start_of_sensor(initial.pose, initial.covariance, self._mount))
        self._state: Any = self._filter.initial_state(config, start, known, self._generator)
        self.sequence = 0
        self.last_keyframe_ns: int | None = None

    @property
    def used(self) -> str:
        """Disposition of a measurement that it uses."""
        return self._filter.used

    @property
    def joint(self) -> bool:
        """Whether its map has a joint covariance."""
        return self._filter.joint

    @property
    def innovation(self) -> Innovation:
        """Innovation of all keyframes so far."""
        return self._innovation.plus(self._unsaid)

    def observe(self, stamp_ns: int, scan: Scan) -> Rejection | None:
        """Process a scan (ids, ranges, bearings); return the reason of a rejection."""
        if not self._filter.looks:
            return Rejection.NO_LANDMARKS
        if scan.own.size and not self._filter.claims and not scan.is_unnamed:
            return Rejection.CLAIMS
        return BY_CORE[self._segmenter.observe(stamp_ns, scan)]

    def drive(self, interval: core.OdometryInterval, *, measured: bool = True) -> Estimates:
        """Process one odometry interval and its keyframes."""
        stamp_ns, begin_ns = interval.end_ns, interval.end_ns - interval.duration_ns
        if self._segmenter.now_ns is None:
            self._segmenter.begin(begin_ns)
            self._map_ns = begin_ns
        before = self.sequence
        self._segmenter.integrate(interval, measured)
        for keyframe in self._segmenter.take_keyframes():
            self._take(keyframe)
        if not self._filter.looks:
            self._advance(stamp_ns, Increment(*self._segmenter.cut(stamp_ns).motion))
        return self._driven(before, last=False)

    def _driven(self, before: int, *, last: bool) -> Estimates:
        now_ns = self.last_keyframe_ns
        if now_ns is None or self._map_ns is None:
            return Estimates()
        pose_ns = now_ns if self.sequence > before else None
        fresh = self.sequence > before or (last and now_ns != self._map_ns)
        if not fresh or not (last or now_ns - self._map_ns >= self._map_every_ns):
            return Estimates(pose_ns=pose_ns)
        self._map_ns = now_ns
        judged, self._unsaid = self._unsaid, NOTHING
        self._innovation = self._innovation.plus(judged)
        map_ns = now_ns if self._filter.maps else None
        innovation = (judged, now_ns) if judged.dof else None
        return Estimates(
            pose_ns=pose_ns, map_ns=map_ns, cloud=self._cloud(map_ns), judged=innovation
        )

    def _cloud(self, map_ns: int | None) -> Callable[[], Cloud] | None:
        if map_ns is None or self._filter.particles is None:
            return None
        return partial(thin_out, self._filter.particles(self._state), np.zeros(3))

    def _take(self, keyframe: core.Keyframe) -> None:
        for look in keyframe.looks:
            self._looks.append(look)
            first = self._took()
            assert look.motion is not None
            self._advance(look.at_ns, Increment(*look.motion), look.scan)
            self._taken.append(slice(first, self._took()))
        motion = Increment(*(keyframe.motion if keyframe.rest is None else keyframe.rest))
        if not keyframe.looks or len(keyframe.scan) or motion.mean.any():
            self._advance(keyframe.stamp_ns, motion, keyframe.scan)

    def _became(self) -> Became | None:
        if not self._looks or self._filter.took is None:
            return None
        numbers = self._filter.took(self._state)
        of_look = [
            numbers[taken] if len(numbers[taken]) == len(look.scan) else np.zeros(len(look.scan))
            for look, taken in zip(self._looks, self._taken, strict=True)
        ]
        landmarks = np.concatenate(of_look).astype(np.int64)
        return Became(
            stamps=np.array([look.stamp_ns for look in self._looks], np.int64),
            counts=np.array([len(look.scan) for look in self._looks], np.int64),
            rows=np.concatenate([look.scan.ids for look in self._looks]).astype(np.int64) - UNNAMED,
            landmarks=landmarks,
            clutter=np.zeros(len(landmarks), np.bool_),
        )

    def _took(self) -> int:
        return 0 if self._filter.took is None else len(self._filter.took(self._state))

    def _advance(self, stamp_ns: int, increment: Increment, scan: Scan = NOTHING_SEEN) -> None:
        seen = scan.ids, scan.ranges, scan.bearings, scan.own
        step = RobotStep(self._config.id, increment, self._config.sensor, *seen)
        after = self._after(step)
        if after is None:  # no solution with the measurements: the motion alone
            after = self._after(step.blind)
        if after is not None:
            self._state, judged = after
            self._unsaid = self._unsaid.plus(judged)
        self.sequence += 1
        self.last_keyframe_ns = stamp_ns

    def _after(self, step: RobotStep) -> tuple[Any, Innovation] | None:
        judged = NOTHING
        with np.errstate(all="ignore"):
            with suppress(NotACovarianceError):  # without an innovation
                judged = self._filter.innovation(self._state, step)
            try:
                state = self._filter.filter_step(self._state, step, self._generator)
                pose = self._filter.pose(state)
            except (NotACovarianceError, np.linalg.LinAlgError):
                return None
        finite = np.isfinite(pose.mean).all() and np.isfinite(pose.covariance).all()
        return (state, judged) if finite else None

    def finish(self) -> tuple[Estimates, int]:
        """End the stream; return last keyframe and map, and unused scans."""
        uncovered = self._segmenter.uncovered
        before = self.sequence
        if self._segmenter.now_ns is not None:
            self._segmenter.cut(self._segmenter.now_ns)
            for keyframe in self._segmenter.take_keyframes():
                self._take(keyframe)
        driven = self._driven(before, last=True)
        return msgspec.structs.replace(driven, became=self._became()), uncovered

    def own_pose(self) -> PoseGaussian:
        """Pose at the last keyframe."""
        pose = self._filter.pose(self._state)
        if self._config.sensor.is_mounted:
            pose = pose.moved_by(inverse(self._mount))
        return PoseGaussian(pose.mean, pose.covariance + POSE_FLOOR)

    def own_map(self) -> LandmarkGaussian:
        """Landmarks so far."""
        return self._filter.landmarks(self._state)

    def absorb(self, landmarks: LandmarkGaussian) -> None:
        """Replace the landmarks by the fused ones."""
        if self._filter.absorbed is None:
            raise TypeError(f"the estimator {self._config.estimator} absorbs no map")
        self._state = self._filter.absorbed(self._state, *landmarks)
