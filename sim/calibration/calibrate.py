"""Calibrate odometry and sensor models from measurements.

With truth every figure is a maximum-likelihood estimate. Without truth the joined map is the
reference, in alternation; a team cannot observe the scale of its own ranges, so only odometry
scales, drag, veer and clocks are calibrated, and the join trusts odometry less.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from math import hypot

import msgspec
import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.central.desk.evaluation.errors import TRUTH_GAP_NS, Path
from teamslam.sim.calibration import claims, clocks, motion, sensor
from teamslam.sim.calibration.consistency import (
    central_figures,
    factor_by_cost,
    without_excess,
)
from teamslam.sim.calibration.data import (
    LEAST_SPANS,
    Reference,
    moving_stretches,
    references,
    too_short,
    true_paths,
)
from teamslam.sim.calibration.detections import claim_notes, detection_figures, windows_of
from teamslam.sim.calibration.figures import CalibrationError, Figure, jackknife, with_figures
from teamslam.sim.calibration.join import JoinedTeam, config_of, fold_of, join_team
from teamslam.sim.calibration.own import marker_spread, own_constants
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.config import MotionModel, MotionNoise
from teamslam.team.estimation.hybrid_slam.window import NOTHING, Innovation

JOINED_GAP_NS = 2_000_000_000
SCALES = ("forward_scale", "turn_drag", "yaw_scale", "veer", "slow_scale")
MISTRUST = 4.0  # factor on odometry noise densities without truth
ROUNDS = 2
SYSTEMATIC = 0.02  # relative standard deviation of a forward scale from the joined map
CLOCK_ROUNDS = 3  # repetitions of the estimate of clocks, linear in an offset
TYPICAL_M = 3.0
BETTER = 0.8  # a range model is reported if it reduces σ at TYPICAL_M below this share
ALARM = 0.015  # relative scale difference that does not fit the scenario


Progress = Callable[[str], None]


@dataclass(frozen=True)
class Calibration:
    """Calibrated figures by part of a configuration.

    clocks: `clock_offset_s` of every robot if one's clocks differ.
    """

    motion: tuple[Figure, ...]
    sensor: tuple[Figure, ...]
    by_truth: bool
    notes: tuple[str, ...]
    central: tuple[Figure, ...] = ()
    robots: Mapping[str, tuple[Figure, ...]] = field(default_factory=dict)
    detections: tuple[Figure, ...] = ()
    clocks: Mapping[str, Figure] = field(default_factory=dict)
    team: tuple[str, ...] = ()


def calibrate_models(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> Calibration:
    """Calibrate from all worlds (label, streams), from the scenario's models; raises
    CalibrationError.
    """
    stretches = moving_stretches(stream for _, world in worlds for stream in world.streams)
    if stretches < LEAST_SPANS:
        raise CalibrationError(too_short(stretches))
    if all(world.landmarks is not None and true_paths(world.streams) for _, world in worlds):
        found = _calibrate_by_truth(worlds, scenario, progress)
    else:
        found = _calibrate_by_map(worlds, scenario, progress)
    robots = dict.fromkeys(stream.robot for _, world in worlds for stream in world.streams)
    found = replace(found, team=tuple(robots))
    windows = [
        each
        for _, world in worlds
        for stream in world.streams
        for each in windows_of(stream, config_of(stream.robot, scenario))
    ]
    if not windows:
        return found
    progress("clutter and missed detections of the windows")
    figures = detection_figures(windows)
    notes = claim_notes(figures, found.central, scenario.robots[0].front_end.association)
    return replace(found, detections=figures, notes=(*found.notes, *notes))


def _calibrate_by_truth(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> Calibration:
    data, notes = against_truth(worlds, scenario)
    found = clocks.clocks_of(data, scenario.robots[0].sensor)
    if any(clock.is_off for clock in found.values()):
        worlds = [(label, clocks.on_one_clock(world, found)) for label, world in worlds]
        data, notes = against_truth(worlds, scenario)
    notes += clocks.clock_notes(found)
    for note in notes:
        progress(note)
    progress(f"odometry and sensor against the truth of {len(data)} robots")
    of_motion = _motion_figures(data, scenario)
    depth = scenario.robots[0].sensor.range_is_depth

    def fit(part: Sequence[Reference]) -> Mapping[str, float]:
        return sensor.fit_sensor(part, depth=depth)

    of_sensor = jackknife(fit, data, sensor.UNITS)
    of_sensor += jackknife(
        lambda part: claims.landmark_factor(part, scenario.robots[0].sensor), data, claims.UNITS
    )
    placed = claims.mount_note(data, scenario.robots[0].sensor)
    own = own_constants(data, depth=depth)
    learnt = with_figures(scenario, of_motion, of_sensor, own.robots)
    folds = [team.fold for team in _join_calibrated(worlds, learnt, progress)]
    marker = marker_spread(data, depth=depth)
    strays = own.strays if marker is None else (*own.strays, marker)
    true = [_positions(world) for _, world in worlds]
    of_central = central_figures(folds, scenario, strays, progress, true)
    findings = (*notes, *placed, *_alarms(of_motion, scenario), *_other_model(data, depth))
    of_clocks = _clock_figures(found, scenario)
    return Calibration(
        of_motion, of_sensor, True, findings, of_central, own.robots, clocks=of_clocks
    )


def _clock_figures(found: Mapping[str, clocks.Clock], scenario: Scenario) -> Mapping[str, Figure]:
    if not any(each.is_off for each in found.values()):
        return {}
    known = {robot.id: robot.clock_offset_s for robot in scenario.robots}
    return {
        robot: replace(
            clock.clock_offset_s,
            value=known.get(robot, 0.0) + (clock.clock_offset_s.value if clock.is_off else 0.0),
        )
        for robot, clock in found.items()
    }


def _align_clocks_by_map(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> tuple[Sequence[tuple[str, WorldStreams]], Mapping[str, clocks.Clock]]:
    """Move each robot's detections to its odometry's clock."""
    robots = sorted({stream.robot for _, world in worlds for stream in world.streams})
    moved, total = dict.fromkeys(robots, 0.0), {}
    for turn in range(CLOCK_ROUNDS):
        progress(f"clocks by the joined map, {turn + 1} of at most {CLOCK_ROUNDS}")
        folds = [join_team(world, scenario).fold for _, world in worlds]
        found = {
            robot: clock
            for robot in robots
            if (clock := clocks.clock_of_map(robot, folds)) is not None
        }
        total = {robot: clock.later(moved[robot]) for robot, clock in found.items()}
        off = {robot: clock.detections.value for robot, clock in found.items() if clock.is_off}
        if not off:
            break
        moved |= {robot: moved[robot] + seconds for robot, seconds in off.items()}
        worlds = [(label, clocks.on_one_clock(world, found)) for label, world in worlds]
    return worlds, total


def against_truth(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario
) -> tuple[list[Reference], list[str]]:
    """References by the truth, and notes on robots without one."""
    data: list[Reference] = []
    notes: list[str] = []
    for label, world in worlds:
        paths = true_paths(world.streams)
        turning = _find_turning_first(world, scenario)
        given = world, paths, _positions(world), TRUTH_GAP_NS, label, turning
        data += references(*given, scenario.robots[0])
        notes += _note_left_out(label, world, paths, "no ground truth")
    return data, notes


def _other_model(data: Sequence[Reference], depth: bool) -> tuple[str, ...]:
    taken, other = (
        hypot(found["range_sigma"], TYPICAL_M * found["range_sigma_per_m"])
        for found in (sensor.fit_sensor(data, depth=each) for each in (depth, not depth))
    )
    if other > BETTER * taken:
        return ()
    return (
        f"ranges fit {'the distance' if depth else 'the depth along an optical axis'} better: σ "
        f"{other:.3f} m instead of {taken:.3f} m at {TYPICAL_M:g} m; "
        f"set range_is_depth = {str(not depth).lower()} in [defaults.sensor] and calibrate again",
    )


def _calibrate_by_map(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> Calibration:
    learnt = scenario
    figures: tuple[Figure, ...] = ()
    worlds, of_clocks = _align_clocks_by_map(worlds, scenario, progress)
    for turn in range(ROUNDS):
        data, notes = [], []
        for label, world in worlds:
            progress(f"joined map of {label}, {turn + 1} of {ROUNDS}")
            mistrusting = _widen_motion(learnt)
            team = join_team(world, mistrusting, lambda robot: progress(f"  {robot} is done"))
            turning = _find_turning_first(world, scenario)
            given = world, team.paths, team.landmarks, JOINED_GAP_NS, label, turning
            data += references(*given, scenario.robots[0])
            notes += _note_left_out(label, world, team.paths, "not in the team's joined map")
        found = (f for f in _motion_figures(data, learnt) if f.name in SCALES)
        figures = tuple(_add_systematic(f) for f in found)
        learnt = with_figures(scenario, figures)
    teams = _join_calibrated(worlds, learnt, progress)
    of_central = central_figures([team.fold for team in teams], scenario, (), progress)
    if not of_central and len(teams) == 1:
        of_central = _fit_factor_by_cost(teams[0], scenario.central, progress)
    innovation = reduce(Innovation.plus, (team.innovation for team in teams), NOTHING)
    least = sum(team.least for team in teams)
    sensor_model = scenario.robots[0].sensor
    of_central, excess = without_excess(of_central, innovation, least, sensor_model)
    note = (
        "no true paths and landmarks: the sensor's figures and the densities of noise stay as they "
        "are"
    )
    if any(each.seen.covariances is not None for each in data):
        note += "; so do the factors of covariances that come with measurements, and the mount"
    findings = (note, *excess, *notes, *clocks.clock_notes(of_clocks), *_alarms(figures, scenario))
    return Calibration(
        figures, (), False, findings, of_central, clocks=_clock_figures(of_clocks, scenario)
    )


def _join_calibrated(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> list[JoinedTeam]:
    teams = []
    for label, world in worlds:
        progress(f"joined map of {label} with the calibrated models")
        teams.append(join_team(world, scenario, lambda robot: progress(f"  {robot} is done")))
    return teams


def _fit_factor_by_cost(
    team: JoinedTeam, central: CentralConfig, progress: Progress
) -> tuple[Figure, ...]:
    if not any(len(each.local.unnamed.counts) for each in team.contributions):
        return ()
    progress("the map under other covariance factors")
    starts = team.fold.starts.values()
    figure = factor_by_cost(lambda config: fold_of(team.contributions, starts, config), central)
    return () if figure is None else (figure,)


def _find_turning_first(world: WorldStreams, scenario: Scenario) -> frozenset[str]:
    names = (stream.robot for stream in world.streams)
    return frozenset(n for n in names if config_of(n, scenario).motion.kind == "turn-then-drive")


def _note_left_out(
    label: str, world: WorldStreams, paths: Mapping[str, Path], pathless: str
) -> list[str]:
    return [
        f"{label} {stream.robot}: {reason}: nothing is learnt from it"
        for stream in world.streams
        for reason in (pathless if len(stream.intervals.end_ns) else "no odometry",)
        if stream.robot not in paths or not len(stream.intervals.end_ns)
    ]


def _add_systematic(figure: Figure) -> Figure:
    if figure.name != "forward_scale":
        return figure
    return replace(figure, sigma=float(np.hypot(figure.sigma, SYSTEMATIC * figure.value)))


def _motion_figures(data: Sequence[Reference], scenario: Scenario) -> tuple[Figure, ...]:
    given = scenario.robots[0].motion
    if not data:
        raise CalibrationError("no robot has both odometry and a known path")
    if all(each.intervals.claimed.all() for each in data):
        return jackknife(claims.odometry_factor, data, claims.UNITS)

    slow_below = given.slow_below if motion.creep(data, given.slow_below) else 0.0

    def fit(part: Sequence[Reference]) -> Mapping[str, float]:
        return motion.fit_motion(part, given.yaw_rate_limit, slow_below)

    return jackknife(fit, data, motion.UNITS)


def _positions(world: WorldStreams) -> dict[int, np.ndarray]:
    assert world.landmarks is not None
    return dict(zip(world.landmark_ids.tolist(), world.landmarks, strict=True))


def _alarms(figures: Sequence[Figure], scenario: Scenario) -> tuple[str, ...]:
    before = scenario.robots[0].motion
    notes = []
    for figure in figures:
        if figure.name in ("forward_scale", "yaw_scale"):
            old = float(getattr(before, figure.name))
            change = figure.value / old - 1.0
            if abs(change) > max(ALARM, 3.0 * figure.sigma):
                notes.append(
                    f"{figure.name} is {100.0 * change:+.1f} % from the scenario's {old:g}: "
                    "its odometry is not calibrated for these data"
                )
    return tuple(notes)


def _widen_motion(scenario: Scenario) -> Scenario:
    def wider(noise: MotionNoise) -> MotionNoise:
        fields = msgspec.structs.asdict(noise)
        return MotionNoise(**{name: MISTRUST * value for name, value in fields.items()})

    def of(model: MotionModel) -> MotionModel:
        return msgspec.structs.replace(model, forward=wider(model.forward), turn=wider(model.turn))

    robots = tuple(msgspec.structs.replace(r, motion=of(r.motion)) for r in scenario.robots)
    return msgspec.structs.replace(scenario, robots=robots)
