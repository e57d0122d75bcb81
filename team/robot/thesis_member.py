"""Hybrid-SLAM as in Xu's thesis on one robot's readings: reset to the mean at every epoch."""

import numpy as np
from jaxtyping import Float

from team.config import RobotConfig
from team.estimation import hybrid_thesis
from team.estimation.hybrid_thesis import ThesisState
from team.estimation.randomness import generator
from team.robot.segmenter import Segmenter


class ThesisMember:
    """The state after every epoch so far; it is published whole and replaced by what was fused."""

    def __init__(self, config: RobotConfig, epoch: int) -> None:
        self._config = config
        self._segmenter = Segmenter(config.motion, config.sensor, config.front_end.keyframe_s)
        self._generator = generator(config.seed, config.id, epoch, 0)
        self.state: ThesisState = hybrid_thesis.started(np.zeros(3))
        self.epochs = 0
        self.last_epoch_ns: int | None = None

    def start(self, pose: Float[np.ndarray, "3"] | None) -> None:
        """The start pose; the thesis knows it exactly."""
        self.state = hybrid_thesis.started(np.zeros(3) if pose is None else pose)

    def observe(self, stamp_ns: int, scan: tuple[np.ndarray, np.ndarray, np.ndarray]) -> str | None:
        """Take a scan (ids, ranges, bearings); the reason if it is rejected."""
        return self._segmenter.observe(stamp_ns, *scan)

    def drive(self, stamp_ns: int, duration_ns: int, forward: float, yaw_rate: float) -> None:
        """Take one odometry interval and run the epochs that lie in it."""
        if self._segmenter.now_ns is None:
            self._segmenter.begin(stamp_ns - duration_ns)
        for epoch in self._segmenter.drive(stamp_ns, duration_ns, forward, yaw_rate):
            self.state = hybrid_thesis.stepped(
                self.state,
                epoch.increment,
                self._config.sensor,
                epoch.ids,
                epoch.ranges,
                epoch.bearings,
                self._config.front_end.particles,
                self._generator,
            )
            self.epochs += 1
            self.last_epoch_ns = epoch.stamp_ns

    @property
    def uncovered(self) -> int:
        """Scans that no odometry covered."""
        return self._segmenter.uncovered

    def absorb(
        self,
        ids: np.ndarray,
        means: Float[np.ndarray, "L 2"],
        blocks: Float[np.ndarray, "L 2 2"],
    ) -> None:
        """Replace the landmarks by the fused ones (section 5.1 of the thesis)."""
        self.state = hybrid_thesis.absorbed(self.state, ids, means, blocks)
