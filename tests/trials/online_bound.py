"""Bound of online poses: the batch estimate of all measurements of the team until then.

An extended Kalman filter over the poses at t and all landmarks, with Jacobians at the true state,
bounds the mean accuracy of any estimator. For simulated worlds with known initial poses and one
noise per second; its models are its own.
"""

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.world import streams as s
from teamslam.sim.world.streams import RobotStream, WorldStreams
from teamslam.team.config import RobotConfig

FAR = float(chi2.isf(1e-9, 3))  # NEES of a pose that lies far outside its own covariance
UNKNOWN_M2 = 1e6  # the variance of a landmark that nobody has seen


class Bounded(NamedTuple):
    """Errors (x, y, θ), covariances and true headings of a robot's poses at stamps_ns."""

    stamps_ns: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    headings: np.ndarray

    def rmse_m(self, stamps_ns: np.ndarray) -> float:
        at = np.isin(self.stamps_ns, stamps_ns)
        return float(np.sqrt(np.mean(np.sum(self.errors[at, :2] ** 2, axis=1))))

    def sigma_m(self, stamps_ns: np.ndarray) -> float:
        """Expected RMSE [m]."""
        at = np.isin(self.stamps_ns, stamps_ns)
        variances = self.covariances[at, 0, 0] + self.covariances[at, 1, 1]
        return float(np.sqrt(np.mean(variances)))

    def nees_on_arcs(self) -> np.ndarray:
        """NEES of (x, y, θ) of the estimate truth ∘ Exp(error).

        Even with the right covariance a heading off by three sigma leaves the ellipse.
        """
        found = np.empty(len(self.errors))
        for k, (error, covariance) in enumerate(zip(self.errors, self.covariances, strict=True)):
            c, s_ = np.cos(self.headings[k]), np.sin(self.headings[k])
            R = np.array([[c, -s_, 0.0], [s_, c, 0.0], [0.0, 0.0, 1.0]])
            forward, left, turn = R.T @ error
            a = np.sinc(turn / np.pi)
            b = np.sinc(0.5 * turn / np.pi) * np.sin(0.5 * turn)
            there = R @ [a * forward - b * left, b * forward + a * left, turn]
            c, s_ = np.cos(turn), np.sin(turn)
            turned = np.array([[c, -s_, 0.0], [s_, c, 0.0], [0.0, 0.0, 1.0]])
            P = turned @ covariance @ turned.T
            found[k] = there @ np.linalg.lstsq(P, there)[0]  # of rank 2 after the first interval
        return found

    def nees_per_dof(self, stamps_ns: np.ndarray) -> float:
        at = np.isin(self.stamps_ns, stamps_ns)
        solved = np.linalg.solve(self.covariances[at], self.errors[at, :, np.newaxis])[:, :, 0]
        return float(np.mean(np.sum(self.errors[at] * solved, axis=1)) / 3.0)


def bounds(scenario: Scenario, world: WorldStreams) -> dict[str, Bounded]:
    filter_ = _AtTruth(world)
    found: dict[str, list[tuple[int, np.ndarray, np.ndarray, float]]] = {
        config.id: [] for config in scenario.robots
    }
    robots, counters = world.order()
    seen: dict[tuple[int, int], int] = {}
    for robot, counter in zip(robots.tolist(), counters.tolist(), strict=True):
        stream, config = world.streams[robot], scenario.robots[robot]
        stamp_ns = int(stream.stamps_ns[counter])
        if stream.kinds[counter] == s.OBSERVATIONS:
            seen[robot, stamp_ns] = counter
        elif stream.kinds[counter] == s.ODOMETRY:
            filter_.drive(robot, stream, counter, config)
            if (robot, stamp_ns) in seen:
                filter_.look(robot, stream, seen[robot, stamp_ns], config)
            heading = float(_true(stream, stamp_ns)[2])
            found[config.id].append((stamp_ns, *filter_.pose(robot), heading))
    return {
        name: Bounded(*(np.array(part) for part in zip(*rows, strict=True)))
        for name, rows in found.items()
    }


class _AtTruth:
    """The error e = estimate − truth of (all poses, all landmarks) and its covariance."""

    def __init__(self, world: WorldStreams) -> None:
        self._landmarks = world.landmarks
        self._place = {int(id_): k for k, id_ in enumerate(world.landmark_ids)}
        self._poses = 3 * len(world.streams)
        n = self._poses + 2 * len(world.landmarks)
        self._error = np.zeros(n)
        self._P = np.zeros((n, n))
        at = np.arange(self._poses, n)
        self._P[at, at] = UNKNOWN_M2

    def pose(self, robot: int) -> tuple[np.ndarray, np.ndarray]:
        at = slice(3 * robot, 3 * robot + 3)
        return self._error[at].copy(), self._P[at, at].copy()

    def drive(self, robot: int, stream: RobotStream, counter: int, config: RobotConfig) -> None:
        """(x, y, θ) → (x + d cos(θ + φ), y + d sin(θ + φ), θ + φ), with errors of d and φ."""
        driven, k = stream.intervals, int(stream.rows[counter])
        end_ns, duration_ns = int(driven.end_ns[k]), int(driven.duration_ns[k])
        after, before = _true(stream, end_ns), _true(stream, end_ns - duration_ns)
        seconds = duration_ns * 1e-9
        way = after[:2] - before[:2]
        heading = before[2] + _around(after[2] - before[2])
        distance = float(way @ [np.cos(heading), np.sin(heading)])
        noise = np.array(
            [
                float(driven.forward[k]) * seconds - distance,
                _around(float(driven.yaw_rate[k]) * seconds - (after[2] - before[2])),
            ]
        )
        F, G = np.eye(3), np.zeros((3, 2))
        F[:2, 2] = G[:2, 1] = -distance * np.sin(heading), distance * np.cos(heading)
        G[:2, 0] = np.cos(heading), np.sin(heading)
        G[2, 1] = 1.0
        Q = np.diag([config.motion.forward.per_s**2, config.motion.turn.per_s**2]) * seconds
        at = slice(3 * robot, 3 * robot + 3)
        self._error[at] = F @ self._error[at] + G @ noise
        self._P[at] = F @ self._P[at]
        self._P[:, at] = self._P[:, at] @ F.T
        self._P[at, at] += G @ Q @ G.T

    def look(self, robot: int, stream: RobotStream, counter: int, config: RobotConfig) -> None:
        seen = stream.landmark_detections
        at = seen.rows(int(stream.rows[counter]))
        scan = seen.ids[at], seen.ranges[at], seen.bearings[at]
        pose = _true(stream, int(stream.stamps_ns[counter]))
        R = np.array([config.sensor.range_sigma**2, config.sensor.bearing_sigma**2])
        for id_, measured, bearing in zip(*scan, strict=True):
            place = self._place[int(id_)]
            dx, dy = self._landmarks[place] - pose[:2]
            r = float(np.hypot(dx, dy))
            noise = measured - r, _around(bearing + pose[2] - np.arctan2(dy, dx))
            to = np.array([[dx, dy], [-dy / r, dx / r]]) / r
            at = self._poses + 2 * place
            for row in range(2):
                H = np.zeros(len(self._error))
                H[3 * robot : 3 * robot + 2] = -to[row]
                H[3 * robot + 2] = -float(row)
                H[at : at + 2] = to[row]
                self._condition(H, noise[row], R[row])

    def _condition(self, H: np.ndarray, noise: float, variance: float) -> None:
        """Joseph's form of P with one number that reads H x and has an error of this variance."""
        PH = self._P @ H
        total = float(H @ PH) + variance
        gain = PH / total
        self._error += gain * (noise - float(H @ self._error))
        self._P -= np.outer(gain, PH) + np.outer(PH, gain)
        self._P += total * np.outer(gain, gain)


def _true(stream: RobotStream, stamp_ns: int) -> np.ndarray:
    return np.asarray(stream.truth[np.searchsorted(stream.truth_ns, stamp_ns)])


def _around(angle: float) -> float:
    """In (−π, π]."""
    return float(np.angle(np.exp(1j * angle)))


def longest_s(stamps_ns: np.ndarray, far: np.ndarray) -> float:
    """Longest time [s] in a row in which this holds."""
    longest, far_since = 0.0, None
    for stamp_ns, is_far in zip(stamps_ns.tolist(), far.tolist(), strict=True):
        far_since = None if not is_far else stamp_ns if far_since is None else far_since
        if far_since is not None:
            longest = max(longest, (stamp_ns - far_since) * 1e-9)
    return longest
