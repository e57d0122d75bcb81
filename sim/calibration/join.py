"""The team's map and paths from its own measurements: the reference where there is no truth."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import Float, Int64

from central.config import CentralConfig
from central.desk.evaluation.errors import Path, on_circle
from central.tick_fold import join_settings
from sim.calibration.data import interval_of, scan_of
from sim.calibration.figures import CalibrationError
from sim.scenarios.scenario import Scenario
from sim.world.streams import (
    OBSERVATIONS,
    ODOMETRY,
    ObservationMeasurement,
    OdometryMeasurement,
    RobotStream,
    WorldStreams,
)
from team.config import RobotConfig
from team.estimation.geometry import compose
from team.estimation.hybrid_slam.closed_window import ClosedWindow
from team.estimation.hybrid_slam.pipeline import HybridSlam
from team.estimation.hybrid_slam.window import Window
from team.estimation.map_joining.auditing import fold_tick
from team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    Contribution,
    Fold,
    InitialPoseFactor,
    Tick,
    converged,
    folded,
    started,
)

LONGEST_NS = 250_000_000
"""Intervals of an arc are merged up to this length: a window closes at the end of an interval."""


@dataclass(frozen=True)
class _Track:
    """One closed window: its submap, and the mean path of its particles in the submap's frame."""

    closed: ClosedWindow
    stamps_ns: Int64[np.ndarray, " K"]
    path: Float[np.ndarray, "K 3"]


@dataclass(frozen=True)
class JoinedTeam:
    """The landmarks by id and each robot's path in the frame of the joined map, and the fold."""

    landmarks: Mapping[int, Float[np.ndarray, "2"]]
    paths: Mapping[str, Path]
    fold: Fold
    contributions: Sequence[Contribution] = ()


def joined_team(
    world: WorldStreams, scenario: Scenario, progress: Callable[[str], None] = lambda _: None
) -> JoinedTeam:
    """The joined map of every robot's windows under the scenario's models; robots of the main
    island only.

    Between two window ends a path is the particles' mean, moved so that it ends at the joined pose.
    progress: called with the name of each robot whose windows are done. Raises CalibrationError
    where there is no submap.
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
        paths[robot] = _bent(tracks[robot], ends)
    return JoinedTeam(landmarks, paths, fold, contributions)


def fold_of(
    contributions: Sequence[Contribution],
    starts: Iterable[InitialPoseFactor],
    central: CentralConfig,
) -> Fold:
    """The solved fold of these submaps; landmarks without identities are associated."""
    fold: Fold = EMPTY_FOLD
    for start in starts:
        fold = started(fold, start)
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
            fold = folded(fold, ticks[tick], settings)
    return converged(fold, settings)


def config_of(robot: str, scenario: Scenario) -> RobotConfig:
    """The robot's configuration; a robot that the scenario does not have gets the first robot's
    models.
    """
    configs = {each.id: each for each in scenario.robots}
    return configs.get(robot) or msgspec.structs.replace(scenario.robots[0], id=robot)


def _tracks(config: RobotConfig, stream: RobotStream) -> list[_Track]:
    slam = HybridSlam(config, 1)
    tracks: list[_Track] = []
    stamps: list[int] = []
    window = slam.window
    for measurement in _merged(
        stream, LONGEST_NS if config.motion.kind != "turn-then-drive" else 0
    ):
        if isinstance(measurement, ObservationMeasurement):
            slam.observe(measurement.stamp_ns, scan_of(measurement))
            continue
        closed = slam.drive(interval_of(measurement, config.motion))
        if closed is not None:
            tracks.append(_track(closed, stamps, window))
            stamps = []
        window = slam.window
        if slam.last_keyframe_ns is not None:
            stamps += [slam.last_keyframe_ns] * (len(window.paths) - len(stamps))
    last, _ = slam.finish()
    return tracks if last is None else [*tracks, _track(last, stamps, window)]


def _merged(
    stream: RobotStream, longest_ns: int
) -> Iterator[ObservationMeasurement | OdometryMeasurement]:
    """The stream's scans and odometry, with intervals of one command between two scans merged.

    No interval becomes longer than longest_ns. A command that is logged ten times is one arc, and
    motion noise is a density: the estimate stays the same, up to the correlation of the noises
    within an interval and to where a window closes.
    """
    pending: OdometryMeasurement | None = None
    for counter in range(1, len(stream)):
        kind = stream.kinds[counter]
        if kind == ODOMETRY:
            interval = stream.odometry(counter)
            if pending is not None and _goes_on(pending, interval, longest_ns):
                interval = interval._replace(duration_ns=pending.duration_ns + interval.duration_ns)
            elif pending is not None:
                yield pending
            pending = interval
        elif kind == OBSERVATIONS:
            if pending is not None:
                yield pending
            pending = None
            yield stream.observations(counter)
    if pending is not None:
        yield pending


def _goes_on(one: OdometryMeasurement, then: OdometryMeasurement, longest_ns: int) -> bool:
    """Whether the second interval follows without a gap and by the same command, and both are
    short.
    """
    return (
        then.stamp_ns - then.duration_ns == one.stamp_ns
        and one.increment is None
        and (then.forward, then.yaw_rate) == (one.forward, one.yaw_rate)
        and one.duration_ns + then.duration_ns <= longest_ns
    )


def _track(closed: ClosedWindow, stamps: Sequence[int], window: Window) -> _Track:
    weights = np.exp(window.particles.log_weights)
    x, y, heading = (window.paths[: len(stamps), :, i] for i in range(3))
    turned = np.arctan2(np.sin(heading) @ weights, np.cos(heading) @ weights)
    path = np.stack([x @ weights, y @ weights, turned], axis=1)
    ends = np.vstack([path, closed.local.mean[:3]])
    return _Track(closed, np.append(np.array(stamps, dtype=np.int64), closed.end_ns), ends)


def _bent(tracks: Sequence[_Track], ends: Float[np.ndarray, "K 3"]) -> Path:
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
