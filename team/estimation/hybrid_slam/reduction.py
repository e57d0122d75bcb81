"""Reduces several scans of a moment to one range and bearing for each landmark."""

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int64, UInt32

from team.config import UNNAMED, Sensor
from team.estimation import elementary, geometry
from team.estimation.compiled import compiled
from team.estimation.geometry import Pose
from team.estimation.models import Increment, located
from team.estimation.scans import SENSOR, Own, carried, mean_claim, together, unclaimed


class KeyframeScan(msgspec.Struct, frozen=True, gc=False):
    """One scan at at_ns (its stamp, or the start of the odometry that covers it).

    back: the robot's pose relative to the keyframe's end; None: it is the keyframe itself, or that
    end is still to come. motion: since the scan or keyframe before.
    """

    stamp_ns: int
    ids: UInt32[np.ndarray, " n"]
    ranges: Float[np.ndarray, " n"]
    bearings: Float[np.ndarray, " n"]
    own: Own
    at_ns: int = 0
    motion: Increment | None = None
    back: Pose | None = None

    @property
    def is_unnamed(self) -> bool:
        """Whether it has detections without identities; it has no others then."""
        return max(self.ids.tolist(), default=0) >= UNNAMED


Measured = tuple[UInt32[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"], Own]
"""Ids, ranges [m], bearings [rad] and the noises that they claim."""


def reduced(placed: Sequence[tuple[KeyframeScan, Pose]]) -> Measured:
    """Reduce scans to one measurement per landmark, by ascending id; each scan with its pose
    relative to the keyframe's end.

    It is the median of range and bearing, moved by the odometry to the keyframe's end; its claimed
    noise is the mean of theirs.
    """
    if not placed:
        return np.empty(0, np.uint32), np.empty(0), np.empty(0), unclaimed(0)
    looks = [look for look, _ in placed]
    ids, ranges, bearings = _medians(
        np.concatenate([look.ids for look in looks]),
        np.concatenate([look.ranges for look in looks]),
        np.concatenate([look.bearings for look in looks]),
        np.repeat(np.arange(len(looks)), [len(look.ids) for look in looks]),
        np.array([back for _, back in placed]),
    )
    if not any(look.own.size for look in looks):
        return ids, ranges, bearings, unclaimed(len(ids))
    claims: dict[int, list[Own]] = {}
    for look, back in placed:
        for k in range(len(look.ids) if look.own.size else 0):
            r, b = float(look.ranges[k]), float(look.bearings[k])
            claim = carried(look.own[k], r, float(back[2]) + b, located(back, r, b))
            claims.setdefault(int(look.ids[k]), []).append(claim)
    own = together([(1, mean_claim(claims.get(i, []))) for i in ids.tolist()])
    return ids, ranges, bearings, own


@compiled
def all_between(end: Pose, poses: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Each pose seen from the end: `geometry.between`."""
    found = np.empty_like(poses)
    for k in range(len(poses)):
        pose = geometry.between(end, poses[k])
        found[k, 0], found[k, 1], found[k, 2] = pose[0], pose[1], pose[2]
    return found


@compiled
def _medians(
    ids: UInt32[np.ndarray, " n"],
    ranges: Float[np.ndarray, " n"],
    bearings: Float[np.ndarray, " n"],
    scans: Int64[np.ndarray, " n"],
    backs: Float[np.ndarray, "m 3"],
) -> tuple[UInt32[np.ndarray, " u"], Float[np.ndarray, " u"], Float[np.ndarray, " u"]]:
    """Ascending ids, and the median range and direction of each as seen from the keyframe's end;
    scans: the row of each measurement's pose in `backs`. The median of directions is relative to
    the first of them.
    """
    n = len(ids)
    distances, directions = np.empty(n), np.empty(n)
    for k in range(n):
        point = located(backs[scans[k]], ranges[k], bearings[k])
        distances[k] = elementary.hypot(point[0], point[1])
        directions[k] = elementary.atan2(point[1], point[0])
    found, medians = np.empty(n, np.uint32), np.empty((2, n))
    own, offsets = np.empty(n), np.empty(n)
    count, last, beyond = 0, np.int64(-1), np.int64(1 << 32)
    while True:
        following = beyond
        for k in range(n):
            if last < ids[k] < following:
                following = np.int64(ids[k])
        if following == beyond:
            return found[:count].copy(), medians[0, :count].copy(), medians[1, :count].copy()
        size, first = 0, 0.0
        for k in range(n):
            if ids[k] == following:
                first = directions[k] if size == 0 else first
                _insert(own, size, distances[k])
                _insert(offsets, size, geometry.wrapped(directions[k] - first))
                size += 1
        found[count] = following
        medians[0, count] = _median(own, size)
        medians[1, count] = geometry.wrapped(first + _median(offsets, size))
        count, last = count + 1, following


@compiled
def _insert(row: Float[np.ndarray, " n"], size: int, value: float) -> None:
    """Puts a number into its place among the first `size`, which ascend."""
    while size > 0 and row[size - 1] > value:
        row[size] = row[size - 1]
        size -= 1
    row[size] = value


@compiled
def _median(row: Float[np.ndarray, " n"], size: int) -> float:
    """The median of the first `size` numbers, which ascend."""
    middle = size // 2
    found: float = row[middle] if size % 2 else (row[middle - 1] + row[middle]) / 2.0
    return found


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
