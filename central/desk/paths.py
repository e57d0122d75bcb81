"""Smoothed paths at keyframe rate from a log's final map and measurements.

Windows are recomputed and fitted between the map's poses at submap ends
(`teamslam.team.estimation.hybrid_slam.window_path`).
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from teamslam.central.desk.left_out import is_kept, spans_left_out
from teamslam.central.desk.verification.recorded import Recorded, RecordedWindow, RerunError
from teamslam.central.desk.verification.robot import run_alone
from teamslam.team import translate
from teamslam.team.estimation.hybrid_slam.window_path import Ends, placed
from teamslam.team.shapes import Float, Int64
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, stamps


@dataclass(frozen=True)
class SmoothedPath:
    """Poses (x [m], y [m], theta [rad]) in the final map by ascending stamp.

    at_keyframes: includes poses between submap ends.
    """

    stamps_ns: Int64[np.ndarray, " K"]
    poses: Float[np.ndarray, "K 3"]
    covariances: Float[np.ndarray, "K 3 3"]
    at_keyframes: bool


def smoothed_paths(
    found: Recorded, progress: Callable[[str], None] = lambda _: None
) -> dict[str, SmoothedPath]:
    """Compute the path of every robot in the final map, without spoilt parts (`left_out`)."""
    last: dict[tuple[str, int, int], m.Trajectory] = {}
    for message in found.of(m.Trajectory, ch.TRAJECTORY):
        begin = int(stamps(message.stamps, "stamps")[0])
        last[message.robot, message.incarnation, begin] = message
    parts: dict[str, list[SmoothedPath]] = {}
    ends: dict[str, list[int]] = {}
    for (robot, incarnation, _), message in sorted(last.items()):
        progress(robot)
        windows = _windows(found, robot, incarnation) if message.crosses else {}
        parts.setdefault(robot, []).append(_between_ends(found, message, windows))
        ends.setdefault(robot, []).extend(stamps(message.stamps, "stamps").tolist())
    maps = found.of(m.FusedMap, ch.FINAL_MAP)
    causes = maps[-1].diagnosis if maps else ()
    paths = {}
    for robot in parts:
        path = _join_parts(parts[robot])
        kept = is_kept(path.stamps_ns, spans_left_out(causes, robot, ends[robot]))
        paths[robot] = SmoothedPath(
            path.stamps_ns[kept],
            path.poses[kept],
            path.covariances[kept],
            at_keyframes=path.at_keyframes,
        )
    return paths


def _windows(found: Recorded, robot: str, incarnation: int) -> Mapping[int, RecordedWindow]:
    with suppress(RerunError):
        if found.robot_config(robot)[0].estimator == "hybrid":
            return run_alone(found, robot, incarnation).windows
    return {}


def _between_ends(
    found: Recorded, message: m.Trajectory, windows: Mapping[int, RecordedWindow]
) -> SmoothedPath:
    stamps, poses = translate.trajectory_of(message)
    covariances = floats(message.covariances, "covariances").reshape(-1, 3, 3)
    if not windows:
        return SmoothedPath(stamps, poses, covariances, at_keyframes=False)
    factor = found.central_config()[0].covariance_factor
    crosses = floats(message.crosses, "crosses").reshape(-1, 3, 3)
    before = floats(message.start, "start")
    spread = floats(message.start_covariance, "start_covariance").reshape(3, 3)
    first = windows.get(int(stamps[0]))
    parts = [] if first is None else [(np.array([first.start_ns]), before[None], spread[None])]
    for stamp, pose, covariance, cross in zip(stamps, poses, covariances, crosses, strict=True):
        closed = windows.get(int(stamp))
        path = None if closed is None else closed.path
        if path is not None:
            ends = Ends(before, pose, np.block([[spread, cross.T], [cross, covariance]]))
            within = path.stamps_ns < stamp
            placed_poses, placed_covariances = placed(path, ends, factor)
            parts.append((path.stamps_ns[within], placed_poses[within], placed_covariances[within]))
        parts.append((np.array([stamp]), pose[None], covariance[None]))
        before, spread = pose, covariance
    stamps, poses, covariances = map(np.concatenate, zip(*parts, strict=True))
    return SmoothedPath(stamps, poses, covariances, at_keyframes=True)


def _join_parts(parts: list[SmoothedPath]) -> SmoothedPath:
    """Join by stamp; a window's end, which the final map has, precedes an equal keyframe."""
    arrays = zip(*((part.stamps_ns, part.poses, part.covariances) for part in parts), strict=True)
    stamps, poses, covariances = map(np.concatenate, arrays)
    stamps, first = np.unique(stamps, return_index=True)
    dense = all(part.at_keyframes for part in parts)
    return SmoothedPath(stamps, poses[first], covariances[first], at_keyframes=dense)
