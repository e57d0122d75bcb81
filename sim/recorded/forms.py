"""Odometry and scans of a log in their measured forms; a stream may mix forms."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from teamslam.sim.datasets.detections_table import merge_detections
from teamslam.sim.world.streams import NO_LABEL, Detections, Intervals
from teamslam.team import translate
from teamslam.team.estimation.scans import Scan
from teamslam.team.shapes import Float, Int64, UInt32
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids, stamps

FORM_NAMES = {
    m.Odometry: "speeds",
    m.Steering: "wheel speeds and steering",
    m.Increment: "motions",
    m.Observations: "ranges and bearings",
    m.Points: "points",
    m.Detections: "detections without identities",
}
"""Names of the forms of measurements."""


def forms_of(messages: Sequence[m.Measurement]) -> str:
    """Describe the forms of these messages with their counts if there are several; else ""."""
    kinds = [type(each) for each in messages]
    counts = {kind: kinds.count(kind) for kind in FORM_NAMES if kind in kinds}
    if len(counts) < 2:
        return ""
    return ", ".join(f"{count} of {FORM_NAMES[kind]}" for kind, count in counts.items())


def intervals_of(robot: str, odometry: Sequence[m.AnyOdometry], clock_offset_s: float) -> Intervals:
    """Intervals in their own forms; raises ValueError if speeds are of two kinds.

    clock_offset_s: corrected offset of the odometry's clock [s].
    """
    ends = [translate.team_time_of(each, clock_offset_s) for each in odometry]
    speeds = np.zeros((len(odometry), 2))
    motions, claims = np.full((len(odometry), 3), np.nan), np.full((len(odometry), 3, 3), np.nan)
    for k, each in enumerate(odometry):
        match each:
            case m.Increment():
                motions[k] = floats(each.increment, "increment")
                if each.covariance:
                    claims[k] = floats(each.covariance, "covariance").reshape(3, 3)
            case m.Steering():
                speeds[k] = each.wheel_speed, each.steering
            case m.Odometry():
                speeds[k] = each.forward, each.yaw_rate
    kinds = {type(each) for each in odometry} - {m.Increment}
    if len(kinds) > 1:
        raise ValueError(
            f"{robot}: its odometry has {forms_of(odometry)}; speeds are of one kind in a stream"
        )
    return Intervals(
        end_ns=np.array(ends, dtype=np.int64),
        duration_ns=np.array([each.duration_ns for each in odometry], dtype=np.int64),
        forward=speeds[:, 0],
        yaw_rate=speeds[:, 1],
        steered=kinds == {m.Steering},
        increments=None if np.isnan(motions).all() else motions,
        covariances=None if np.isnan(claims).all() else claims,
    )


def landmarks_of(
    messages: Sequence[m.AnyScan | m.Detections], labels: m.TruthLabels | None
) -> Detections:
    """Scans, message by message, with and without identities; labels: for those without."""
    named = [each for each in messages if not isinstance(each, m.Detections)]
    unnamed = [each for each in messages if isinstance(each, m.Detections) and each.ranges]
    seen = _scans(named, [translate.scan_of(each) for each in named])
    if not unnamed:
        return seen
    scans = [translate.scan_of(each) for each in unnamed]
    known = {} if labels is None else _index_by_time(labels)
    nothing = np.empty(0, np.uint32)
    own = [
        given if len(given) == len(scan.ids) else np.full(len(scan.ids), NO_LABEL, np.uint32)
        for each, scan in zip(unnamed, scans, strict=True)
        for given in (known.get(each.stamp_ns, nothing),)
    ]
    found = _scans(unnamed, [s._replace(ids=i) for s, i in zip(scans, own, strict=True)])
    signatures = [floats(each.signatures, "signatures") for each in unnamed]
    whole = all(each.signatures for each in unnamed)
    counts = [len(scan.ids) for scan in scans]
    classes = [translate.classes_of(m_, n) for m_, n in zip(unnamed, counts, strict=True)]
    alike = len({rows.shape[1] for rows in classes}) == 1 and classes[0].shape[1] > 0
    hidden = replace(
        found,
        points=None,
        hidden=np.ones(len(unnamed), np.bool_),
        signatures=np.concatenate(signatures) if whole else None,
        classes=np.concatenate(classes) if alike else None,
    )
    return merge_detections(seen, hidden)


def _index_by_time(labels: m.TruthLabels) -> Mapping[int, UInt32[np.ndarray, " R"]]:
    ends = np.cumsum(ids(labels.counts, "counts").astype(np.int64))
    parts = np.split(ids(labels.labels, "labels").astype(np.uint32), ends[:-1])
    return dict(zip(stamps(labels.stamps, "stamps").tolist(), parts, strict=True))


def _scans(messages: Sequence[m.AnyScan | m.Detections], scans: Sequence[Scan]) -> Detections:
    counts = [len(scan.ids) for scan in scans]
    points: list[Float[np.ndarray, "R 2"]] = [np.empty((0, 2))]
    claims: list[Float[np.ndarray, "R 3"]] = [np.empty((0, 3))]
    for each, count in zip(messages, counts, strict=True):
        unknown = np.full((count, 3), np.nan)
        at = unknown[:, :2]
        if isinstance(each, m.Points):
            at = floats(each.positions, "positions").reshape(-1, 2)
        points.append(at)
        own = floats(each.covariances, "covariances").reshape(-1, 3)
        claims.append(own if each.covariances else unknown)
    places, covariances = np.concatenate(points), np.concatenate(claims)
    offsets: Int64[np.ndarray, " M_plus_1"] = np.concatenate(([0], np.cumsum(counts)))
    nothing = np.empty(0)
    return Detections(
        stamps_ns=np.array([each.stamp_ns for each in messages], dtype=np.int64),
        offsets=offsets.astype(np.int64),
        ids=np.concatenate([np.empty(0, np.uint32), *(scan.ids for scan in scans)]),
        ranges=np.concatenate([nothing, *(scan.ranges for scan in scans)]),
        bearings=np.concatenate([nothing, *(scan.bearings for scan in scans)]),
        points=None if np.isnan(places).all() else places,
        covariances=None if np.isnan(covariances).all() else covariances,
    )
