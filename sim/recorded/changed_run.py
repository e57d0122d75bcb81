"""Run the recorded team's nodes in memory, on the same measurements with changes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec

from teamslam.central.saved_maps import describe_repetition
from teamslam.sim.in_memory.team import Conditions, Partition, run_nodes
from teamslam.sim.recorded.world import RecordedWorld, Samples
from teamslam.sim.scenarios.document import ScenarioError
from teamslam.sim.scenarios.scenario import Scenario, with_options
from teamslam.team.config import MAP, Alphas, MotionModel, MotionNoise, RobotConfig, Sensor
from teamslam.team.pairs import FEEDBACK
from teamslam.team.saved_map import read_map
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, open_valid
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import digest_of

Span = tuple[float, float]  # begin and end in seconds since the log's first measurement


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Changes of a run.

    without: robots left out. seed: of estimators and losses. loss, delay_s: of submaps to the
    centre. partitions: robots that the centre cannot reach, and when. noise: factors on standard
    deviations, by kind. localise: robots are localised in the map.
    """

    without: tuple[str, ...] = ()
    fusion: str | None = None
    estimator: str | None = None
    particles: int | None = None
    window_s: float | None = None
    seed: int | None = None
    loss: float = 0.0
    delay_s: float = 0.0
    no_centre: Span | None = None
    partitions: tuple[tuple[tuple[str, ...], Span], ...] = ()
    noise: tuple[tuple[str, float], ...] = ()
    maps: tuple[str, ...] = ()
    localise: bool = False


def changed_run(log: Samples, changes: Changes) -> list[Sample]:
    """Samples of the changed run, as of a recorder; raises ScenarioError, SavedMapError,
    RerunError.
    """
    world = RecordedWorld(log, changes.without)
    scenario = _changed_scenario(world.scenario, changes)
    world.announce(scenario)
    world.load_maps(read_map(Path(path)) for path in changes.maps)
    conditions = _conditions(scenario, changes, world.first_ns)
    return list(run_nodes(scenario, world, conditions))


def check_days(log: Samples, changes: Changes) -> None:
    """Refuse maps that contain the log's measurements already; raises ScenarioError."""
    if changes.localise:
        return
    maps = [read_map(Path(path)) for path in changes.maps]
    found = set[str]()
    for _, _, submap in open_valid(log.samples([ch.SUBMAP]) if maps else ()):
        if not isinstance(submap, m.Submap) or submap.sequence or submap.robot in changes.without:
            continue
        first = digest_of(encoded(submap))
        found |= {describe_repetition(submap.robot, each) for each in maps if first in each.sets}
    if found:
        raise ScenarioError("; ".join(sorted(found)))


def _changed_scenario(scenario: Scenario, changes: Changes) -> Scenario:
    names = [robot.id for robot in scenario.robots]
    asked = {*changes.without, *(r for robots, _ in changes.partitions for r in robots)}
    for name in sorted(each for each in asked - set(names) if not each.startswith(MAP)):
        raise ScenarioError(f"no robot {name} in the log; there are {', '.join(names)}")
    robots = tuple(robot for robot in scenario.robots if robot.id not in changes.without)
    if not robots:
        raise ScenarioError("a team without robots has nothing to compute")
    front = {"particles": changes.particles, "window_s": changes.window_s}
    front = {name: value for name, value in front.items() if value is not None}
    robots = tuple(_changed_robot(robot, front, dict(changes.noise)) for robot in robots)
    changed = with_options(
        msgspec.structs.replace(scenario, robots=robots),
        seed=changes.seed,
        estimator=changes.estimator,
        fusion=changes.fusion,
        localise=changes.localise,
    )
    links = changes.loss or changes.delay_s or changes.no_centre or changes.partitions
    if changed.fusion != "join" and links:
        why = "runs in lockstep" if changed.fusion in FEEDBACK else "is for comparison"
        raise ScenarioError(
            f"the rule {changed.fusion} {why}: loss, delay, partition and a "
            "missing centre are for the rule join"
        )
    return changed


def _conditions(scenario: Scenario, changes: Changes, first_ns: int) -> Conditions:
    def at(span: Span) -> tuple[int, int]:
        return first_ns + round(span[0] * 1e9), first_ns + round(span[1] * 1e9)

    return Conditions(
        round(changes.delay_s * 1e9),
        changes.loss,
        scenario.seed,
        tuple(Partition(frozenset(robots), *at(span)) for robots, span in changes.partitions),
        None if changes.no_centre is None else at(changes.no_centre),
    )


KINDS = ("odometry", "range", "bearing")
"""Noise that is scaled: of motion, or a standard deviation."""


def _changed_robot(
    robot: RobotConfig, front: Mapping[str, Any], factors: Mapping[str, float]
) -> RobotConfig:
    front_end = msgspec.structs.replace(robot.front_end, **front)
    motion = _motion(robot.motion, factors.get("odometry", 1.0))
    by_range = factors.get("range", 1.0)
    sensor: Sensor = msgspec.structs.replace(
        robot.sensor,
        range_sigma=robot.sensor.range_sigma * by_range,
        range_sigma_per_m=robot.sensor.range_sigma_per_m * by_range,
        bearing_sigma=robot.sensor.bearing_sigma * factors.get("bearing", 1.0),
    )
    return msgspec.structs.replace(robot, front_end=front_end, motion=motion, sensor=sensor)


def _motion(motion: MotionModel, factor: float) -> MotionModel:
    """Scale noise: the α are variances, all else a standard deviation."""

    def scaled(noise: MotionNoise) -> MotionNoise:
        return MotionNoise(noise.per_s * factor, noise.per_m * factor, noise.per_rad * factor)

    alphas = motion.alphas
    if alphas is not None:
        alphas = cast("Alphas", tuple(alpha * factor * factor for alpha in alphas))
    return msgspec.structs.replace(
        motion,
        forward=scaled(motion.forward),
        turn=scaled(motion.turn),
        final_turn=scaled(motion.final_turn),
        lateral=scaled(motion.lateral),
        alphas=alphas,
        left_wheel=motion.left_wheel * factor,
        right_wheel=motion.right_wheel * factor,
    )
