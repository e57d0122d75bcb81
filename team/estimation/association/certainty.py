"""Probability that a detection is of its associated landmark.

For a landmark j in view with probability v_j and detected with probability P_D, the odds of "z is
of landmark j" against "z is of something else and j was missed" are

  ψ_j = P_D v_j N(z; ẑ_j, S_j) / ((1 − P_D v_j) ρ_j),    ρ_j = ρ_out + ρ (1 − exp(−ρ V_j)),

with ρ detections per square metre of a view, ρ_out those in no landmark, and V_j = π γ √|S_j| the
volume of the gate γ. Belief propagation gives the marginals over the joint associations of a scan
(Williams and Lau 2014, IEEE TAES 50(4)).
"""

from dataclasses import dataclass

import numpy as np

from teamslam.team import core
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    Scans,
    compute_mahalanobis,
    predict_landmarks,
)
from teamslam.team.estimation.association.smoothing import SmoothedWindow
from teamslam.team.shapes import Float, Int64

LEAST = 0.1  # least probability that a detected landmark is in view
WIDER, FARTHER = 0.5, 1.25
"""Margin [rad] of the sector in view beyond the outermost bearing, and its least range in multiples
of the median, for robots that stand still.
"""
ROUNDS = 30  # most rounds of belief propagation
SETTLED = 1e-6  # change of the messages below which belief propagation ends


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
    scans: Scans,
    landmark_of: Int64[np.ndarray, " N"],
    window: SmoothedWindow,
    settings: AssociationSettings,
) -> Float[np.ndarray, " N"]:
    """Compute the probability that each detection is of its landmark; 0 without one."""
    view = estimate_view(scans)
    counts = np.bincount(landmark_of[landmark_of != UNASSIGNED], minlength=len(window.landmarks))
    alone = landmark_of == UNASSIGNED
    alone |= counts[landmark_of] < settings.least_seen
    out = (1.0 + np.count_nonzero(alone)) / (view.looks * view.area)
    found = np.zeros(len(landmark_of))
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
        found[of_scan] = marginals(weights)[np.arange(len(chosen)), chosen]
    return found


def marginals(weights: Float[np.ndarray, "n L"]) -> Float[np.ndarray, "n L"]:
    """Compute P(detection i is of landmark j) from the odds ψ_ij, with one-to-one pairs."""
    messages = np.ones_like(weights)
    for _ in range(ROUNDS):
        of_landmark = (weights * messages).sum(axis=0) - weights * messages
        forward = weights / (1.0 + np.maximum(of_landmark, 0.0))
        of_detection = forward.sum(axis=1, keepdims=True) - forward
        before, messages = messages, 1.0 / (1.0 + np.maximum(of_detection, 0.0))
        if np.abs(messages - before).max(initial=0.0) < SETTLED:
            break
    total = 1.0 + forward.sum(axis=1, keepdims=True)
    return np.asarray(forward / total)
