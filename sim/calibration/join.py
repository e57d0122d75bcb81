"""Team map and paths from measurements: the reference without truth."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.central.tick_fold import join_settings
from teamslam.sim.calibration.data import messages_of
from teamslam.sim.calibration.figures import CalibrationError
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.world.streams import RobotStream, WorldStreams
from teamslam.team import translate
from teamslam.team.config import RobotConfig, Sensor
from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.hybrid_slam.pipeline import HybridSlam
from teamslam.team.estimation.hybrid_slam.window import (
    NOTHING,
    ClosedWindow,
    Innovation,
    Window,
)
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Fold,
    Tick,
    add_start,
    fold_submaps,
    solve_fold,
)
from teamslam.team.estimation.map_joining.tick import fold_tick
from teamslam.team.estimation.se2 import compose
from teamslam.team.shapes import Float, Int64
from teamslam.team.wire import messages as m


@dataclass(frozen=True)
class _Track:
    closed: ClosedWindow
    stamps_ns: Int64[np.ndarray, " K"]
    path: Float[np.ndarray, "K 3"]


@dataclass(frozen=True)
class JoinedTeam:
    """Landmarks and paths in the joined map's frame.

    innovation: NIS of all windows. least: its least expected value under the stated models: white
    errors count in full, and those that last a window can vanish from innovations.
    """

    landmarks: Mapping[int, Float[np.ndarray, "2"]]
    paths: Mapping[str, Path]
    fold: Fold
    contributions: Sequence[Contribution] = ()
    innovation: Innovation = NOTHING
    least: float = 0.0


def join_team(
    world: WorldStreams, scenario: Scenario, progress: Callable[[str], None] = lambda _: None
) -> JoinedTeam:
    """Join every robot's windows; main island only; raises CalibrationError without submaps.

    Between window ends a path is the particle mean, moved to end at the joined pose.
    """
    tracks = {}
    for each in world.streams:
        tracks[each.robot] = _tracks(config_of(each.robot, scenario), each)
        progress(each.robot)
    starts = [
        InitialPoseFactor(stream.robot, 1, stream.start.pose, stream.start.covariance)
        for stream in world.streams
        if stream.start is not None and tracks.get(stream.robot)
    ]
    contributions = [
        Contribution(robot, 1, t.closed.sequence, t.closed.end_ns, t.closed.local)
        for robot, windows in tracks.items()
        for t in windows
    ]
    if not contributions:
        raise CalibrationError(
            "no robot has odometry and measurements of landmarks that make a submap: without "
            "ground truth `calibrate` learns from the joined map"
        )
    fold = fold_of(contributions, starts, scenario.central)
    graph, state = fold.main.graph, fold.main.state
    landmarks = {
        id_: state[graph.offset[node] : graph.offset[node] + 2].copy()
        for id_, node in sorted(graph.landmarks.items())
    }
    paths = {}
    for (robot, _), nodes in sorted(graph.streams.items()):
        at = graph.offset[list(nodes)]
        ends = state[at[:, np.newaxis] + np.arange(3)]
        paths[robot] = _bend_to_ends(tracks[robot], ends)
    innovation, least = NOTHING, 0.0
    for robot, windows in tracks.items():
        sensor = config_of(robot, scenario).sensor
        for t in windows:
            innovation = innovation.plus(t.closed.innovation)
            least += least_nis(t.closed.innovation, sensor)
    return JoinedTeam(landmarks, paths, fold, contributions, innovation, least)


def least_nis(innovation: Innovation, sensor: Sensor) -> float:
    """Least expected NIS: ranges and bearings by their white shares."""
    return 0.5 * (sensor.range_white + sensor.bearing_white) * innovation.dof


def fold_of(
    contributions: Sequence[Contribution],
    starts: Iterable[InitialPoseFactor],
    central: CentralConfig,
) -> Fold:
    """Solved fold, with unnamed landmarks associated."""
    fold: Fold = EMPTY_FOLD
    for start in starts:
        fold = add_start(fold, start)
    tick_ns = round(central.tick_s * 1e9)
    ticks: dict[int, list[Contribution]] = {}
    for contribution in sorted(contributions, key=lambda c: c.key):
        ticks.setdefault(-(-contribution.end_ns // tick_ns), []).append(contribution)
    settings = join_settings(central)
    unnamed = any(len(each.local.unnamed.counts) for each in contributions)
    for tick in sorted(ticks):
        if unnamed:
            fold = fold_tick(fold, Tick(ticks[tick]), settings)
        else:
            fold = fold_submaps(fold, ticks[tick], settings)
    return solve_fold(fold, settings)


def config_of(robot: str, scenario: Scenario) -> RobotConfig:
    """Configuration without clock offset; the first robot's for an unknown one."""
    configs = {each.id: each for each in scenario.robots}
    own = configs.get(robot, scenario.robots[0])
    return msgspec.structs.replace(own, id=robot, clock_offset_s=0.0)


def _tracks(config: RobotConfig, stream: RobotStream) -> list[_Track]:
    slam = HybridSlam(config, 1)
    tracks: list[_Track] = []
    stamps: list[int] = []
    window = slam.window
    for message in messages_of(stream):
        if isinstance(message, m.AnyScan | m.Detections):
            slam.observe(message.stamp_ns, translate.scan_of(message))
        if not isinstance(message, m.AnyOdometry):
            continue
        closed = slam.drive(translate.interval_of(message, config))
        if closed is not None:
            tracks.append(_track(closed, stamps, window))
            stamps = []
        window = slam.window
        if slam.last_keyframe_ns is not None:
            stamps += [slam.last_keyframe_ns] * (len(window.paths) - len(stamps))
    last, _ = slam.finish()
    return tracks if last is None else [*tracks, _track(last, stamps, window)]


def _track(closed: ClosedWindow, stamps: Sequence[int], window: Window) -> _Track:
    weights = np.exp(window.particles.log_weights)
    x, y, heading = (window.paths[: len(stamps), :, i] for i in range(3))
    turned = np.arctan2(np.sin(heading) @ weights, np.cos(heading) @ weights)
    path = np.stack([x @ weights, y @ weights, turned], axis=1)
    ends = np.vstack([path, closed.local.mean[:3]])
    return _Track(closed, np.append(np.array(stamps, dtype=np.int64), closed.end_ns), ends)


def _bend_to_ends(tracks: Sequence[_Track], ends: Float[np.ndarray, "K 3"]) -> Path:
    stamps = [np.array([tracks[0].closed.start_ns])]
    poses = [ends[:1]]
    for track, start, end in zip(tracks, ends[:-1], ends[1:], strict=True):
        carried = np.array([compose(start, pose) for pose in track.path])
        missing = end - carried[-1]
        missing[2] = float(on_circle(missing[2:])[0])
        begin_ns = track.closed.start_ns
        share = (track.stamps_ns - begin_ns) / max(track.closed.end_ns - begin_ns, 1)
        stamps.append(track.stamps_ns)
        poses.append(carried + share[:, np.newaxis] * missing)
    times, first = np.unique(np.concatenate(stamps), return_index=True)
    path = np.concatenate(poses)[first]
    path[:, 2] = on_circle(path[:, 2])
    return Path(times, path)
