"""Tracking within a window: an extended Kalman filter that matches the best pair first.

EKF-SLAM (Smith, Self and Cheeseman 1990) with detections as points. A slip of the odometry is
detected where few detections match, but nearly all after a jump of the robot (one-point RANSAC;
Ortín and Montiel 2001); it enlarges the covariance of that motion.
"""

from typing import NamedTuple

import numpy as np

from teamslam.team import core
from teamslam.team.config import AssociationSettings
from teamslam.team.estimation import dense
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    Detections,
    Scans,
    compute_mahalanobis,
    initialise_landmark,
    match_best_first,
    match_scan,
    pose_jacobians,
    predict_landmarks,
)
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.se2 import adjoint, compose, inverse, rotation
from teamslam.team.shapes import Float, Int64

FEW = 0.5  # share of matched detections in a scan below which a slip is suspected
MOST = 0.7  # least share of the possible pairs that match after an accepted slip
RARE = 1e-3  # probability with which correct pairs exceed the limit of the joint distance
SLIP_TURN = 0.1  # standard deviation of the rotation of a slip [rad]
LEAST_SLIP = 0.02  # least standard deviation of a slip [m, rad]
SLIP_DETECTIONS = 3  # least number of detections in a scan, and of landmarks, to search for a slip


class Slip(NamedTuple):
    """A slip of about (forward [m], left [m], turn [rad]) in the odometry before a keyframe."""

    keyframe: int
    by: Float[np.ndarray, "3"]


class TrackedWindow(NamedTuple):
    """The landmark of each detection, and the landmarks' names and positions."""

    landmark_of: Int64[np.ndarray, " N"]
    names: list[int]
    poses: Float[np.ndarray, "K 3"]
    landmarks: Float[np.ndarray, "L 2"]
    slips: list[Slip]


class Tracker:
    """State of the filter: pose, landmarks and their joint covariance."""

    def __init__(self, settings: AssociationSettings, most: int) -> None:
        self._settings = settings
        self.pose = np.zeros(3)
        self.names: list[int] = []
        self._points = np.empty((most, 2))
        self._P = np.zeros((3 + 2 * most, 3 + 2 * most))

    @property
    def landmarks(self) -> Float[np.ndarray, "L 2"]:
        """Landmark positions [m] in the window's frame."""
        return self._points[: len(self.names)]

    @property
    def _size(self) -> int:
        return 3 + 2 * len(self.names)

    def predict_pose(
        self, motion: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]
    ) -> None:
        """Predict the pose at the next keyframe."""
        n = self._size
        Ad = adjoint(inverse(motion))
        self.pose = compose(self.pose, motion)
        self._P[:3, :n] = dense.product(Ad, self._P[:3, :n])
        self._P[:n, :3] = dense.product(self._P[:n, :3], Ad.T)
        self._P[:3, :3] += covariance

    def predict_landmarks(self) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2 2"]]:
        """Predict each landmark's position relative to the robot, with its covariance."""
        return predict_landmarks(self.pose, self.landmarks, self._P, 0, 3)

    def apply_slip(self, by: Float[np.ndarray, "3"]) -> None:
        """Move the pose by a slip (forward, left, turn), with its uncertainty."""
        self.pose = compose(self.pose, by)
        self._P[:3, :3] += slip_covariance(by)

    def update(self, landmarks: Int64[np.ndarray, " m"], scan: Detections) -> None:
        """Update the state jointly by the detections of these landmarks."""
        if not len(landmarks):
            return
        HP, S, error = self._predict(landmarks, scan)
        gain = dense.solve(S, HP).T
        step = dense.product(gain, error)
        P = self._P[: len(gain), : len(gain)]
        P -= dense.product(gain, HP)
        np.multiply(P + P.T, 0.5, out=P)
        self.pose = compose(self.pose, step[:3])
        self._points[: len(self.names)] += step[3:].reshape(-1, 2)

    def _predict(
        self, landmarks: Int64[np.ndarray, " m"], scan: Detections
    ) -> tuple[Float[np.ndarray, "_ n"], Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
        """Return H P, S = H P Hᵀ + R and the innovation of the detections of these landmarks."""
        m, n = len(landmarks), self._size
        turn = rotation(self.pose[2])
        seen = dense.product(self.landmarks[landmarks] - self.pose[:2], turn)
        H = np.zeros((m, 2, n))
        H[:, :, :3] = pose_jacobians(seen)
        columns = 3 + 2 * landmarks[:, None] + np.arange(2)
        H[np.arange(m)[:, None, None], np.arange(2)[:, None], columns[:, None, :]] = turn.T
        rows = H.reshape(2 * m, n)
        HP = dense.product(rows, self._P[:n, :n])
        S = dense.product(HP, rows.T)
        dense.add_to_blocks(S, scan.covariances)
        return HP, S, (scan.points - seen).ravel()

    def add_landmark(self, scan: Detections, row: int) -> int:
        """Add a landmark from a detection; return its index."""
        index = len(self.names)
        self._points[index] = initialise_landmark(
            self.pose, scan.points[row], scan.covariances[row], self._P, 0, self._size
        )
        self.names.append(int(scan.names[row]))
        return index

    def match_scan(self, scan: Detections) -> Int64[np.ndarray, " n"]:
        """Match the detections of a scan; UNASSIGNED without a match."""
        if not len(scan.points) or not self.names:
            return np.full(len(scan.points), UNASSIGNED)
        return match_scan(scan, self.predict_landmarks(), np.array(self.names), self._settings)

    def is_slip_suspected(self, scan: Detections, found: Int64[np.ndarray, " n"]) -> bool:
        """Return whether few match, one lacks a near match, or all fit badly together."""
        known = np.nonzero(found != UNASSIGNED)[0]
        if min(len(scan.points), len(self.names)) < SLIP_DETECTIONS:
            return False
        if len(known) < FEW * len(scan.points):
            return True
        free = np.delete(self.predict_landmarks()[0], found[known], axis=0)
        offsets = scan.points[found == UNASSIGNED][:, None] - free[None]
        if (core.hypot(offsets[..., 0], offsets[..., 1]) < self._settings.slip_m).any():
            return True
        _, S, error = self._predict(found[known], scan.select(known))
        squared = float(dense.product(error, dense.solve(S, error)))
        return squared > chi2_limit(2 * len(known), RARE)

    def find_slip(
        self, scan: Detections, found: Int64[np.ndarray, " n"]
    ) -> Float[np.ndarray, "3"] | None:
        """Find the slip (forward, left, turn) that explains most of a scan, or None.

        Each pair of a detection and a landmark within slip_m proposes a slip. It must explain more
        pairs than those `found` without it, and fit better by more than the cost of one misfitting
        pair.
        """
        gate, reach = self._settings.gate, self._settings.slip_m
        points, covariances = scan.points, scan.covariances
        seen, spread = self.predict_landmarks()
        Hp = pose_jacobians(seen)
        loose = np.diag(core.squared(np.array([0.5 * reach, 0.5 * reach, SLIP_TURN])))
        tight = self._P[:3, :3]
        own = spread - dense.congruent(Hp, tight)
        own += (1e-6 + np.maximum(-_smaller_eigenvalue(own), 0.0))[:, None, None] * np.eye(2)
        HpD = dense.product(Hp, loose + tight)
        offsets = points[:, None] - seen[None]
        near = core.hypot(offsets[..., 0], offsets[..., 1]) < reach
        possible = min(int(near.any(axis=1).sum()), int(near.any(axis=0).sum()))
        least = MOST * max(possible, SLIP_DETECTIONS)
        known = np.nonzero(found != UNASSIGNED)[0]
        before, _ = compute_mahalanobis(
            offsets[known, found[known]], spread[found[known]] + covariances[known]
        )
        most = gate * (len(points) - len(known) - 1) + float(np.minimum(before, gate).sum())
        best = (max(least, len(known) + 1) - 1e-9, 0.0)
        slip = None
        for row, column in np.argwhere(near):
            C = dense.product(HpD[column], Hp.transpose(0, 2, 1))  # proposing landmark with each
            gain = dense.product(
                C.transpose(0, 2, 1), dense.inverse(C[column] + own[column] + covariances[row])
            )
            S = dense.product(HpD, Hp.transpose(0, 2, 1)) - dense.product(gain, C) + own
            offsets_after = offsets - np.einsum("lij,j->li", gain, offsets[row, column])
            squared, determinants = compute_mahalanobis(
                offsets_after, S[None] + covariances[:, None]
            )
            pairs = match_best_first(squared < gate, squared + core.log(determinants))
            rows = np.nonzero(pairs != UNASSIGNED)[0]
            figure = float(len(rows)), -float(squared[rows, pairs[rows]].sum())
            if figure > best and gate * (len(points) - len(rows)) - figure[1] < most:
                best, slip = figure, (rows, pairs[rows])
        if slip is None:
            return None
        rows, columns = slip
        H = Hp[columns].reshape(-1, 3)
        S = dense.congruent(H, loose + tight)
        dense.add_to_blocks(S, covariances[rows] + own[columns])
        error = offsets[rows, columns].ravel()
        return np.asarray(dense.product(dense.product(loose + tight, H.T), dense.solve(S, error)))


def slip_covariance(slip: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return diag(d², d², φ²) of a slip by the distance d and turn φ, both at least LEAST_SLIP."""
    metres = max(core.hypot(*slip[:2]), LEAST_SLIP)
    turn = max(abs(float(slip[2])), LEAST_SLIP)
    return np.diag([core.squared(metres), core.squared(metres), core.squared(turn)])


def track_window(scans: Scans, settings: AssociationSettings) -> TrackedWindow:
    """Associate a window's detections scan by scan."""
    tracker = Tracker(settings, len(scans.points))
    landmark_of = np.full(len(scans.points), UNASSIGNED)
    poses = np.empty_like(scans.motions)
    slips: list[Slip] = []
    for k, motion in enumerate(scans.motions):
        tracker.predict_pose(motion, scans.motion_covariances[k])
        scan = scans.detections(k)
        found = tracker.match_scan(scan)
        if settings.slip_m and tracker.is_slip_suspected(scan, found):
            by = tracker.find_slip(scan, found)
            if by is not None:
                slips.append(Slip(k, by))
                tracker.apply_slip(by)
                found = tracker.match_scan(scan)
        known = np.nonzero(found != UNASSIGNED)[0]
        tracker.update(found[known], scan.select(known))
        for row in np.nonzero(found == UNASSIGNED)[0].tolist():
            found[row] = tracker.add_landmark(scan, row)
        landmark_of[scans.rows[k]] = found
        poses[k] = tracker.pose
    return TrackedWindow(landmark_of, tracker.names, poses, tracker.landmarks.copy(), slips)


def _smaller_eigenvalue(S: Float[np.ndarray, "l 2 2"]) -> Float[np.ndarray, " l"]:
    half = 0.5 * (S[:, 0, 0] - S[:, 1, 1])
    return np.asarray(
        0.5 * (S[:, 0, 0] + S[:, 1, 1]) - np.sqrt(half * half + S[:, 1, 0] * S[:, 1, 0])
    )
