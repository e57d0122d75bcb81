"""Associate one closed window's detections with landmarks, without the map or another window.

Submaps therefore stay independent. All particles share the association.
"""

from dataclasses import dataclass, replace

import numpy as np

from teamslam.team import core
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.certainty import association_probabilities
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    Scans,
    compute_mahalanobis,
    initialise_landmark,
    match_scan,
    predict_landmarks,
)
from teamslam.team.estimation.association.smoothing import SmoothedWindow, smooth_window
from teamslam.team.estimation.association.tracking import Slip, slip_covariance, track_window
from teamslam.team.estimation.se2 import rotation
from teamslam.team.shapes import Bool, Float, Int64

RARE = 0.05  # odds of a landmark below which its detections are clutter
ROUNDS = 5  # most iterations of the share of clutter
UNSEEN = 100.0  # looks at a place of clutter with one match, before the window's own are counted
STATED = 10.0  # weight of the stated detection probability, in looks, beside the window's own
ALIKE = 6.0
"""a + b of the beta distribution of the landmarks' detection probabilities, which scatter by 0.11
at 0.9, since some are often hidden.
"""
HIDDEN = 0.1
"""Probability that a landmark in view is hidden up to some time of the window, or from it on."""


@dataclass(frozen=True)
class WindowAssociation:
    """The landmark of each detection of a window.

    landmark_of: by detection, in [0, L), or UNASSIGNED. names: identity of each landmark, or
    UNASSIGNED; sorted by name, then by first detection. counts, seen: detections and keyframes of
    each landmark. clutter: detections left out whose place was observed again without a match.
    """

    landmark_of: Int64[np.ndarray, " N"]
    names: Int64[np.ndarray, " L"]
    counts: Int64[np.ndarray, " L"]
    seen: Bool[np.ndarray, "L K"]
    slips: tuple[Slip, ...]
    clutter: Bool[np.ndarray, " N"]


@dataclass(frozen=True)
class Clusters:
    """Detections of a window, each of one landmark, before doubtful ones are left out.

    window: smoothed. scans: with larger covariances of the motions that slipped.
    """

    scans: Scans
    landmark_of: Int64[np.ndarray, " N"]
    names: Int64[np.ndarray, " L"]
    window: SmoothedWindow
    slips: tuple[Slip, ...]


def cluster_window(scans: Scans, settings: AssociationSettings) -> Clusters:
    """Track, smooth, associate again and merge. Raises LinAlgError without a solution."""
    first = track_window(scans, settings)
    scans = _inflate_slips(scans, first.slips)
    landmark_of, names = first.landmark_of, np.array(first.names, np.int64)
    window = smooth_window(scans, landmark_of, first.poses, first.landmarks)
    landmark_of, names, points = _associate_again(scans, names, window, settings)
    window = smooth_window(scans, landmark_of, window.poses, points)
    landmark_of, merged, points = _merge_split(scans, landmark_of, names, window, settings)
    if len(merged) < len(names):
        names, window = merged, smooth_window(scans, landmark_of, window.poses, points)
    return Clusters(scans, landmark_of, names, window, tuple(first.slips))


def associate_window(scans: Scans, settings: AssociationSettings) -> WindowAssociation:
    """Associate the detections of a window. Raises LinAlgError without a solution."""
    found = cluster_window(scans, settings)
    scans, names, window = found.scans, found.names, found.window
    landmark_of = _drop_uncertain(scans, found.landmark_of, window, settings)
    looks = _mark_looks(scans, window) | _mark_seen(scans, landmark_of, len(names))
    odds = _weigh_landmarks(scans, landmark_of, looks, names, settings)
    confirmed, false = odds > 0.0, odds < core.log(RARE)
    clutter = np.append(false, False)[landmark_of]
    remaining = np.where(np.append(confirmed, False)[landmark_of], landmark_of, UNASSIGNED)
    landmark_of, names, _ = _renumber(remaining, names, window.landmarks)
    seen = _mark_seen(scans, landmark_of, len(names))
    counts = np.bincount(landmark_of[landmark_of != UNASSIGNED], minlength=len(names))
    return WindowAssociation(landmark_of, names, counts, seen, found.slips, clutter)


def _inflate_slips(scans: Scans, slips: list[Slip]) -> Scans:
    covariances = scans.motion_covariances.copy()
    for slip in slips:
        covariances[slip.keyframe] += slip_covariance(slip.by)
    return replace(scans, motion_covariances=covariances)


def _mark_seen(
    scans: Scans, landmark_of: Int64[np.ndarray, " N"], landmarks: int
) -> Bool[np.ndarray, "L K"]:
    seen = np.zeros((landmarks, len(scans.motions)), np.bool_)
    used = landmark_of != UNASSIGNED
    seen[landmark_of[used], scans.keyframes[used]] = True
    return seen


def _renumber(
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " before"],
    points: Float[np.ndarray, "before 2"],
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    remaining, first = np.unique(landmark_of, return_index=True)
    remaining, first = remaining[remaining != UNASSIGNED], first[remaining != UNASSIGNED]
    unnamed = names[remaining] == UNASSIGNED
    remaining = remaining[np.lexsort((np.where(unnamed, first, names[remaining]), unnamed))]
    number = np.full(len(names) + 1, UNASSIGNED)  # the last one is that of UNASSIGNED
    number[remaining] = np.arange(len(remaining))
    return number[landmark_of], names[remaining], points[remaining]


def _associate_again(
    scans: Scans,
    names: Int64[np.ndarray, " before"],
    window: SmoothedWindow,
    settings: AssociationSettings,
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Associate every scan with all landmarks, from the smoothed path; the rest become new ones."""
    k, n = len(window.poses), len(window.covariance)
    most = n + 2 * len(scans.points)
    P = np.zeros((most, most))
    P[:n, :n] = window.covariance
    known = list(names)
    points = np.concatenate((window.landmarks, np.empty((len(scans.points), 2))))
    landmark_of = np.full(len(scans.points), UNASSIGNED)
    for i, pose in enumerate(window.poses):
        scan = scans.detections(i)
        if not len(scan.points):
            continue
        predicted = predict_landmarks(pose, points[: len(known)], P, 3 * i, 3 * k)
        found = match_scan(scan, predicted, np.array(known), settings)
        for row in np.nonzero(found == UNASSIGNED)[0]:
            at, R, end = scan.points[row], scan.covariances[row], 3 * k + 2 * len(known)
            points[len(known)] = initialise_landmark(pose, at, R, P, 3 * i, end)
            found[row] = len(known)
            known.append(scan.names[row])
        landmark_of[scans.rows[i]] = found
    return _renumber(landmark_of, np.array(known, np.int64), points[: len(known)])


def _merge_split(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " before"],
    window: SmoothedWindow,
    settings: AssociationSettings,
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Merge unnamed landmarks at one place that no scan observed together, the closest first."""
    count, first = len(names), 3 * len(window.poses)
    seen = _mark_seen(scans, landmark_of, count)
    together = (seen.astype(np.int64) @ seen.T.astype(np.int64)) > 0
    P = window.covariance[first:, first:].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    own = P[np.arange(count), np.arange(count)]
    S = (
        own[:, None]
        + own[None]
        - P
        - P.transpose(0, 1, 3, 2)
        + core.squared(settings.slack_m) * np.eye(2)
    )
    apart = window.landmarks[:, None] - window.landmarks[None]
    squared, _ = compute_mahalanobis(apart, S)
    unnamed = names == UNASSIGNED
    may = (squared < settings.gate) & ~together & unnamed[:, None] & unnamed[None]
    rows, columns = np.nonzero(np.triu(may, 1))
    root = np.arange(count)
    for index in np.argsort(squared[rows, columns], kind="stable"):
        a, b = root[rows[index]], root[columns[index]]
        if a != b and not (seen[a] & seen[b]).any():
            keep, gone = (a, b) if seen[a].sum() >= seen[b].sum() else (b, a)
            seen[keep] |= seen[gone]
            root[root == gone] = keep
    return _renumber(root[landmark_of], names, window.landmarks)


def _drop_uncertain(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    window: SmoothedWindow,
    settings: AssociationSettings,
) -> Int64[np.ndarray, " N"]:
    sure = association_probabilities(scans, landmark_of, window, settings) >= settings.certain
    return np.where(sure | (scans.names != UNASSIGNED), landmark_of, UNASSIGNED)


def _mark_looks(scans: Scans, window: SmoothedWindow) -> Bool[np.ndarray, "L K"]:
    """Mark the keyframes in view of each landmark: with a detection at least as far off, and the
    place between their outermost bearings.
    """
    looks = np.zeros((len(window.landmarks), len(window.poses)), np.bool_)
    bearings = core.atan2(scans.points[:, 1], scans.points[:, 0])
    ranges = core.hypot(scans.points[:, 0], scans.points[:, 1])
    for k, (pose, own) in enumerate(zip(window.poses, scans.rows, strict=True)):
        if own.start == own.stop:
            continue
        x, y = dense.product(window.landmarks - pose[:2], rotation(pose[2])).T
        bearing = core.atan2(y, x)
        looks[:, k] = (bearings[own].min() <= bearing) & (bearing <= bearings[own].max())
        looks[:, k] &= core.hypot(x, y) <= ranges[own].max()
    return looks


def _weigh_landmarks(
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    looks: Bool[np.ndarray, "L K"],
    names: Int64[np.ndarray, " L"],
    settings: AssociationSettings,
) -> Float[np.ndarray, " L"]:
    """Compute the log odds that each landmark is real; ∞ with an identity, ≤ 0 with too few
    detections.

    After its first detection, a real landmark is detected at each look with its own probability, of
    a distribution Beta(a, b) with the mean p of the window's confirmed landmarks; a place of
    clutter matches with q. With c detections and m misses the log odds are

      log(B(a + c − 1, b + m)/B(a, b)) − (c − 1) log q − m log(1 − q) + log(real/places of clutter).

    Misses before the first detection count as m log((1 − p)/(1 − q)), at least log HIDDEN, as do
    those after the last one. q and the last term are of the window's unconfirmed places.
    """
    named = names != UNASSIGNED
    seen = _mark_seen(scans, landmark_of, len(names))
    counts = seen.sum(axis=1)
    again = np.maximum(counts - 1, 0)
    missed = looks & ~seen
    is_before = np.cumsum(seen, axis=1) == 0
    is_after = np.cumsum(seen[:, ::-1], axis=1)[:, ::-1] == 0
    before, after = (missed & is_before).sum(axis=1), (missed & is_after).sum(axis=1)
    within = np.where(counts > 0, missed.sum(axis=1) - before - after, 0)
    may = (counts >= settings.least_seen) & ~named
    confirmed = may
    for _ in range(ROUNDS):
        real, false = confirmed | named, ~confirmed & ~named & (counts > 0)
        hits, misses = float(again[real].sum()), float(within[real].sum())
        p = (hits + STATED * settings.detection_probability) / (hits + misses + STATED)
        chance = float((counts[false] - 1).sum() + 1)
        q = min(chance / float((looks[false].sum(axis=1) - 1).sum() + UNSEEN), 0.5 * p)
        score = _log_beta(p, again, within)
        score = score - core.log(q) * again - core.log(1.0 - q) * within
        for outside in (before, after):
            miss = core.log((1.0 - p) / (1.0 - q)) * outside
            score = score + np.maximum(miss, core.log(HIDDEN))
        score = score + core.log((confirmed.sum() + 1.0) / (false.sum() + 1.0))
        last, confirmed = confirmed, may & (score > 0.0)
        if np.array_equal(last, confirmed):
            break
    odds: Float[np.ndarray, " L"] = np.where(may, score, np.minimum(score, 0.0))
    odds[named] = np.inf
    return odds


def _log_beta(
    p: float, seen: Int64[np.ndarray, " L"], missed: Int64[np.ndarray, " L"]
) -> Float[np.ndarray, " L"]:
    """Compute log(B(a + seen, b + missed)/B(a, b)) with a + b = ALIKE and the mean p."""
    factors: Float[np.ndarray, " n"] = np.arange(float((seen + missed).max(initial=0)))

    def log_rising(a: float, counts: Int64[np.ndarray, " L"]) -> Float[np.ndarray, " L"]:
        return np.asarray(np.append(0.0, np.cumsum(core.log(a + factors)))[counts])

    a, b = ALIKE * p, ALIKE * (1.0 - p)
    found = log_rising(a, seen) + log_rising(b, missed) - log_rising(ALIKE, seen + missed)
    return np.asarray(found)
