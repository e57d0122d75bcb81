"""The association of one closed window: track, smooth, associate again, merge, drop.

The association uses no map and no other window, so that submaps stay independent. A window has one
association, which all its particles share.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from team.config import AssociationSettings
from team.estimation import dense, elementary, elementwise
from team.estimation.association.certainty import certainties
from team.estimation.association.matching import best_pairs_first, squared_distances
from team.estimation.association.scans import (
    NOBODY,
    Scans,
    rotation,
    seen_from,
)
from team.estimation.association.smoothing import Smoothed, seen_with, smoothed
from team.estimation.association.tracking import Slip, slip_covariance, tracked


@dataclass(frozen=True)
class Associated:
    """The landmark of each detection of a window.

    landmark_of: by detection, in [0, L); NOBODY for a detection that stays out. names: the identity
    of each landmark, NOBODY where it has none; sorted by name, then in the order in which the
    window saw them. counts: the number of detections of each landmark. seen: the keyframes that saw
    it. slips: where the odometry was wrong. clutter: for each detection that stays out, whether its
    place was observed again without finding it.
    """

    landmark_of: Int64[np.ndarray, " N"]
    names: Int64[np.ndarray, " L"]
    counts: Int64[np.ndarray, " L"]
    seen: Bool[np.ndarray, "L K"]
    slips: tuple[Slip, ...]
    clutter: Bool[np.ndarray, " N"]


@dataclass(frozen=True)
class Clusters:
    """The detections of a window, each of one landmark, before what is doubtful is left out.

    landmark_of: by detection. names: of each landmark, NOBODY where it has none. now: the window
    smoothed under this association. slips: where the odometry was wrong; `scans` has their motions
    with a larger covariance.
    """

    scans: Scans
    landmark_of: Int64[np.ndarray, " N"]
    names: Int64[np.ndarray, " L"]
    now: Smoothed
    slips: tuple[Slip, ...]


def clustered(scans: Scans, settings: AssociationSettings) -> Clusters:
    """Track, smooth, associate again and merge. Raises LinAlgError where the window has no
    solution.
    """
    first = tracked(scans, settings)
    scans = _with_slips(scans, first.slips)
    landmark_of, names = first.landmark_of, np.array(first.names, np.int64)
    now = smoothed(scans, landmark_of, first.poses, first.landmarks)
    landmark_of, names, points = _again(scans, names, now, settings)
    now = smoothed(scans, landmark_of, now.poses, points)
    landmark_of, names, points = _merged(scans, landmark_of, names, now, settings)
    now = smoothed(scans, landmark_of, now.poses, points)
    return Clusters(scans, landmark_of, names, now, tuple(first.slips))


def associated(scans: Scans, settings: AssociationSettings) -> Associated:
    """Associate the detections of a window. Raises LinAlgError where the window has no solution."""
    found = clustered(scans, settings)
    scans, names, now = found.scans, found.names, found.now
    landmark_of = _certain(scans, found.landmark_of, names, now, settings)
    confirmed = _confirmed(landmark_of, names, settings)
    clutter = _missed_too_often(scans, landmark_of, confirmed, now, settings)
    remaining = np.where(np.append(confirmed, False)[landmark_of], landmark_of, NOBODY)
    landmark_of, names, _ = _renumbered(remaining, names, now.landmarks)
    seen = _seen(scans, landmark_of, len(names))
    counts = np.bincount(landmark_of[landmark_of != NOBODY], minlength=len(names))
    return Associated(landmark_of, names, counts, seen, found.slips, clutter)


def _with_slips(scans: Scans, slips: list[Slip]) -> Scans:
    covariances = scans.motion_covariances.copy()
    for slip in slips:
        covariances[slip.keyframe] += slip_covariance(slip.by)
    return replace(scans, motion_covariances=covariances)


def _seen(
    scans: Scans, landmark_of: Int64[np.ndarray, " N"], landmarks: int
) -> Bool[np.ndarray, "L K"]:
    seen = np.zeros((landmarks, len(scans.motions)), np.bool_)
    used = landmark_of != NOBODY
    seen[landmark_of[used], scans.keyframes[used]] = True
    return seen


def _renumbered(
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " before"],
    points: Float[np.ndarray, "before 2"],
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Renumber the landmarks that have a detection: by name, then by their first detection."""
    remaining, first = np.unique(landmark_of, return_index=True)
    remaining, first = remaining[remaining != NOBODY], first[remaining != NOBODY]
    unnamed = names[remaining] == NOBODY
    remaining = remaining[np.lexsort((np.where(unnamed, first, names[remaining]), unnamed))]
    number = np.full(len(names) + 1, NOBODY)  # the last one is that of NOBODY
    number[remaining] = np.arange(len(remaining))
    return number[landmark_of], names[remaining], points[remaining]


def _again(
    scans: Scans, names: Int64[np.ndarray, " before"], now: Smoothed, settings: AssociationSettings
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Associate every scan again, from the smoothed path against the landmarks of the whole window.

    A detection that matches none founds a landmark, also for the scans that follow.
    """
    k, n = len(now.poses), len(now.covariance)
    most = n + 2 * len(scans.points)
    P = np.zeros((most, most))
    P[:n, :n] = now.covariance
    known, points = list(names), np.concatenate((now.landmarks, np.empty((len(scans.points), 2))))
    landmark_of, bounds = np.full(len(scans.points), NOBODY), scans.bounds
    for i in range(k):
        of_scan = slice(bounds[i], bounds[i + 1])
        at, R, named = scans.points[of_scan], scans.covariances[of_scan], scans.names[of_scan]
        if not len(at):
            continue
        tight = settings.variance_factor * R
        count, pose = len(known), slice(3 * i, 3 * i + 3)
        turn = rotation(now.poses[i, 2])
        seen, spread = seen_with(now.poses[i], points[:count], P, pose, 3 * k, count)
        squared, logs = squared_distances(at[:, None] - seen[None], spread[None] + tight[:, None])
        same = named[:, None] == np.array(known)[None]
        gate = np.where(named[:, None] == NOBODY, settings.gate, np.inf)
        squared = np.where(same, np.minimum(squared, 1e12) / gate, np.inf)
        found = best_pairs_first(squared, squared * settings.gate + logs, 1.0)
        for row in np.nonzero(found == NOBODY)[0]:
            end = 3 * k + 2 * len(known)
            new = slice(end, end + 2)
            G = dense.product(turn, np.array([[1.0, 0.0, -at[row, 1]], [0.0, 1.0, at[row, 0]]]))
            P[new, :end] = dense.product(G, P[pose, :end])
            P[:end, new] = P[new, :end].T
            P[new, new] = dense.product(dense.product(G, P[pose, pose]), G.T) + dense.product(
                dense.product(turn, R[row]), turn.T
            )
            points[len(known)] = now.poses[i, :2] + dense.product(turn, at[row])
            found[row] = len(known)
            known.append(named[row])
        landmark_of[of_scan] = found
    return _renumbered(landmark_of, np.array(known, np.int64), points[: len(known)])


def _merged(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " before"],
    now: Smoothed,
    settings: AssociationSettings,
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Merge unnamed landmarks at one place that no scan saw together, the closest pair first."""
    count, first = len(names), 3 * len(now.poses)
    seen = _seen(scans, landmark_of, count)
    together = (seen.astype(np.int64) @ seen.T.astype(np.int64)) > 0
    P = now.covariance[first:, first:].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    own = P[np.arange(count), np.arange(count)]
    S = (
        own[:, None]
        + own[None]
        - P
        - P.transpose(0, 1, 3, 2)
        + elementary.squared(settings.slack_m) * np.eye(2)
    )
    apart = now.landmarks[:, None] - now.landmarks[None]
    squared, _ = squared_distances(apart, S)
    unnamed = names == NOBODY
    may = (squared < settings.gate) & ~together & unnamed[:, None] & unnamed[None]
    rows, columns = np.nonzero(np.triu(may, 1))
    root = np.arange(count)
    for index in np.argsort(squared[rows, columns], kind="stable"):
        a, b = root[rows[index]], root[columns[index]]
        if a != b and not (seen[a] & seen[b]).any():
            keep, gone = (a, b) if seen[a].sum() >= seen[b].sum() else (b, a)
            seen[keep] |= seen[gone]
            root[root == gone] = keep
    return _renumbered(root[landmark_of], names, now.landmarks)


def _certain(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " L"],
    now: Smoothed,
    settings: AssociationSettings,
) -> Int64[np.ndarray, " N"]:
    """Drop detections that may as well be of something else (`certain`); identities are always
    accepted.
    """
    sure = certainties(scans, landmark_of, now, settings) >= settings.certain
    return np.where(sure | (scans.names != NOBODY), landmark_of, NOBODY)


def _confirmed(
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " L"],
    settings: AssociationSettings,
) -> Bool[np.ndarray, " L"]:
    """Whether each landmark is accepted: it has a name or was seen often enough."""
    counts = np.bincount(landmark_of[landmark_of != NOBODY], minlength=len(names))
    return np.asarray((counts >= settings.least_seen) | (names != NOBODY))


def _missed_too_often(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    confirmed: Bool[np.ndarray, " L"],
    now: Smoothed,
    settings: AssociationSettings,
) -> Bool[np.ndarray, " N"]:
    """Of landmarks that are not confirmed, those that would have been seen more often if they were
    real.

    A keyframe observes a place if it saw something at least as far off and the place lies between
    the outermost bearings of what it saw. A landmark with detection probability p that was observed
    v times is clutter if so few detections have a probability below 1/20.
    """
    clutter = np.zeros(len(landmark_of), np.bool_)
    scan_of = scans.keyframes
    first = np.unique(scan_of, return_index=True)[1]
    if not len(first):
        return clutter
    bearings = elementwise.atan2(scans.points[:, 1], scans.points[:, 0])
    farthest = np.maximum.reduceat(elementwise.hypot(scans.points[:, 0], scans.points[:, 1]), first)
    least, most = np.minimum.reduceat(bearings, first), np.maximum.reduceat(bearings, first)
    poses = now.poses[scan_of[first]]
    for landmark in np.nonzero(~confirmed)[0]:
        members = np.nonzero(landmark_of == landmark)[0]
        places = seen_from(poses, np.broadcast_to(now.landmarks[landmark], (len(poses), 2)))
        bearing = elementwise.atan2(places[:, 1], places[:, 0])
        inside = (least <= bearing) & (bearing <= most)
        looks = np.count_nonzero(
            inside & (elementwise.hypot(places[:, 0], places[:, 1]) <= farthest)
        )
        clutter[members] = _rare(len(members), max(int(looks), len(members)), settings)
    return clutter


def _rare(seen: int, looks: int, settings: AssociationSettings) -> bool:
    """Whether P(at most `seen` of `looks` detections) < 0.05 with the detection probability."""
    p = settings.detection_probability
    term, total = math.prod([1.0 - p] * looks), 0.0
    for c in range(seen + 1):
        total += term
        term *= (looks - c) / (c + 1.0) * p / (1.0 - p)
    return total < 0.05
