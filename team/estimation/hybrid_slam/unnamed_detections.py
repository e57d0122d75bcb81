"""Association of a window's detections without identities, when the window closes.

Until then the pose follows the odometry and the landmarks with identities. Detections are
associated once, for all particles, which run over the window again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from teamslam.team.config import UNNAMED, AssociationSettings, Sensor
from teamslam.team.estimation.association.clustering import associate_window
from teamslam.team.estimation.association.scans import UNASSIGNED, Scans, points_of
from teamslam.team.estimation.association.tracking import Slip, slip_covariance
from teamslam.team.estimation.hybrid_slam.keyframes import Keyframe
from teamslam.team.estimation.hybrid_slam.reduction import (
    KeyframeScan,
    Measured,
    reduced,
    variances,
)
from teamslam.team.estimation.models import Increment
from teamslam.team.estimation.scans import Own, together
from teamslam.team.estimation.submap import NONE_UNNAMED, Became, Slipped, Unnamed
from teamslam.team.shapes import Bool, Int64


@dataclass(frozen=True)
class AssociatedKeyframes:
    """A window's keyframes with their associated detections.

    unnamed: the landmarks without identities, and the scans that saw them. gated: number of
    detections left out. slips: of the odometry. became: the outcome of each detection.
    """

    keyframes: tuple[Keyframe, ...]
    unnamed: Unnamed = NONE_UNNAMED
    gated: int = 0
    slips: tuple[Slipped, ...] = ()
    became: Became | None = None


class Event(NamedTuple):
    """An instant of a window: a scan without identities, or the end of a keyframe.

    keyframe: its index. motion: since the event before.
    """

    at_ns: int
    keyframe: int
    motion: Increment
    look: KeyframeScan | None
    named: Keyframe | None


def associate_keyframes(
    keyframes: Sequence[Keyframe], settings: AssociationSettings, sensor: Sensor, most: int
) -> AssociatedKeyframes:
    """Associate the window's detections. Raises LinAlgError where it has no solution.

    keyframes: with measurements of named landmarks, and the scans without. most: largest number of
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


def events_of(keyframes: Sequence[Keyframe]) -> list[Event]:
    """List the scans and keyframe ends of a window by time; a keyframe that is only one scan is one
    event.
    """
    events = []
    for k, each in enumerate(keyframes):
        events += [Event(x.at_ns, k, x.motion or Increment.identity(), x, None) for x in each.looks]
        if each.rest is None or len(each.ids) or not _is_none(each.rest):
            motion = each.increment if each.rest is None else each.rest
            events.append(Event(each.stamp_ns, k, motion, None, each))
    return sorted(events, key=lambda event: event.at_ns)


def _is_none(motion: Increment) -> bool:
    return not motion.mean.any() and not motion.covariance.any()


def scans_of(events: Sequence[Event], sensor: Sensor) -> Scans:
    """Convert the window's detections to points with covariances."""
    seen = [_measurements_of(event) for event in events]
    counts = [len(ids) for ids, *_ in seen]
    ids = np.concatenate([ids for ids, *_ in seen]).astype(np.int64)
    ranges = np.concatenate([ranges for _, ranges, *_ in seen])
    bearings = np.concatenate([bearings for *_, bearings, _ in seen])
    noises = np.concatenate([variances(ranges, own, sensor) for _, ranges, _, own in seen])
    points, covariances = points_of(ranges, bearings, noises)
    return Scans(
        motions=np.array([event.motion.mean for event in events]),
        motion_covariances=np.array([event.motion.covariance for event in events]),
        keyframes=np.repeat(np.arange(len(events)), counts),
        points=points,
        covariances=covariances,
        names=np.where(ids >= UNNAMED, UNASSIGNED, ids),
    )


def _measurements_of(event: Event) -> Measured:
    source = event.named if event.look is None else event.look
    assert source is not None
    return source.ids, source.ranges, source.bearings, source.own


def _list_outcomes(
    events: Sequence[Event], landmarks: Int64[np.ndarray, " n"], clutter: Bool[np.ndarray, " n"]
) -> Became:
    looks = [event.look for event in events if event.look is not None]
    return Became(
        stamps=np.array([each.stamp_ns for each in looks], np.int64),
        counts=np.array([len(each.ids) for each in looks], np.int64),
        rows=np.concatenate([each.ids for each in looks]).astype(np.int64) - UNNAMED,
        landmarks=landmarks,
        clutter=clutter,
    )


def _number_keyframes(
    keyframes: Sequence[Keyframe],
    events: Sequence[Event],
    numbers: Int64[np.ndarray, " n"],
    slips: tuple[Slip, ...],
) -> tuple[Keyframe, ...]:
    """Add the scans' detections to their keyframes under landmark numbers (0: left out), one
    measurement per landmark; a motion that slipped gets a larger covariance.
    """
    looks: dict[int, list[KeyframeScan]] = {}
    first = 0
    for event in events:
        if event.look is not None:
            own = numbers[first : first + len(event.look.ids)]
            looks.setdefault(event.keyframe, []).append(_select_numbered(event.look, own))
            first += len(event.look.ids)
    slipped = {events[slip.keyframe].keyframe: slip_covariance(slip.by) for slip in slips}
    out = []
    for k, each in enumerate(keyframes):
        keyframe = each
        if k in looks:
            keyframe = _add_measurements(keyframe, _reduce_scans(looks[k]))
        if k in slipped:
            motion = Increment(each.increment.mean, each.increment.covariance + slipped[k])
            keyframe = replace(keyframe, increment=motion)
        out.append(replace(keyframe, looks=(), rest=None))
    return tuple(out)


def _select_numbered(look: KeyframeScan, numbers: Int64[np.ndarray, " n"]) -> KeyframeScan:
    has_number = numbers > 0
    return replace(
        look,
        ids=numbers[has_number].astype(np.uint32),
        ranges=look.ranges[has_number],
        bearings=look.bearings[has_number],
        own=look.own[has_number],
    )


def _reduce_scans(looks: Sequence[KeyframeScan]) -> Measured:
    """Reduce a keyframe's scans to its end; a scan that is the keyframe stays."""
    if len(looks) == 1 and looks[0].back is None:
        (look,) = looks
        return look.ids, look.ranges, look.bearings, look.own
    return reduced([(look, np.zeros(3) if look.back is None else look.back) for look in looks])


def _add_measurements(keyframe: Keyframe, seen: Measured) -> Keyframe:
    ids, ranges, bearings, own = seen
    parts: list[tuple[int, Own]] = [(len(keyframe.ids), keyframe.own), (len(ids), own)]
    return replace(
        keyframe,
        ids=np.concatenate((keyframe.ids, ids)),
        ranges=np.concatenate((keyframe.ranges, ranges)),
        bearings=np.concatenate((keyframe.bearings, bearings)),
        own=together(parts),
    )
