"""An open window's detections without identities, and what they are at its end.

While the window is open its pose follows the odometry and the landmarks with names alone. At its
close the detections are associated once, and the particles take the window again with them. No
particle has an association of its own: there is one, and nothing is averaged over many.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt32

from team.config import UNNAMED, Association, Sensor
from team.estimation.association.association import associated
from team.estimation.association.scans import NOBODY, Scans, points_of
from team.estimation.association.tracking import Slip, slip_covariance
from team.estimation.hybrid_slam.keyframes import Keyframe
from team.estimation.models import Increment
from team.estimation.scans import SENSOR
from team.estimation.submap import NONE_UNNAMED, Became, Slipped, Unnamed


@dataclass(frozen=True)
class Settled:
    """A window's keyframes with their associated detections, and what stayed out.

    unconfirmed, clutter: scans of which no detection is in the submap. gated: detections that stay
    out. slips: motions that the odometry missed. became: what became of each detection.
    """

    keyframes: tuple[Keyframe, ...]
    unnamed: Unnamed = NONE_UNNAMED
    unconfirmed: int = 0
    clutter: int = 0
    gated: int = 0
    slips: tuple[Slipped, ...] = ()
    became: Became | None = None


def split(keyframe: Keyframe) -> tuple[Keyframe, Keyframe]:
    """The keyframe with its measurements of landmarks with names, and with the others alone."""
    named = keyframe.ids < UNNAMED
    return keyframe.only(named), keyframe.only(~named)


def settled(
    named: list[Keyframe],
    unnamed: list[Keyframe],
    settings: Association,
    sensor: Sensor,
    most: int,
) -> Settled:
    """The window with its detections associated; raises LinAlgError where it has no solution.

    named, unnamed: each keyframe with its measurements of either kind. most: landmarks of a submap;
    those that were seen most often stay.
    """
    both = [_joined(a, b) for a, b in zip(named, unnamed, strict=True)]
    scans = scans_of(both, sensor)
    found = associated(scans, settings)
    is_detection = scans.names == NOBODY
    order = np.argsort(-found.counts, kind="stable")[:most]
    kept = np.isin(found.landmark_of, order) & (found.landmark_of != NOBODY)
    kept |= ~is_detection
    local = np.nonzero((found.names == NOBODY) & np.isin(np.arange(len(found.names)), order))[0]
    number = np.zeros(len(found.names) + 1, np.int64)  # the last is that of NOBODY
    number[local] = UNNAMED + np.arange(len(local))
    ids = np.where(is_detection, number[found.landmark_of], scans.names).astype(np.uint32)
    with_detections = np.array([len(each.ids) > 0 for each in unnamed], np.bool_)
    silent, clutter = _silent(scans, kept, found.clutter, is_detection)
    return Settled(
        keyframes=_keyframes(both, ids, kept, found.slips),
        unnamed=Unnamed(
            found.counts[local].astype(np.uint32), found.seen[local][:, with_detections]
        ),
        unconfirmed=silent - clutter,
        clutter=clutter,
        gated=int(np.count_nonzero(~kept)),
        slips=tuple(Slipped(both[slip.keyframe].stamp_ns, slip.by) for slip in found.slips),
        became=_became(
            unnamed,
            np.where(kept, ids, 0)[is_detection].astype(np.int64),
            found.clutter[is_detection],
        ),
    )


def _became(
    unnamed: list[Keyframe], landmarks: Int64[np.ndarray, " n"], clutter: Bool[np.ndarray, " n"]
) -> Became:
    """By the stamps of the scans and the detections' places in them."""
    seen = [each for each in unnamed if len(each.ids)]
    return Became(
        stamps=np.array([each.stamp_ns for each in seen], np.int64),
        counts=np.array([len(each.ids) for each in seen], np.int64),
        rows=np.concatenate([each.ids for each in seen]).astype(np.int64) - UNNAMED,
        landmarks=landmarks,
        clutter=clutter,
    )


def _joined(named: Keyframe, unnamed: Keyframe) -> Keyframe:
    """Both kinds of measurements of one keyframe; a message has one kind, so one of them is empty
    (or a scan told both, whose noises are alike).
    """
    if not len(named.ids) or not len(unnamed.ids):
        return unnamed if len(unnamed.ids) else named
    return replace(
        named,
        ids=np.concatenate((named.ids, unnamed.ids)),
        ranges=np.concatenate((named.ranges, unnamed.ranges)),
        bearings=np.concatenate((named.bearings, unnamed.bearings)),
        own=np.concatenate((named.own, unnamed.own)),
    )


def scans_of(keyframes: list[Keyframe], sensor: Sensor) -> Scans:
    """The window's measurements as the association takes them: points, with their noise."""
    counts = [len(each.ids) for each in keyframes]
    ids = np.concatenate([each.ids for each in keyframes]).astype(np.int64)
    ranges = np.concatenate([each.ranges for each in keyframes])
    bearings = np.concatenate([each.bearings for each in keyframes])
    variances = np.concatenate([_variances(each, sensor) for each in keyframes])
    points, covariances = points_of(ranges, bearings, variances)
    return Scans(
        motions=np.array([each.increment.mean for each in keyframes]),
        motion_covariances=np.array([each.increment.covariance for each in keyframes]),
        keyframes=np.repeat(np.arange(len(keyframes)), counts),
        points=points,
        covariances=covariances,
        names=np.where(ids >= UNNAMED, NOBODY, ids),
    )


def _variances(keyframe: Keyframe, sensor: Sensor) -> Float[np.ndarray, "n 3"]:
    """(rr, rb, bb) of each measurement: what it claims itself, or the sensor's at its range."""
    ranges = keyframe.ranges
    of_sensor = np.column_stack(
        (
            sensor.range_sigma**2 + (sensor.range_sigma_per_m * ranges) ** 2,
            np.zeros(len(ranges)),
            np.full(len(ranges), sensor.bearing_sigma**2),
        )
    )
    if not keyframe.own.size:
        return of_sensor
    claims = keyframe.own[:, 3] != SENSOR
    return np.where(claims[:, None], keyframe.own[:, :3], of_sensor)


def _keyframes(
    both: list[Keyframe],
    ids: UInt32[np.ndarray, " N"],
    kept: Bool[np.ndarray, " N"],
    slips: tuple[Slip, ...],
) -> tuple[Keyframe, ...]:
    """The keyframes with these numbers; a motion that slipped is that much less sure."""
    slipped = {slip.keyframe: slip_covariance(slip.by) for slip in slips}
    bounds = np.cumsum([0, *(len(each.ids) for each in both)])
    out = []
    for k, (each, begin, end) in enumerate(zip(both, bounds, bounds[1:], strict=False)):
        keyframe = replace(each, ids=ids[begin:end]).only(kept[begin:end])
        if k in slipped:
            motion = Increment(each.increment.mean, each.increment.covariance + slipped[k])
            keyframe = replace(keyframe, increment=motion)
        out.append(keyframe)
    return tuple(out)


def _silent(
    scans: Scans,
    kept: Bool[np.ndarray, " N"],
    clutter: Bool[np.ndarray, " N"],
    is_detection: Bool[np.ndarray, " N"],
) -> tuple[int, int]:
    """Scans with detections none of which is kept: how many, and of them those of clutter alone."""
    k = len(scans.motions)
    count = _counted(scans.keyframes[is_detection], k)
    used = _counted(scans.keyframes[is_detection & kept], k)
    false = _counted(scans.keyframes[is_detection & clutter], k)
    silent = (count > 0) & (used == 0)
    return int(silent.sum()), int((silent & (false == count)).sum())


def _counted(keyframes: Int64[np.ndarray, " n"], k: int) -> Int64[np.ndarray, " K"]:
    return np.bincount(keyframes, minlength=k)
