"""Associate one closed window's detections with landmarks, without the map or another window.

Submaps therefore stay independent. All particles share the association. A detection is left out
where its association is uncertain, and a landmark where clutter explains its detections.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from teamslam.team import core
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation import dense
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

    @cached_property
    def seen(self) -> Bool[np.ndarray, "L K"]:
        """Whether each landmark has a detection in each keyframe."""
        return _mark_seen(self.scans, self.landmark_of, len(self.names))


def cluster_window(scans: Scans, settings: AssociationSettings) -> Clusters:
    """Track, smooth, associate again and merge. Raises LinAlgError without a solution."""
    first = track_window(scans, settings)
    covariances = scans.motion_covariances.copy()
    for slip in first.slips:
        covariances[slip.keyframe] += slip_covariance(slip.by)
    scans = replace(scans, motion_covariances=covariances)
    window = smooth_window(scans, first.landmark_of, first.poses, first.landmarks)
    names = np.array(first.names, np.int64)
    found = Clusters(scans, first.landmark_of, names, window, tuple(first.slips))
    return _merge_split(_associate_again(found, settings), settings)


def associate_window(scans: Scans, settings: AssociationSettings) -> WindowAssociation:
    """Associate the detections of a window. Raises LinAlgError without a solution."""
    found = _drop_uncertain(cluster_window(scans, settings), settings)
    odds = _weigh_landmarks(found, _mark_looks(found) | found.seen, settings)
    confirmed, false = odds > 0.0, odds < core.log(RARE)
    clutter = np.append(false, False)[found.landmark_of]
    remaining = np.append(confirmed, False)[found.landmark_of]
    landmark_of, chosen = _renumber(np.where(remaining, found.landmark_of, UNASSIGNED), found.names)
    seen = _mark_seen(found.scans, landmark_of, len(chosen))
    counts = np.bincount(landmark_of[landmark_of != UNASSIGNED], minlength=len(chosen))
    return WindowAssociation(landmark_of, found.names[chosen], counts, seen, found.slips, clutter)


def _mark_seen(
    scans: Scans, landmark_of: Int64[np.ndarray, " N"], landmarks: int
) -> Bool[np.ndarray, "L K"]:
    seen = np.zeros((landmarks, len(scans.motions)), np.bool_)
    used = landmark_of != UNASSIGNED
    seen[landmark_of[used], scans.keyframes[used]] = True
    return seen


def _renumber(
    landmark_of: Int64[np.ndarray, " N"], names: Int64[np.ndarray, " before"]
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " L"]]:
    """Number the landmarks with detections by name, then by first detection; return also their
    former numbers.
    """
    remaining, first = np.unique(landmark_of, return_index=True)
    remaining, first = remaining[remaining != UNASSIGNED], first[remaining != UNASSIGNED]
    unnamed = names[remaining] == UNASSIGNED
    remaining = remaining[np.lexsort((np.where(unnamed, first, names[remaining]), unnamed))]
    number = np.full(len(names) + 1, UNASSIGNED)  # the last one is that of UNASSIGNED
    number[remaining] = np.arange(len(remaining))
    return number[landmark_of], remaining


def _smooth_again(
    found: Clusters,
    landmark_of: Int64[np.ndarray, " N"],
    names: Int64[np.ndarray, " before"],
    points: Float[np.ndarray, "before 2"],
) -> Clusters:
    landmark_of, chosen = _renumber(landmark_of, names)
    window = smooth_window(found.scans, landmark_of, found.window.poses, points[chosen])
    return replace(found, landmark_of=landmark_of, names=names[chosen], window=window)


def _associate_again(found: Clusters, settings: AssociationSettings) -> Clusters:
    """Associate every scan with all landmarks, from the smoothed path; the rest become new ones."""
    scans, window = found.scans, found.window
    k, n = len(window.poses), len(window.covariance)
    most = n + 2 * len(scans.points)
    P = np.zeros((most, most))
    P[:n, :n] = window.covariance
    known = list(found.names)
    points = np.concatenate((window.landmarks, np.empty((len(scans.points), 2))))
    landmark_of = np.full(len(scans.points), UNASSIGNED)
    for i, pose in enumerate(window.poses):
        scan = scans.detections(i)
        if not len(scan.points):
            continue
        predicted = predict_landmarks(pose, points[: len(known)], P, 3 * i, 3 * k)
        matched = match_scan(scan, predicted, np.array(known), settings)
        for row in np.nonzero(matched == UNASSIGNED)[0]:
            at, R, end = scan.points[row], scan.covariances[row], 3 * k + 2 * len(known)
            points[len(known)] = initialise_landmark(pose, at, R, P, 3 * i, end)
            matched[row] = len(known)
            known.append(scan.names[row])
        landmark_of[scans.rows[i]] = matched
    return _smooth_again(found, landmark_of, np.array(known), points[: len(known)])


def _merge_split(found: Clusters, settings: AssociationSettings) -> Clusters:
    """Merge unnamed landmarks at one place that no scan observed together, the closest first."""
    landmarks, seen = found.window.landmarks, found.seen.copy()
    count, first = len(landmarks), 3 * len(found.window.poses)
    together = (seen.astype(np.int64) @ seen.T.astype(np.int64)) > 0
    P = found.window.covariance[first:, first:].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    own = P[np.arange(count), np.arange(count)]
    S = own[:, None] + own[None] - P - P.transpose(0, 1, 3, 2)
    S = S + core.squared(settings.slack_m) * np.eye(2)
    squared, _ = compute_mahalanobis(landmarks[:, None] - landmarks[None], S)
    unnamed = found.names == UNASSIGNED
    may = (squared < settings.gate) & ~together & unnamed[:, None] & unnamed[None]
    rows, columns = np.nonzero(np.triu(may, 1))
    root = np.arange(count)
    for index in np.argsort(squared[rows, columns], kind="stable"):
        a, b = root[rows[index]], root[columns[index]]
        if a != b and not (seen[a] & seen[b]).any():
            keep, gone = (a, b) if seen[a].sum() >= seen[b].sum() else (b, a)
            seen[keep] |= seen[gone]
            root[root == gone] = keep
    if (root == np.arange(count)).all():
        return found
    return _smooth_again(found, root[found.landmark_of], found.names, landmarks)


def _drop_uncertain(found: Clusters, settings: AssociationSettings) -> Clusters:
    scans, of = found.scans, found.landmark_of
    sure = association_probabilities(found, settings) >= settings.certain
    sure |= scans.names != UNASSIGNED
    return replace(found, landmark_of=np.where(sure, of, UNASSIGNED))


def _mark_looks(found: Clusters) -> Bool[np.ndarray, "L K"]:
    """Mark the keyframes in view of each landmark: with a detection at least as far off, and the
    place between their outermost bearings.
    """
    scans, window = found.scans, found.window
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
    found: Clusters, looks: Bool[np.ndarray, "L K"], settings: AssociationSettings
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
    named, seen = found.names != UNASSIGNED, found.seen
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


LEAST = 0.1  # least probability that a detected landmark is in view
WIDER, FARTHER = 0.5, 1.25
"""Margin [rad] of the sector in view beyond the outermost bearing, and its least range in multiples
of the median, for robots that stand still.
"""


@dataclass(frozen=True)
class FieldOfView:
    """Sector that a window's scans observe, estimated from its detections.

    density: detections of a scan per square metre; area [m²]; looks: number of scans. farthest [m];
    least, most: bearings [rad].
    """

    density: float
    area: float
    looks: int
    farthest: float
    least: float
    most: float

    def probability_in_view(
        self, seen: Float[np.ndarray, "L 2"], spread: Float[np.ndarray, "L 2 2"]
    ) -> Float[np.ndarray, " L"]:
        """Compute the probability that each place, in the sensor's frame, is in view."""
        ranges = np.maximum(core.hypot(seen[:, 0], seen[:, 1]), 1e-6)
        bearings = core.atan2(seen[:, 1], seen[:, 0])
        along = seen / ranges[:, None]
        across = np.column_stack((-along[:, 1], along[:, 0]))
        far = np.sqrt(np.maximum(np.einsum("li,lij,lj->l", along, spread, along), 1e-12))
        wide = np.sqrt(np.maximum(np.einsum("li,lij,lj->l", across, spread, across), 1e-12))
        inside = core.normal_below((self.farthest - ranges) / far)
        if self.most - self.least < 1.5 * np.pi:
            inside *= core.normal_below((self.most - bearings) * ranges / wide)
            inside *= core.normal_below((bearings - self.least) * ranges / wide)
        return np.asarray(np.maximum(inside, LEAST))


def estimate_view(scans: Scans) -> FieldOfView:
    """Estimate the sector of the detections, without its widening by their noise, and their
    density.
    """
    ranges = core.hypot(scans.points[:, 0], scans.points[:, 1])
    bearings = core.atan2(scans.points[:, 1], scans.points[:, 0])
    along = scans.points / np.maximum(ranges, 1e-6)[:, None]
    noise = np.sqrt(np.einsum("ni,nij,nj->n", along, scans.covariances, along))
    farthest = max(float((ranges - 2.0 * noise).max()), FARTHER * float(np.median(ranges)))
    least, most = float(bearings.min()) - WIDER, float(bearings.max()) + WIDER
    area = max(0.5 * min(most - least, 2.0 * np.pi) * core.squared(farthest), 1e-9)
    looks = len(np.unique(scans.keyframes))
    return FieldOfView(len(ranges) / (looks * area), area, looks, farthest, least, most)


def association_probabilities(
    found: Clusters, settings: AssociationSettings
) -> Float[np.ndarray, " N"]:
    """Compute the probability that each detection is of its landmark; 0 without one.

    For a landmark j in view with probability v_j and detected with probability P_D, the odds of "z
    is of landmark j" against "z is of something else and j was missed" are

      ψ_j = P_D v_j N(z; ẑ_j, S_j) / ((1 − P_D v_j) ρ_j),    ρ_j = ρ_out + ρ (1 − exp(−ρ V_j)),

    with ρ detections per square metre of a view, ρ_out those in no landmark, and V_j = π γ √|S_j|
    the volume of the gate γ.
    """
    scans, landmark_of, window = found.scans, found.landmark_of, found.window
    view = estimate_view(scans)
    counts = np.bincount(landmark_of[landmark_of != UNASSIGNED], minlength=len(window.landmarks))
    alone = landmark_of == UNASSIGNED
    alone |= counts[landmark_of] < settings.least_seen
    out = (1.0 + np.count_nonzero(alone)) / (view.looks * view.area)
    certain = np.zeros(len(landmark_of))
    for k, rows in enumerate(scans.rows):
        of_scan = rows.start + np.flatnonzero(landmark_of[rows] != UNASSIGNED)
        if not len(of_scan):
            continue
        seen, spread = predict_landmarks(
            window.poses[k], window.landmarks, window.covariance, 3 * k, 3 * len(window.poses)
        )
        R = settings.variance_factor * scans.covariances[of_scan]
        S = spread[None] + R[:, None]
        squared, determinants = compute_mahalanobis(scans.points[of_scan][:, None] - seen[None], S)
        logs = core.log(determinants)
        detected = settings.detection_probability * view.probability_in_view(
            seen, spread + R.mean(axis=0)
        )
        volume = np.pi * settings.gate * core.exp(0.5 * logs)
        other = out - view.density * core.expm1(-view.density * volume)
        with np.errstate(under="ignore"):
            likely = core.exp(-0.5 * np.minimum(squared, 1e3) - 0.5 * logs) / (2.0 * np.pi)
            weights = detected / (1.0 - detected) * likely / other
        chosen = landmark_of[of_scan]
        certain[of_scan] = marginals(weights)[np.arange(len(chosen)), chosen]
    return certain


STEPS = 30  # most steps of belief propagation
SETTLED = 1e-6  # change of the messages below which belief propagation ends


def marginals(weights: Float[np.ndarray, "n L"]) -> Float[np.ndarray, "n L"]:
    """Compute P(detection i is of landmark j) from the odds ψ_ij, with one-to-one pairs.

    Belief propagation over the joint associations of a scan (Williams and Lau 2014, IEEE TAES
    50(4)).
    """
    messages = np.ones_like(weights)
    for _ in range(STEPS):
        of_landmark = (weights * messages).sum(axis=0) - weights * messages
        forward = weights / (1.0 + np.maximum(of_landmark, 0.0))
        of_detection = forward.sum(axis=1, keepdims=True) - forward
        before, messages = messages, 1.0 / (1.0 + np.maximum(of_detection, 0.0))
        if np.abs(messages - before).max(initial=0.0) < SETTLED:
            break
    total = 1.0 + forward.sum(axis=1, keepdims=True)
    return np.asarray(forward / total)
