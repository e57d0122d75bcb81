"""Reduces several scans of a moment to one range and bearing for each landmark."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from jaxtyping import Float, UInt32

from team.config import UNNAMED, Sensor
from team.estimation import elementary, geometry
from team.estimation.models import Increment, located
from team.estimation.scans import SENSOR, Own, carried, mean_claim, together


@dataclass(frozen=True)
class KeyframeScan:
    """One scan at at_ns (its stamp, or the start of the odometry that covers it).

    pose: the robot's, since the keyframe's start. back: the same pose relative to the keyframe's
    end; None: it is the keyframe itself. motion: since the scan or keyframe before.
    """

    stamp_ns: int
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own
    pose: Float[np.ndarray, "3"]
    at_ns: int = 0
    motion: Increment | None = None
    back: Float[np.ndarray, "3"] | None = None

    @property
    def is_unnamed(self) -> bool:
        """Whether it has detections without identities; it has no others then."""
        return bool((self.ids >= UNNAMED).any())


Measured = tuple[UInt32[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"], Own]
"""Ids, ranges [m], bearings [rad] and the noises that they claim."""


def reduced(looks: Sequence[KeyframeScan], end: Float[np.ndarray, "3"]) -> Measured:
    """Reduce scans to one measurement per landmark, by ascending id.

    It is the median of range and bearing, moved by the odometry to the keyframe's end; its claimed
    noise is the mean of theirs.
    """
    points: dict[int, list[tuple[float, float]]] = {}
    claims: dict[int, list[Own]] = {}
    for look in looks:
        back = geometry.between(end, look.pose) if look.back is None else look.back
        for k, landmark in enumerate(look.ids):
            r, b = float(look.ranges[k]), float(look.bearings[k])
            x, y = located(back, r, b)
            points.setdefault(int(landmark), []).append(
                (elementary.hypot(x, y), elementary.atan2(y, x))
            )
            if look.own.size:
                claim = carried(look.own[k], r, float(back[2]) + b, np.array([x, y]))
                claims.setdefault(int(landmark), []).append(claim)
    ids = sorted(points)
    ranges = [median([r for r, _ in points[i]]) for i in ids]
    bearings = [_median_direction([b for _, b in points[i]]) for i in ids]
    own = together([(1, mean_claim(claims.get(i, []))) for i in ids])
    return np.array(ids, dtype=np.uint32), np.array(ranges), np.array(bearings), own


def variances(
    ranges: Float[np.ndarray, " n"], own: Own, sensor: Sensor
) -> Float[np.ndarray, "n 3"]:
    """(rr, rb, bb) of each measurement: as it claims, or the sensor's at its range."""
    of_sensor = np.column_stack(
        (
            elementary.squared(sensor.range_sigma)
            + elementary.squared(sensor.range_sigma_per_m * ranges),
            np.zeros(len(ranges)),
            np.full(len(ranges), elementary.squared(sensor.bearing_sigma)),
        )
    )
    if not own.size:
        return of_sensor
    claims = own[:, 3] != SENSOR
    return np.where(claims[:, None], own[:, :3], of_sensor)


def _median_direction(angles: list[float]) -> float:
    """The median of directions, relative to the first of them."""
    offsets = [geometry.wrapped(angle - angles[0]) for angle in angles]
    return geometry.wrapped(angles[0] + median(offsets))
