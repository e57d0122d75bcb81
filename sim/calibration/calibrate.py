"""What measurements say about odometry and sensor: with the truth, or by the team's own map.

With truth of poses and landmarks every figure is learnt by maximum likelihood against it. The range
scale is then taken times the scale of the map that the team joins with these models: at the centre
a submap that came out short weighs more (its error is proportional to its ranges), so an unbiased
sensor would give too small a map.

Without truth the reference is the joined map and the paths in it, with an odometry that is trusted
less, so that scale comes from the ranges (expectation and maximisation in turn). Only what the
ranges and bearings determine is learnt then: the odometry's scales, drag and veer. The sensor's own
figures stay: a team can not see the scale of its own measure.

How sure the submaps are (`covariance_factor`) is learnt without the truth in both cases, from the
maps of single robots (`consistency`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from central.desk.evaluation.errors import TRUTH_GAP_NS, Path
from sim.calibration import motion as motion
from sim.calibration import sensor as sensor
from sim.calibration.consistency import covariance_factor
from sim.calibration.data import Reference, references, true_paths
from sim.calibration.figures import CalibrationError, Figure, jackknifed
from sim.calibration.join import JoinedTeam, config_of, joined_team
from sim.scenarios.scenario import Scenario
from sim.world.streams import WorldStreams
from team.config import MotionModel, MotionNoise, Sensor
from team.estimation.map_joining.joining import Fold

JOINED_GAP_NS = 2_000_000_000
SCALES = ("forward_scale", "turn_drag", "yaw_scale", "veer", "slow_scale")
MISTRUST = 4.0
"""Without truth the odometry's densities of noise are taken times this."""
ROUNDS = 2
SYSTEMATIC = 0.02
"""Standard deviation of the forward scale, relative, that is due to a scale from the joined map."""
ALARM = 0.015
"""A scale that differs by more from the scenario's does not fit the data."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Calibration:
    """The figures by their part of a robot's configuration, and what a user should know."""

    motion: tuple[Figure, ...]
    sensor: tuple[Figure, ...]
    by_truth: bool
    notes: tuple[str, ...]
    central: tuple[Figure, ...] = ()


def calibrated(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> Calibration:
    """Learn from all worlds together, beginning with the scenario's models (one for all robots).

    Raises CalibrationError where the measurements do not suffice.
    """
    if all(world.landmarks is not None and true_paths(world.streams) for _, world in worlds):
        return _by_truth(worlds, scenario, progress)
    return _by_the_map(worlds, scenario, progress)


def _by_truth(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> Calibration:
    data, notes = [], []
    for label, world in worlds:
        paths = true_paths(world.streams)
        turning = _turning_first(world, scenario)
        data += references(world, paths, _positions(world), TRUTH_GAP_NS, label, turning)
        notes += _left_out(label, world, paths, "no ground truth")
    for note in notes:
        progress(note)
    progress(f"odometry and sensor against the truth of {len(data)} robots")
    of_motion = _motion_figures(data, scenario)
    of_sensor = jackknifed(sensor.fit_sensor, data, sensor.UNITS)
    for turn in range(ROUNDS):
        learnt = with_figures(scenario, of_motion, of_sensor)
        scales, folds = [], []
        for label, world in worlds:
            progress(f"scale of the joined map of {label}, {turn + 1} of {ROUNDS}")
            team = joined_team(world, learnt, lambda robot: progress(f"  {robot} is done"))
            scales.append(_scale(team, world))
            folds.append(team.fold)
        factor, spread = float(np.mean(scales)), float(np.std(scales) / np.sqrt(len(scales)))
        of_sensor = tuple(
            replace(f, value=f.value * factor, sigma=float(np.hypot(f.sigma, spread)))
            if f.name == "range_scale"
            else f
            for f in of_sensor
        )
    of_central = _central_figures(folds, scenario, progress)
    said = (*notes, *_alarms(of_motion, scenario))
    return Calibration(of_motion, of_sensor, True, said, of_central)


def _by_the_map(
    worlds: Sequence[tuple[str, WorldStreams]], scenario: Scenario, progress: Progress
) -> Calibration:
    learnt = scenario
    figures: tuple[Figure, ...] = ()
    for turn in range(ROUNDS):
        data, notes = [], []
        for label, world in worlds:
            progress(f"joined map of {label}, {turn + 1} of {ROUNDS}")
            mistrusting = _mistrusting(learnt)
            team = joined_team(world, mistrusting, lambda robot: progress(f"  {robot} is done"))
            turning = _turning_first(world, scenario)
            data += references(world, team.paths, team.landmarks, JOINED_GAP_NS, label, turning)
            notes += _left_out(label, world, team.paths, "not in the team's joined map")
        found = (f for f in _motion_figures(data, learnt) if f.name in SCALES)
        figures = tuple(_with_systematic(f) for f in found)
        learnt = with_figures(scenario, figures, ())
    folds = []
    for label, world in worlds:
        progress(f"joined map of {label} with what was learnt")
        folds.append(joined_team(world, learnt).fold)
    of_central = _central_figures(folds, scenario, progress)
    note = "no ground truth: the sensor's figures and the densities of noise stay as they are"
    said = (note, *notes, *_alarms(figures, scenario))
    return Calibration(figures, (), False, said, of_central)


def _central_figures(
    folds: Sequence[Fold], scenario: Scenario, progress: Progress
) -> tuple[Figure, ...]:
    progress("maps of single robots against the rest of their team")
    factor = covariance_factor(folds, scenario.central)
    return () if factor is None else (factor,)


def _turning_first(world: WorldStreams, scenario: Scenario) -> frozenset[str]:
    names = (stream.robot for stream in world.streams)
    return frozenset(n for n in names if config_of(n, scenario).motion.kind == "turn-then-drive")


def _left_out(
    label: str, world: WorldStreams, paths: Mapping[str, Path], pathless: str
) -> list[str]:
    """The robots of which nothing can be learnt, each with its reason."""
    return [
        f"{label} {stream.robot}: {reason}: nothing is learnt from it"
        for stream in world.streams
        for reason in (pathless if len(stream.intervals.end_ns) else "no odometry",)
        if stream.robot not in paths or not len(stream.intervals.end_ns)
    ]


def _with_systematic(figure: Figure) -> Figure:
    if figure.name != "forward_scale":
        return figure
    return replace(figure, sigma=float(np.hypot(figure.sigma, SYSTEMATIC * figure.value)))


def _motion_figures(data: Sequence[Reference], scenario: Scenario) -> tuple[Figure, ...]:
    given = scenario.robots[0].motion
    if not data:
        raise CalibrationError("no robot has both odometry and a known path")

    slow_below = given.slow_below if motion.creep(data, given.slow_below) else 0.0

    def fit(part: Sequence[Reference]) -> Mapping[str, float]:
        return motion.fit_motion(part, given.yaw_rate_limit, slow_below)

    return jackknifed(fit, data, motion.UNITS)


def _positions(world: WorldStreams) -> dict[int, np.ndarray]:
    assert world.landmarks is not None
    return dict(zip(world.landmark_ids.tolist(), world.landmarks, strict=True))


def _scale(team: JoinedTeam, world: WorldStreams) -> float:
    """Size of the map over size of the true one: Σ aᵀ R b/Σ bᵀ b at the best rotation (Umeyama)."""
    truth = _positions(world)
    common = sorted(set(truth) & set(team.landmarks))
    if len(common) < 2:
        raise CalibrationError("the joined map has fewer than two landmarks of the true one")
    a, b = (np.array([of[i] for i in common]) for of in (team.landmarks, truth))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    along = float(np.sum(a * b))
    across = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    return float(np.hypot(along, across) / np.sum(b * b))


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


def _mistrusting(scenario: Scenario) -> Scenario:
    """The scenario whose odometry says MISTRUST times its noise."""

    def wider(noise: MotionNoise) -> MotionNoise:
        fields = msgspec.structs.asdict(noise)
        return MotionNoise(**{name: MISTRUST * value for name, value in fields.items()})

    def of(model: MotionModel) -> MotionModel:
        return msgspec.structs.replace(model, forward=wider(model.forward), turn=wider(model.turn))

    robots = tuple(msgspec.structs.replace(r, motion=of(r.motion)) for r in scenario.robots)
    return msgspec.structs.replace(scenario, robots=robots)


def with_figures(
    scenario: Scenario, of_motion: Sequence[Figure], of_sensor: Sequence[Figure]
) -> Scenario:
    """The scenario with the learnt figures in every robot's models."""
    robots = tuple(
        msgspec.structs.replace(
            robot,
            motion=msgspec.convert(
                nested(msgspec.to_builtins(robot.motion), of_motion, MotionModel), MotionModel
            ),
            sensor=msgspec.convert(
                nested(msgspec.to_builtins(robot.sensor), of_sensor, Sensor), Sensor
            ),
        )
        for robot in scenario.robots
    )
    return msgspec.structs.replace(scenario, robots=robots)


def nested(
    below: Mapping[str, object], figures: Sequence[Figure], declared: type[msgspec.Struct]
) -> dict[str, object]:
    """Fields of a model with figures laid over them: `forward.per_m` is a field of `forward`.

    A density that was learnt replaces all three of its noise. What is no field of the model (a
    share of outliers) is left out.
    """
    names = {field.name for field in msgspec.structs.fields(declared)}
    fields = dict(below)
    noises: dict[str, dict[str, float]] = {}
    for figure in figures:
        name, _, part = figure.name.partition(".")
        if part:
            noises.setdefault(name, {})[part] = figure.value
        elif name in names:
            fields[name] = figure.value
    return fields | noises
