"""The gate against outliers: the open window's measurements, and which of them others confirm."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import Sensor
from team.estimation.hybrid_slam.consensus import agreeing, confirmed
from team.estimation.hybrid_slam.keyframes import Keyframe
from team.estimation.models import Increment
from team.estimation.scans import Own, together


class OutlierGate:
    """Accepts measurements that agree with others of the same window; keeps nothing beyond its end.

    While the window is open, a measurement is accepted if earlier ones, or others at the same time,
    agree with it. For the submap all are compared with all others, since the first measurement of a
    landmark can only be confirmed by a later one.

    judges: whether outliers are expected; otherwise all measurements are accepted.
    """

    def __init__(self, sensor: Sensor, outlier_share: float) -> None:
        self._sensor = sensor
        self._outlier_share = outlier_share
        self.judges = outlier_share > 0.0
        self._keyframes: list[Keyframe] = []
        self.gated = 0

    def begin(self) -> None:
        """Begin a window."""
        self._keyframes = []
        self.gated = 0

    def admit(self, keyframe: Keyframe) -> Keyframe:
        """Reduce the keyframe to its measurements that agree with those up to it."""
        if not self.judges:
            return keyframe
        self._keyframes.append(keyframe)
        if not len(keyframe.ids):
            return keyframe
        taken = agreeing(*self._all(), self._sensor, self._outlier_share)
        return keyframe.only(taken[-len(keyframe.ids) :])

    def confirm(self) -> Sequence[Keyframe]:
        """Reduce all keyframes of the window to their confirmed measurements; count the others."""
        taken = confirmed(*self._all(), self._sensor, self._outlier_share)
        self.gated = int(np.count_nonzero(~taken))
        bounds = np.cumsum([0, *(len(keyframe.ids) for keyframe in self._keyframes)])
        return [
            keyframe.only(taken[begin:end])
            for keyframe, begin, end in zip(self._keyframes, bounds, bounds[1:], strict=False)
        ]

    def _all(
        self,
    ) -> tuple[
        list[Increment],
        Int64[np.ndarray, " N"],
        UInt32[np.ndarray, " N"],
        Float[np.ndarray, "N 2"],
        Own,
    ]:
        keyframes = self._keyframes
        counts = [len(keyframe.ids) for keyframe in keyframes]
        measurements = [
            np.column_stack((keyframe.ranges, keyframe.bearings)) for keyframe in keyframes
        ]
        return (
            [keyframe.increment for keyframe in keyframes],
            np.repeat(np.arange(len(keyframes)), counts),
            np.concatenate([np.empty(0, np.uint32), *(keyframe.ids for keyframe in keyframes)]),
            np.concatenate([np.empty((0, 2)), *measurements]),
            together([(len(keyframe.ids), keyframe.own) for keyframe in keyframes]),
        )
