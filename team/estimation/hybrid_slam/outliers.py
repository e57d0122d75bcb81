"""The gate against outliers: the open window's measurements, and which of them others confirm."""

from collections.abc import Sequence

import numpy as np

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation.hybrid_slam.fastslam import noise_of, refused_by_name
from teamslam.team.estimation.hybrid_slam.keyframes import Keyframe


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
        self.begin()

    def begin(self) -> None:
        """Begin a window."""
        self._keyframes: list[Keyframe] = []
        self.gated = 0
        if self.judges:
            sensor = self._sensor
            self._consensus = core.Consensus(
                noise_of(sensor), sensor.max_range, sensor.field_of_view, self._outlier_share
            )

    def admit(self, keyframe: Keyframe) -> Keyframe:
        """Reduce the keyframe to its measurements that agree with those up to it."""
        if not self.judges:
            return keyframe
        self._keyframes.append(keyframe)
        with refused_by_name():
            self._consensus.add(
                keyframe.increment.mean,
                keyframe.increment.covariance,
                keyframe.ids,
                keyframe.ranges,
                keyframe.bearings,
                keyframe.own,
            )
        if not len(keyframe.ids):
            return keyframe
        return keyframe.only(self._consensus.agreeing()[-len(keyframe.ids) :])

    def confirm(self) -> Sequence[Keyframe]:
        """Reduce all keyframes of the window to their confirmed measurements; count the others."""
        taken = self._consensus.confirmed()
        self.gated = int(np.count_nonzero(~taken))
        bounds = np.cumsum([0, *(len(keyframe.ids) for keyframe in self._keyframes)])
        return [
            keyframe.only(taken[begin:end])
            for keyframe, begin, end in zip(self._keyframes, bounds, bounds[1:], strict=False)
        ]
