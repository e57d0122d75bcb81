"""Calibrate clutter and miss rates from detections without identities.

Each window is associated anew. After a landmark's first detection, each scan that covers its place
is a trial: of n trials, v detections are binomial with detection probability p; clutter recurs with
probability g. The clutter share, p and g maximise the likelihood (expectation and maximisation). A
scan covers a place within the range and bearing span of its other landmarks. Claimed covariances
are compared with the smoothed windows' cost, whose mean is one per degree of freedom.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from teamslam.sim.calibration.data import messages_of
from teamslam.sim.calibration.figures import Figure, leave_out_groups
from teamslam.sim.world.streams import RobotStream
from teamslam.team import translate
from teamslam.team.config import AssociationSettings, RobotConfig
from teamslam.team.estimation.association.clustering import Clusters, cluster_window, estimate_view
from teamslam.team.estimation.association.scans import UNASSIGNED, Scans, relative_to
from teamslam.team.estimation.hybrid_slam.unnamed_detections import events_of, scans_of
from teamslam.team.estimation.models import segmenter_of
from teamslam.team.shapes import Float, Int64
from teamslam.team.wire import messages as m

LEAST_TRIALS = 50
LEAST_SEEN = 3
"""Detections that exclude clutter. Only such landmarks define a scan's coverage, since clutter may
lie beyond the visible range.
"""
GROUPS = 5  # number of stretches of windows left out in turn
ROUNDS = 200
SETTLED = 1e-6
DIFFERENT = 1.3  # error ratio from which a claimed covariance is wrong
UNLIKE = 0.1  # reported difference in detection probability

UNITS = {
    "detection_probability": "",
    "clutter_share": "",
    "clutter_per_m2": "1/m²",
    "errors_over_claims": "",
}


class _WindowLooks(NamedTuple):
    """Repeated detections in a window.

    trials, again: per landmark, covering scans after its first detection, and detections among
    them. area [m²]: view area times scans.
    """

    trials: Int64[np.ndarray, " L"]
    again: Int64[np.ndarray, " L"]
    further: Int64[np.ndarray, " L"]
    detections: int
    area: float
    cost: float
    dof: int


def windows_of(stream: RobotStream, config: RobotConfig) -> list[_WindowLooks]:
    """Solvable windows with detections without identities."""
    if stream.landmark_detections.hidden is None:
        return []
    front = config.front_end
    segmenter = segmenter_of(config.motion, config.sensor, front.keyframe_s)
    window_ns, start_ns = round(front.window_s * 1e9), None
    keyframes, found = [], []
    for message in messages_of(stream):
        if isinstance(message, m.AnyScan | m.Detections):
            segmenter.observe(message.stamp_ns, translate.scan_of(message))
        elif isinstance(message, m.AnyOdometry):
            interval = translate.interval_of(message, config)
            if start_ns is None:
                start_ns = interval.end_ns - interval.duration_ns
                segmenter.begin(start_ns)
            segmenter.integrate(interval, is_measured=True)
            keyframes += segmenter.take_keyframes()
            if interval.end_ns - start_ns >= window_ns:
                segmenter.cut(interval.end_ns)
                keyframes += segmenter.take_keyframes()
                segmenter.leave()
                if any(each.looks for each in keyframes):
                    scans = scans_of(events_of(keyframes), config.sensor)
                    found += _looks(scans, front.association)
                start_ns, keyframes = interval.end_ns, []
                segmenter.begin(start_ns)
    return found


def _looks(scans: Scans, settings: AssociationSettings) -> list[_WindowLooks]:
    try:
        return [_looks_of(cluster_window(scans, settings))]
    except np.linalg.LinAlgError:
        return []


def _looks_of(found: Clusters) -> _WindowLooks:
    scans, landmarks = found.scans, found.window.landmarks
    unnamed = found.names == UNASSIGNED
    trials = np.zeros(len(landmarks), np.int64)
    again = np.zeros(len(landmarks), np.int64)
    known = np.zeros(len(landmarks), np.bool_)
    ranges = np.hypot(scans.points[:, 0], scans.points[:, 1])
    bearings = np.arctan2(scans.points[:, 1], scans.points[:, 0])
    counts = np.bincount(found.landmark_of, minlength=len(landmarks))
    real = counts >= LEAST_SEEN
    for pose, rows in zip(found.window.poses, scans.rows, strict=True):
        own = found.landmark_of[rows]
        if not len(own):
            continue
        at = relative_to(np.broadcast_to(pose, (len(landmarks), 3)), landmarks)
        other = (own[None] != np.arange(len(landmarks))[:, None]) & real[own]
        in_view = known & other.any(axis=1)
        for measured, place in (
            (ranges[rows], np.hypot(at[:, 0], at[:, 1])),
            (bearings[rows], np.arctan2(at[:, 1], at[:, 0])),
        ):
            in_view &= np.where(other, measured, np.inf).min(axis=1) <= place
            in_view &= place <= np.where(other, measured, -np.inf).max(axis=1)
        trials += in_view
        detected = np.isin(np.arange(len(landmarks)), own)
        again += in_view & detected
        known |= detected
    view = estimate_view(scans)
    return _WindowLooks(
        trials=trials[unnamed],
        again=again[unnamed],
        further=(counts - 1 - again)[unnamed],
        detections=int(np.count_nonzero(unnamed[found.landmark_of])),
        area=view.area * view.looks,
        cost=found.window.squared,
        dof=found.window.dof,
    )


class Rates(NamedTuple):
    """detected: probability for a landmark in view. share: clutter among detections. density:
    clutter per scan and m². claimed: squared window errors over claims.
    """

    detected: float
    share: float
    density: float
    claimed: float


def rates(windows: Sequence[_WindowLooks]) -> Rates | None:
    """Maximum-likelihood rates; None below LEAST_TRIALS."""
    n, v, more = (
        np.concatenate([np.zeros(0, np.int64), *(getattr(each, name) for each in windows)])
        for name in ("trials", "again", "further")
    )
    if n.sum() < LEAST_TRIALS:
        return None
    p, g, share = 0.8, 0.1, 0.3
    for _ in range(ROUNDS):
        before = p, g, share
        clutter = _clutter(v, n, p, g, share)
        share = float(clutter.mean())
        p = float(((1.0 - clutter) * v).sum() / max(((1.0 - clutter) * n).sum(), 1e-9))
        g = float((clutter * v).sum() / max((clutter * n).sum(), 1e-9))
        p, g = (float(np.clip(each, 1e-3, 1.0 - 1e-3)) for each in (p, g))
        if np.abs(np.subtract(before, (p, g, share))).max() < SETTLED:
            break
    clutter, seen = _clutter(v, n, p, g, share), 1 + v + more
    few, judged = seen < LEAST_SEEN, n > 0
    if (few & judged).any():  # without repeated scans, assume the same clutter share
        clutter[~judged] = clutter[few & judged].mean()
    false = float((clutter * seen)[few].sum())
    cost, dof = (sum(getattr(each, name) for each in windows) for name in ("cost", "dof"))
    return Rates(
        detected=p,
        share=false / max(sum(each.detections for each in windows), 1),
        density=false / max(sum(each.area for each in windows), 1e-9),
        claimed=cost / max(dof, 1),
    )


def _clutter(
    v: Int64[np.ndarray, " L"], n: Int64[np.ndarray, " L"], p: float, g: float, share: float
) -> Float[np.ndarray, " L"]:
    """Probability of clutter; the binomial coefficients cancel."""
    real = v * np.log(p) + (n - v) * np.log1p(-p) + np.log1p(-min(share, 1.0 - 1e-9))
    false = v * np.log(g) + (n - v) * np.log1p(-g) + np.log(max(share, 1e-9))
    probability: Float[np.ndarray, " L"] = 1.0 / (1.0 + np.exp(np.clip(real - false, -500, 500)))
    return probability


def detection_figures(windows: Sequence[_WindowLooks]) -> tuple[Figure, ...]:
    """Rates of all windows, with jackknife uncertainty."""
    if len(windows) < GROUPS:
        return ()
    edges = np.linspace(0, len(windows), GROUPS + 1).astype(int)
    groups = [windows[a:b] for a, b in pairwise(edges)]

    def fit(part: Sequence[_WindowLooks]) -> dict[str, float]:
        found = rates(part)
        return {} if found is None else dict(zip(UNITS, found, strict=True))

    return leave_out_groups(fit, groups, UNITS)


def claim_notes(
    figures: Sequence[Figure], central: Sequence[Figure], settings: AssociationSettings
) -> tuple[str, ...]:
    """Warnings about wrong claimed covariances."""
    value = {each.name: each.value for each in (*figures, *central)}
    notes = []
    inside, between = value.get("errors_over_claims", 1.0), value.get("covariance_factor", 1.0)
    if not 1.0 / DIFFERENT <= inside <= DIFFERENT:
        notes.append(
            f"inside windows the errors are {inside**0.5:.2g} times what detections and odometry "
            "claim"
        )
    if between > DIFFERENT:
        notes.append(
            f"between windows the errors are {between**0.5:.2g} times what the submaps claim: "
            f"launch with covariance_factor {between:.2g}, else landmarks are not found again"
        )
    detected = value.get("detection_probability")
    if detected is not None and abs(detected - settings.detection_probability) > UNLIKE:
        notes.append(
            f"{detected:.0%} of the landmarks in view are detected, the scenario has "
            f"{settings.detection_probability:.0%}"
        )
    return tuple(notes)
