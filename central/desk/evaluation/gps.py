"""Compare paths with positions of another sensor in another frame and clock."""

from collections.abc import Mapping

import numpy as np

from teamslam.central.desk.evaluation.errors import Path
from teamslam.central.desk.evaluation.log import Collected
from teamslam.team.shapes import Float, Int64
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, stamps

LEAST = 10
GAP_NS = 1_500_000_000
"""Largest gap between fixes that is interpolated."""
SHIFTS_S = np.arange(-1.0, 1.01, 0.25)
ROUNDS = 20
NEAREST_M = 0.1
"""Least distance [m] in the weights 1/d."""

Fixes = tuple[Int64[np.ndarray, " G"], Float[np.ndarray, "G 2"]]


def gps_median(log: Collected, paths: Mapping[str, Path]) -> float | None:
    """Median distance [m] of smoothed poses from the other sensor's positions, or None.

    Fits one rigid motion, lever arm and time shift per team by least absolute distances.
    """
    fixes = {robot: found for robot in paths if (found := _fixes(log, robot)) is not None}
    if not fixes:
        return None
    medians = [_median(fixes, paths, float(shift)) for shift in SHIFTS_S]
    return min((each for each in medians if each is not None), default=None)


def _fixes(log: Collected, robot: str) -> Fixes | None:
    message = next(iter(log.messages(ch.TRUTH_POSITIONS, m.TruthPositions, robot)), None)
    if message is None:
        return None
    places = floats(message.positions, "positions").astype(np.float64).reshape(-1, 2)
    at_ns = stamps(message.stamps, "stamps").astype(np.int64)
    return (at_ns, places) if len(at_ns) > 1 else None


def _median(fixes: Mapping[str, Fixes], paths: Mapping[str, Path], shift_s: float) -> float | None:
    poses, there = [], []
    for robot, (at_ns, places) in fixes.items():
        path = paths[robot]
        shifted_ns = path.stamps_ns + round(shift_s * 1e9)
        after = np.searchsorted(at_ns, shifted_ns)
        inside = (after > 0) & (after < len(at_ns))
        after = np.clip(after, 1, len(at_ns) - 1)
        inside &= at_ns[after] - at_ns[after - 1] <= GAP_NS
        columns = [np.interp(shifted_ns[inside], at_ns, places[:, i]) for i in range(2)]
        there.append(np.column_stack(columns))
        poses.append(path.poses[inside])
    if sum(map(len, poses)) < LEAST:
        return None
    return float(np.median(distances(np.concatenate(poses), np.concatenate(there))))


def distances(
    poses: Float[np.ndarray, "n 3"], there: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """‖there − (A (t + R(θ) lever) + b)‖ after the best rigid motion (A, b) and lever.

    With A = [[u, −v], [v, u]] the model is linear in (u, v, b, A lever); then u² + v² = 1 is
    restored.
    """
    n = len(poses)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    one, none = np.ones(n), np.zeros(n)
    J = np.zeros((n, 2, 6))
    J[:, 0] = np.column_stack((poses[:, 0], -poses[:, 1], one, none, c, -s))
    J[:, 1] = np.column_stack((poses[:, 1], poses[:, 0], none, one, s, c))
    weights, found = np.ones(n), np.zeros(n)
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        A = (J * root[:, :, None]).reshape(2 * n, 6)
        solved = np.linalg.lstsq(A, (there * root).ravel(), rcond=None)[0]
        turn = solved[:2] / max(float(np.hypot(*solved[:2])), 1e-9)
        rest = there - J[:, :, :2] @ turn
        solved = np.linalg.lstsq(A[:, 2:], (rest * root).ravel(), rcond=None)[0]
        found = np.hypot(*(rest - J[:, :, 2:] @ solved).T)
        weights = 1.0 / np.maximum(found, NEAREST_M)
    return found
