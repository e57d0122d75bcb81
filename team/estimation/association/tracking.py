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
from teamslam.team.estimation.association.gating import (
    compute_mahalanobis,
    match_best_first,
    match_scan,
)
from teamslam.team.estimation.association.scans import (
    UNASSIGNED,
    Scans,
    initialise_landmark,
    pose_jacobians,
    predict_landmarks,
    rotation,
)
from teamslam.team.estimation.consistency import chi2_limit
from teamslam.team.estimation.se2 import adjoint, compose, inverse
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

    def update(
        self,
        landmarks: Int64[np.ndarray, " m"],
        points: Float[np.ndarray, "m 2"],
        covariances: Float[np.ndarray, "m 2 2"],
    ) -> None:
        """Update the state jointly by the detections of these landmarks."""
        m, n = len(landmarks), self._size
        if not m:
            return
        H, seen = self._linearise(landmarks)
        P = self._P[:n, :n]
        HP = dense.product(H, P)
        S = dense.product(HP, H.T)
        S.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m)] += covariances
        gain = dense.solve(S, HP).T
        step = dense.product(gain, (points - seen).ravel())
        P -= dense.product(gain, HP)
        np.multiply(P + P.T, 0.5, out=P)
        self.pose = compose(self.pose, step[:3])
        self._points[: len(self.names)] += step[3:].reshape(-1, 2)

    def _linearise(
        self, landmarks: Int64[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, "_ n"], Float[np.ndarray, "m 2"]]:
        m = len(landmarks)
        turn = rotation(self.pose[2])
        seen = dense.product(self.landmarks[landmarks] - self.pose[:2], turn)
        H = np.zeros((m, 2, self._size))
        H[:, :, :3] = pose_jacobians(seen)
        columns = 3 + 2 * landmarks[:, None] + np.arange(2)
        H[np.arange(m)[:, None, None], np.arange(2)[:, None], columns[:, None, :]] = turn.T
        return H.reshape(2 * m, -1), seen

    def add_landmark(
        self, point: Float[np.ndarray, "2"], covariance: Float[np.ndarray, "2 2"], name: int
    ) -> int:
        """Add a landmark from a detection; return its index."""
        index = len(self.names)
        at = initialise_landmark(self.pose, point, covariance, self._P, 0, self._size)
        self._points[index] = at
        self.names.append(name)
        return index

    def match_scan(
        self,
        points: Float[np.ndarray, "n 2"],
        covariances: Float[np.ndarray, "n 2 2"],
        names: Int64[np.ndarray, " n"],
    ) -> Int64[np.ndarray, " n"]:
        """Match the detections of a scan; UNASSIGNED without a match."""
        if not len(points) or not self.names:
            return np.full(len(points), UNASSIGNED)
        predicted = self.predict_landmarks()
        return match_scan(
            points, covariances, names, predicted, np.array(self.names), self._settings
        )

    def joint_distance_ratio(
        self,
        landmarks: Int64[np.ndarray, " m"],
        points: Float[np.ndarray, "m 2"],
        covariances: Float[np.ndarray, "m 2 2"],
    ) -> float:
        """Compute the joint squared Mahalanobis distance of these pairs over its limit (RARE)."""
        m, n = len(landmarks), self._size
        if not m:
            return 0.0
        H, seen = self._linearise(landmarks)
        S = dense.product(dense.product(H, self._P[:n, :n]), H.T)
        S.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m)] += covariances
        error = (points - seen).ravel()
        return float(dense.product(error, dense.solve(S, error)) / chi2_limit(2 * m, RARE))

    def find_slip(
        self,
        points: Float[np.ndarray, "n 2"],
        covariances: Float[np.ndarray, "n 2 2"],
        found: Int64[np.ndarray, " n"],
    ) -> Float[np.ndarray, "3"] | None:
        """Find the slip (forward, left, turn) that explains most of a scan, or None.

        Each pair of a detection and a landmark within slip_m proposes a slip. It must explain more
        pairs than those `found` without it, and fit better by more than the cost of one misfitting
        pair.
        """
        gate, reach = self._settings.gate, self._settings.slip_m
        seen, spread = self.predict_landmarks()
        Hp = pose_jacobians(seen)
        loose = np.diag(
            [
                core.squared(0.5 * reach),
                core.squared(0.5 * reach),
                core.squared(SLIP_TURN),
            ]
        )
        tight = self._P[:3, :3]
        own = spread - dense.product(dense.product(Hp, tight), Hp.transpose(0, 2, 1))
        own += 1e-6 * np.eye(2) + np.maximum(
            -_smaller_eigenvalue(own)[:, None, None], 0.0
        ) * np.eye(2)
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
            costs = squared + core.log(determinants)
            pairs = match_best_first(squared < gate, costs)
            rows = np.nonzero(pairs != UNASSIGNED)[0]
            figure = float(len(rows)), -float(squared[rows, pairs[rows]].sum())
            if figure > best and gate * (len(points) - len(rows)) - figure[1] < most:
                best, slip = figure, (rows, pairs[rows])
        if slip is None:
            return None
        rows, columns = slip
        H = Hp[columns].reshape(-1, 3)
        S = dense.product(dense.product(H, loose + tight), H.T)
        m = len(rows)
        S.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m)] += covariances[rows] + own[columns]
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
    bounds = scans.bounds
    poses = np.empty_like(scans.motions)
    slips: list[Slip] = []
    for k, motion in enumerate(scans.motions):
        tracker.predict_pose(motion, scans.motion_covariances[k])
        of_scan = slice(bounds[k], bounds[k + 1])
        points, covariances = scans.points[of_scan], scans.covariances[of_scan]
        names = scans.names[of_scan]
        found = tracker.match_scan(points, covariances, names)
        if settings.slip_m and _is_slip_suspected(
            tracker, found, points, covariances, settings.slip_m
        ):
            by = tracker.find_slip(points, covariances, found)
            if by is not None:
                slips.append(Slip(k, by))
                tracker.apply_slip(by)
                found = tracker.match_scan(points, covariances, names)
        known = np.nonzero(found != UNASSIGNED)[0]
        tracker.update(found[known], points[known], covariances[known])
        for row in np.nonzero(found == UNASSIGNED)[0]:
            found[row] = tracker.add_landmark(points[row], covariances[row], int(names[row]))
        landmark_of[of_scan] = found
        poses[k] = tracker.pose
    return TrackedWindow(landmark_of, tracker.names, poses, tracker.landmarks.copy(), slips)


def _is_slip_suspected(
    tracker: Tracker,
    found: Int64[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    reach: float,
) -> bool:
    known = np.nonzero(found != UNASSIGNED)[0]
    if len(points) < SLIP_DETECTIONS or len(tracker.names) < SLIP_DETECTIONS:
        return False
    if len(known) < FEW * len(points) or _is_match_missed(tracker, found, points, reach):
        return True
    return tracker.joint_distance_ratio(found[known], points[known], covariances[known]) > 1.0


def _is_match_missed(
    tracker: Tracker,
    found: Int64[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    reach: float,
) -> bool:
    seen, _ = tracker.predict_landmarks()
    free = np.ones(len(seen), np.bool_)
    free[found[found != UNASSIGNED]] = False
    offsets = points[found == UNASSIGNED][:, None] - seen[free][None]
    return bool((core.hypot(offsets[..., 0], offsets[..., 1]) < reach).any())


def _smaller_eigenvalue(S: Float[np.ndarray, "l 2 2"]) -> Float[np.ndarray, " l"]:
    half = 0.5 * (S[:, 0, 0] - S[:, 1, 1])
    return np.asarray(
        0.5 * (S[:, 0, 0] + S[:, 1, 1]) - np.sqrt(half * half + S[:, 1, 0] * S[:, 1, 0])
    )
