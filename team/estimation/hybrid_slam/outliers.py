"""The gate against outliers: measurements of the open window that others contradict."""

from collections.abc import Sequence

from teamslam.team import core
from teamslam.team.config import Sensor
from teamslam.team.estimation.gaussian import CoreErrors
from teamslam.team.estimation.hybrid_slam.keyframes import Keyframe
from teamslam.team.estimation.models import noise_of

OUTLIER_SHARE = 0.01
"""Probability of an outlier before the window's measurements are compared. A landmark measurement
is rejected where it is this much less likely given the others than anywhere in view; with ten times
the share a tenth of the same likelihood is needed, so the value hardly matters."""


class OutlierGate:
    """Accepts measurements that others of the same window do not contradict; keeps nothing beyond
    its end.

    While the window is open, a measurement is accepted if it agrees with the other ones of its
    landmark so far under the odometry, or is the only one. For the submap all are compared with all
    others by a smoother over the window.
    """

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self.begin()

    def begin(self) -> None:
        """Begin a window."""
        sensor = self._sensor
        self._all: list[Keyframe] = []
        self._begins = [0]
        self._consensus = core.Consensus(
            noise_of(sensor), sensor.max_range, sensor.field_of_view, OUTLIER_SHARE
        )

    @property
    def gated(self) -> int:
        """Number of measurements that are not accepted."""
        return self._consensus.rejected

    @property
    def keyframes(self) -> Sequence[Keyframe]:
        """The keyframes, reduced to their accepted measurements."""
        return [self._reduced(k) for k in range(len(self._all))]

    @property
    def last(self) -> Keyframe:
        """The last keyframe, reduced to its accepted measurements."""
        return self._reduced(len(self._all) - 1)

    def _reduced(self, k: int) -> Keyframe:
        accepted = self._consensus.accepted(self._begins[k], self._begins[k + 1])
        return self._all[k] if accepted is None else self._all[k].only(accepted)

    def add(self, keyframe: Keyframe) -> bool:
        """Add a keyframe; return whether all measurements accepted before it stay accepted."""
        self._all.append(keyframe)
        self._begins.append(self._begins[-1] + len(keyframe.ids))
        with CoreErrors():
            self._consensus.add(
                keyframe.increment.mean,
                keyframe.increment.covariance,
                keyframe.ids,
                keyframe.ranges,
                keyframe.bearings,
                keyframe.own,
            )
        return self._consensus.accept()

    def confirm(self) -> bool:
        """Compare all measurements of the window; return whether other ones are accepted now."""
        return self._consensus.confirm()
