"""Estimate stamp delays of a robot's detections and odometry against its path.

A detection stamped t was made at t − τ. In straight motion τ looks like a mount moved forward by v
τ, so mount pose and range offset are estimated jointly. Odometry is compared with the path's turn,
with free scale. `RobotConfig.clock_offset_s` is τ of the detections less that of the odometry.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from teamslam.central.desk.evaluation.errors import Path, on_circle
from teamslam.sim.calibration.claims import measured_and_true
from teamslam.sim.calibration.data import Reference, by_robot, poses_at
from teamslam.sim.calibration.figures import Figure, huber, jackknife
from teamslam.sim.world.streams import RobotStream, WorldStreams
from teamslam.team.config import Sensor
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.marginals import bias_estimates
from teamslam.team.shapes import Float, Int64

LEAST = 200  # least number of detections, and of odometry turns
ROUNDS = 6
STEP_NS = 10_000_000
LARGEST_S = 2.0  # largest plausible clock offset
BEYOND_DOUBT = 4.0  # standard deviations from which an offset is applied
LEAST_S = 0.01  # smallest applied offset [s]
SETTLED_S = 1e-4

UNITS = {"detections": "s", "odometry": "s", "clock_offset_s": "s"}


@dataclass(frozen=True)
class Clock:
    """Delays of detections and odometry, and their difference."""

    detections: Figure
    odometry: Figure
    clock_offset_s: Figure

    @property
    def is_off(self) -> bool:
        """Whether the two clocks differ significantly."""
        found = self.clock_offset_s
        return abs(found.value) > max(LEAST_S, BEYOND_DOUBT * found.sigma)

    def later(self, seconds: float) -> "Clock":
        """Add the time [s] by which detections were moved before."""
        delay, offset = (
            replace(each, value=each.value + seconds)
            for each in (self.detections, self.clock_offset_s)
        )
        return Clock(delay, self.odometry, offset)


def clocks_of(data: Sequence[Reference], sensor: Sensor) -> dict[str, Clock]:
    """Clocks of robots with enough measurements on a known path, but those that turn before
    driving.
    """

    def fit(part: Sequence[Reference]) -> Mapping[str, float]:
        seen, driven = _detections_late(part, sensor), _odometry_late(part)
        if seen is None or driven is None:
            return {}
        return {"detections": seen, "odometry": driven, "clock_offset_s": seen - driven}

    found = {}
    for robot, own in sorted(by_robot([each for each in data if not each.turns_first]).items()):
        figures = {each.name: each for each in jackknife(fit, own, UNITS)}
        if len(figures) == len(UNITS):
            found[robot] = Clock(**figures)
    return found


def clock_of_map(robot: str, folds: Sequence[Fold]) -> Clock | None:
    """Clock by the biases of joined maps; None where it is no state."""
    found = [
        (each.value, each.sigma)
        for fold in folds
        for each in bias_estimates(fold)
        if (each.stream[0], each.bias) == (robot, "clock_offset") and each.sigma > 0.0
    ]
    if not found:
        return None
    values, sigmas = np.array(found).T
    weights = sigmas**-2
    value, sigma = float(weights @ values / weights.sum()), float(weights.sum() ** -0.5)
    delay, offset = (Figure(name, value, sigma, "s") for name in ("detections", "clock_offset_s"))
    return Clock(delay, Figure("odometry", 0.0, 0.0, "s"), offset)


def clock_notes(clocks: Mapping[str, Clock]) -> tuple[str, ...]:
    """Text on each offset clock."""
    return tuple(
        f"{robot}: its detections are stamped {1e3 * clock.clock_offset_s.value:.0f} ± "
        f"{1e3 * clock.clock_offset_s.sigma:.0f} ms {late} its odometry: clock_offset_s = "
        f"{clock.clock_offset_s.value:.4f} moves the odometry to the detections' clock"
        for robot, clock in clocks.items()
        if clock.is_off
        for late in ("late against" if clock.clock_offset_s.value > 0.0 else "ahead of",)
    )


def on_one_clock(world: WorldStreams, clocks: Mapping[str, Clock]) -> WorldStreams:
    """Move streams of robots with an offset to the path's clock."""
    streams = tuple(
        _move_detections(each, clocks[each.robot])
        if each.robot in clocks and clocks[each.robot].is_off
        else each
        for each in world.streams
    )
    return replace(world, streams=streams)


def _move_detections(stream: RobotStream, clock: Clock) -> RobotStream:
    seen_ns, driven_ns = (round(each.value * 1e9) for each in (clock.detections, clock.odometry))
    intervals = replace(stream.intervals, end_ns=stream.intervals.end_ns - driven_ns)
    observations, sightings = (
        replace(each, stamps_ns=each.stamps_ns - seen_ns)
        for each in (stream.landmark_detections, stream.teammate_detections)
    )
    first_ns = int((intervals.end_ns - intervals.duration_ns)[0])
    return replace(
        stream,
        start_ns=min(stream.start_ns - seen_ns, first_ns),
        intervals=intervals,
        landmark_detections=observations,
        teammate_detections=sightings,
    )


def _at(data: Reference, late_ns: int) -> Reference:
    return replace(data, path=Path(data.path.stamps_ns + late_ns, data.path.poses))


def _settle_time(step_at: Callable[[int], float | None]) -> float | None:
    """Sum of steps [s], until one is below SETTLED_S; None beyond LARGEST_S."""
    late = 0.0
    for _ in range(ROUNDS):
        step = step_at(round(late * 1e9))
        if step is None or abs(late + step) > LARGEST_S:
            return None
        late += step
        if abs(step) < SETTLED_S:
            break
    return late


def _detections_late(data: Sequence[Reference], sensor: Sensor) -> float | None:
    """Delay [s]: iterated linear fit of (mount x, y, θ, range offset, τ) under Huber's loss."""

    def step_at(late_ns: int) -> float | None:
        here, before, after = (
            [measured_and_true(_at(each, late_ns + step), sensor) for each in data]
            for step in (0, -STEP_NS, STEP_NS)
        )
        common = [a[0] & b[0] & c[0] for a, b, c in zip(here, before, after, strict=True)]
        points, true, earlier, later = (
            np.concatenate([
                np.empty((0, 2)),
                *(one[at][taken] for one, taken in zip(side, common, strict=True)),
            ])
            for side, at in ((here, 1), (here, 2), (before, 2), (after, 2))
        )  # fmt: skip
        if len(points) < LEAST:
            return None
        return _step(points, true, (later - earlier) / (2e-9 * STEP_NS), sensor)

    return _settle_time(step_at)


def _step(
    points: Float[np.ndarray, "n 2"],
    true: Float[np.ndarray, "n 2"],
    rate: Float[np.ndarray, "n 2"],
    sensor: Sensor,
) -> float:
    """Further delay [s]; rate: ∂true/∂τ [m/s]."""
    ranges = np.maximum(np.hypot(*points.T), 1e-3)
    x, y = points.T
    zero, one = np.zeros(len(x)), np.ones(len(x))
    along = np.concatenate(points.T / ranges)
    J = np.column_stack([
        np.concatenate([one, zero]),
        np.concatenate([zero, one]),
        np.concatenate([-y, x]),
        along,
        -np.concatenate(rate.T),
    ])  # fmt: skip
    gap = np.concatenate((points - true).T)
    sigma = np.hypot(sensor.range_sigma, sensor.bearing_sigma * ranges)
    return float(huber(lambda p: gap + J @ p, np.concatenate([sigma, sigma]), np.zeros(5))[4])


def _odometry_late(data: Sequence[Reference]) -> float | None:
    def step_at(late_ns: int) -> float | None:
        parts = [_turns(each, late_ns) for each in data]
        driven, turned, rate = (
            np.concatenate([np.empty(0), *(part[k] for part in parts)]) for k in range(3)
        )
        if len(driven) < LEAST or float(np.std(driven)) == 0.0:
            return None
        gap, J = driven - turned, np.column_stack([driven, np.ones(len(driven)), -rate])
        sigma = 1.4826 * float(np.median(np.abs(gap))) + 1e-9
        return float(huber(lambda p: gap + J @ p, np.full(len(gap), sigma), np.zeros(3))[2])

    return _settle_time(step_at)


def _turns(
    data: Reference, late_ns: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Logged turn, turn of the path moved by late_ns, its derivative [rad, rad, rad/s]."""
    intervals = data.intervals

    def turned(by_ns: int) -> tuple[Float[np.ndarray, " n"], np.ndarray]:
        path = Path(data.path.stamps_ns + late_ns + by_ns, data.path.poses)
        ends: Int64[np.ndarray, " n"] = intervals.end_ns
        (one, known), (two, also) = (
            poses_at(path, stamps, data.gap_ns) for stamps in (ends - intervals.duration_ns, ends)
        )
        return on_circle(two[:, 2] - one[:, 2]), known & also

    here, known = turned(0)
    before, earlier = turned(-STEP_NS)
    after, later = turned(STEP_NS)
    taken = known & earlier & later
    driven = intervals.yaw_rate * intervals.duration_ns * 1e-9
    rate = (after - before) / (2e-9 * STEP_NS)
    return driven[taken], here[taken], rate[taken]
