"""Association of a window's detections without identities, when the window closes.

Until then the pose follows the odometry and named landmarks. Detections are associated once for all
particles, which then run over the window again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import UNNAMED, AssociationSettings, Sensor
from teamslam.team.core import Scan
from teamslam.team.estimation.association.clustering import associate_window
from teamslam.team.estimation.association.scans import UNASSIGNED, Scans, points_of
from teamslam.team.estimation.association.tracking import Slip, slip_covariance
from teamslam.team.estimation.models import Increment, variances
from teamslam.team.estimation.se2 import Pose
from teamslam.team.estimation.submap import NONE_UNNAMED, Became, Slipped, Unnamed
from teamslam.team.shapes import Bool, Int64


@dataclass(frozen=True)
class AssociatedKeyframes:
    """A window's keyframes with their associated detections.

    unnamed: landmarks without identities, and the scans that observed them. gated: number of
    detections left out. became: outcome of each detection.
    """

    keyframes: tuple[core.Keyframe, ...]
    unnamed: Unnamed = NONE_UNNAMED
    gated: int = 0
    slips: tuple[Slipped, ...] = ()
    became: Became | None = None


class Event(NamedTuple):
    """An instant of a window: a scan without identities, or the end of a keyframe.

    keyframe: its index. motion: since the previous event. look: of a scan without identities.
    """

    at_ns: int
    keyframe: int
    motion: Increment
    scan: Scan
    look: core.TimedScan | None = None


def associate_keyframes(
    keyframes: Sequence[core.Keyframe], settings: AssociationSettings, sensor: Sensor, most: int
) -> AssociatedKeyframes:
    """Associate the window's detections. Raises LinAlgError without a solution.

    keyframes: with measurements of named landmarks, and scans of others. most: largest number of
    landmarks of a submap; those with the most detections stay.
    """
    events = events_of(keyframes)
    scans = scans_of(events, sensor)
    found = associate_window(scans, settings)
    is_detection = scans.names == UNASSIGNED
    order = np.argsort(-found.counts, kind="stable")[:most]
    has_number = np.isin(found.landmark_of, order) & (found.landmark_of != UNASSIGNED)
    local = np.nonzero((found.names == UNASSIGNED) & np.isin(np.arange(len(found.names)), order))[0]
    number = np.zeros(len(found.names) + 1, np.int64)  # the last is for UNASSIGNED
    number[local] = UNNAMED + np.arange(len(local))
    numbers = np.where(has_number, number[found.landmark_of], 0)[is_detection]
    with_detections = np.array([each.look is not None for each in events], np.bool_)
    became = _list_outcomes(events, numbers, found.clutter[is_detection])
    return AssociatedKeyframes(
        keyframes=_number_keyframes(keyframes, events, numbers, found.slips),
        unnamed=Unnamed(
            found.counts[local].astype(np.uint32), found.seen[local][:, with_detections]
        ),
        gated=int(np.count_nonzero(numbers == 0)),
        slips=tuple(Slipped(events[slip.keyframe].at_ns, slip.by) for slip in found.slips),
        became=became,
    )


def events_of(keyframes: Sequence[core.Keyframe]) -> list[Event]:
    """List the scans and keyframe ends of a window by time; a keyframe of a single scan is one
    event.
    """
    events = []
    for k, each in enumerate(keyframes):
        for look in each.looks:
            since = Increment.identity() if look.motion is None else Increment(*look.motion)
            events.append(Event(look.at_ns, k, since, look.scan, look))
        rest = each.rest
        if rest is None or len(each.scan) or any(part.any() for part in rest):
            motion = Increment(*(each.motion if rest is None else rest))
            events.append(Event(each.stamp_ns, k, motion, each.scan))
    return sorted(events, key=lambda event: event.at_ns)


def scans_of(events: Sequence[Event], sensor: Sensor) -> Scans:
    """Convert the window's detections to points with covariances."""
    seen = [event.scan for event in events]
    counts = [len(scan) for scan in seen]
    ids = np.concatenate([scan.ids for scan in seen]).astype(np.int64)
    ranges = np.concatenate([scan.ranges for scan in seen])
    bearings = np.concatenate([scan.bearings for scan in seen])
    noises = np.concatenate([variances(scan.ranges, scan.own, sensor) for scan in seen])
    points, covariances = points_of(ranges, bearings, noises)
    return Scans(
        motions=np.array([event.motion.mean for event in events]),
        motion_covariances=np.array([event.motion.covariance for event in events]),
        keyframes=np.repeat(np.arange(len(events)), counts),
        points=points,
        covariances=covariances,
        names=np.where(ids >= UNNAMED, UNASSIGNED, ids),
    )


def _list_outcomes(
    events: Sequence[Event], landmarks: Int64[np.ndarray, " n"], clutter: Bool[np.ndarray, " n"]
) -> Became:
    looks = [event.look for event in events if event.look is not None]
    return Became(
        stamps=np.array([each.stamp_ns for each in looks], np.int64),
        counts=np.array([len(each.scan) for each in looks], np.int64),
        rows=np.concatenate([each.scan.ids for each in looks]).astype(np.int64) - UNNAMED,
        landmarks=landmarks,
        clutter=clutter,
    )


def _number_keyframes(
    keyframes: Sequence[core.Keyframe],
    events: Sequence[Event],
    numbers: Int64[np.ndarray, " n"],
    slips: tuple[Slip, ...],
) -> tuple[core.Keyframe, ...]:
    """Add the detections to their keyframes by landmark number (0: left out), one per landmark;
    enlarge the covariance of motions that slipped.
    """
    looks: dict[int, list[tuple[Scan, Pose | None]]] = {}
    first = 0
    for event in events:
        if event.look is not None:
            own = numbers[first : first + len(event.scan)]
            numbered = _select_numbered(event.scan, own)
            looks.setdefault(event.keyframe, []).append((numbered, event.look.back))
            first += len(event.scan)
    slipped = {events[slip.keyframe].keyframe: slip_covariance(slip.by) for slip in slips}
    out = []
    for k, each in enumerate(keyframes):
        scan, (mean, covariance) = each.scan, each.motion
        if k in looks:
            scan = scan.together(_reduce_scans(looks[k]))
        if k in slipped:
            covariance = covariance + slipped[k]
        out.append(
            core.Keyframe(
                each.stamp_ns, (mean, covariance), scan, is_node=each.is_node, shift=each.shift
            )
        )
    return tuple(out)


def _select_numbered(scan: Scan, numbers: Int64[np.ndarray, " n"]) -> Scan:
    has_number = numbers > 0
    chosen = scan.only(has_number)
    named = numbers[has_number].astype(np.uint32)
    return Scan(named, chosen.ranges, chosen.bearings, chosen.own)


def _reduce_scans(looks: Sequence[tuple[Scan, Pose | None]]) -> Scan:
    if len(looks) == 1 and looks[0][1] is None:
        return looks[0][0]
    poses = np.array([np.zeros(3) if back is None else back for _, back in looks])
    return core.reduce_scans([scan for scan, _ in looks], poses)
