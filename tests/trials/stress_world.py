"""Write data sets with a known fault, by a generator that imports nothing of the project.

    write(StressWorld(hidden=True, carried_off=(CarriedOff("r2", 15.0, 2.0, 150.0),)), folder)

Robots drive exact arcs in a square and measure landmarks by range and bearing. A fault changes the
measurements, never the truth. SI units, radians.
"""

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from math import pi
from pathlib import Path

import numpy as np

STEP_S = 0.1  # time between two odometry intervals [s]
SCAN_S = 0.5  # time between two scans [s]
SPEED = 1.0  # nominal speed [m/s]


@dataclass(frozen=True)
class CarriedOff:
    """A robot is displaced at a time, unmeasured by its odometry."""

    robot: str
    metres: float
    radians: float
    at_s: float


@dataclass(frozen=True)
class MovedLandmark:
    """A landmark is displaced by (dx, dy) from a time on."""

    landmark: int
    shift: tuple[float, float]
    from_s: float


@dataclass(frozen=True)
class Burst:
    """A robot's detections share wild errors of bearing and range for a while."""

    robot: str
    from_s: float
    to_s: float
    metres: float
    radians: float


@dataclass(frozen=True)
class StressWorld:
    """A world and its faults.

    late: delay [s] of a robot's detections after their stamps. odometry_scale: factor on the
    logged speeds, by robot. yaw_bias: added to the logged yaw rates [rad/s], by robot.
    bearing_offset, range_offset: added to all bearings [rad] and ranges [m], by robot. bursts:
    spans of wild detections. mirrored: robots whose bearings have the wrong sign. same_id: pairs
    (a, b): landmark b is measured with the identity of a. noise: factor on the noise of odometry
    and sensor. grid: columns and rows of landmarks, 5 m apart; 0: random. clutter: false
    detections per scan, without identities. tails: degrees of freedom of Student's t of the
    sensor's errors; 0: normal. correlated_s: correlation time of half the variance of the sensor's
    errors; 0: none. corridor: landmarks are in the outer fifths of the square alone. step_s: time
    between odometry intervals; scans come every half second, or with each longer interval.
    """

    seed: int = 1
    robots: int = 3
    landmarks: int = 25
    half_m: float = 20.0
    seconds: float = 300.0
    reach_m: float = 10.0
    hidden: bool = False
    starts: bool = True
    carried_off: tuple[CarriedOff, ...] = ()
    late: Mapping[str, float] = field(default_factory=dict)
    odometry_scale: Mapping[str, float] = field(default_factory=dict)
    yaw_bias: Mapping[str, float] = field(default_factory=dict)
    bearing_offset: Mapping[str, float] = field(default_factory=dict)
    range_offset: Mapping[str, float] = field(default_factory=dict)
    bursts: tuple[Burst, ...] = ()
    moved: tuple[MovedLandmark, ...] = ()
    mirrored: tuple[str, ...] = ()
    outlier_share: float = 0.0
    same_id: tuple[tuple[int, int], ...] = ()
    noise: float = 1.0
    grid: int = 0
    clutter: int = 0
    tails: float = 0.0
    correlated_s: float = 0.0
    corridor: bool = False
    step_s: float = STEP_S

    @property
    def scan_every(self) -> int:
        """Odometry intervals from one scan to the next."""
        return max(1, round(SCAN_S / self.step_s))


SCENARIO = """\
seed = {seed}

[world]
kind = "folder"
{unknown}
[defaults.motion]
kind = "velocity"
forward = {{ per_m = 0.03 }}
turn = {{ per_m = 0.01, per_s = 0.005, per_rad = 0.05 }}
lateral = {{ per_m = 0.01 }}

[defaults.sensor]
range_sigma = 0.05
range_sigma_per_m = 0.02
bearing_sigma = 0.02
max_range = {reach}

[defaults.front_end]
particles = 100
window_s = 10.0
"""


def write(world: StressWorld, folder: Path | str) -> Path:
    """Write a world's CSV tables and the scenario with its noise; return the folder."""
    place, rng = Path(folder), np.random.default_rng(world.seed)
    place.mkdir(parents=True, exist_ok=True)
    points = _spread(world, rng)
    rows = [f"{i + 1},{x!r},{y!r}" for i, (x, y) in enumerate(points.tolist())]
    _table(place / "landmarks.csv", "landmark,x_m,y_m", rows)
    unknown = "" if world.starts else 'unknown_starts = ["*"]\n'
    text = SCENARIO.format(seed=world.seed, reach=world.reach_m + 2.0, unknown=unknown)
    (place / "scenario.toml").write_text(text)
    for number in range(1, world.robots + 1):
        _robot(world, f"r{number}", points, place / f"r{number}", rng)
    return place


def _spread(world: StressWorld, rng: np.random.Generator) -> np.ndarray:
    """Landmarks in the square, at least 3 m apart where there is room."""
    if world.grid:
        line = 5.0 * (np.arange(world.grid) - 0.5 * (world.grid - 1))
        return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    points: list[np.ndarray] = []
    tries = 0
    while len(points) < world.landmarks:
        point = rng.uniform(-world.half_m, world.half_m, 2)
        tries += 1
        if world.corridor and abs(point[0]) < 0.6 * world.half_m:
            continue
        if tries > 10_000 or all(np.hypot(*(point - each)) > 3.0 for each in points):
            points.append(point)
    return np.array(points).reshape(-1, 2)


def _robot(
    world: StressWorld, name: str, points: np.ndarray, place: Path, rng: np.random.Generator
) -> None:
    place.mkdir(exist_ok=True)
    step_s = world.step_s
    scale, yaw_bias = world.odometry_scale.get(name, 1.0), world.yaw_bias.get(name, 0.0)
    count = round(world.seconds / step_s)
    pose = np.array(
        [*rng.uniform(-0.4 * world.half_m, 0.4 * world.half_m, 2), rng.uniform(-pi, pi)]
    )
    start, path, speeds, logged = pose.copy(), [pose], [], []
    off = {round(each.at_s / step_s): each for each in world.carried_off if each.robot == name}
    goal = rng.uniform(-0.8 * world.half_m, 0.8 * world.half_m, 2)
    for k in range(count):
        if k in off:
            away = rng.uniform(-pi, pi)
            shift = off[k].metres * np.array([np.cos(away), np.sin(away)])
            moved = pose[:2] + shift
            if np.abs(moved).max() > world.half_m:
                moved = pose[:2] - shift
            pose = np.array([*moved, pose[2] + off[k].radians])
            path[-1] = pose
        ahead = goal - pose[:2]
        if np.hypot(*ahead) < 2.0:
            goal = rng.uniform(-0.8 * world.half_m, 0.8 * world.half_m, 2)
        error = (np.arctan2(ahead[1], ahead[0]) - pose[2] + pi) % (2 * pi) - pi
        turn = float(np.clip(0.8 * error, -0.6, 0.6))
        speed = SPEED * (1.0 if abs(error) < 1.0 else 0.4)
        speeds.append((speed, turn))
        pose = _arc(pose, speed, turn, step_s)
        path.append(pose)
        way, angle = speed * step_s, turn * step_s
        sigma_way = 0.03 * np.sqrt(way)
        sigma_turn = np.sqrt(0.01**2 * way + 0.005**2 * step_s + 0.05**2 * abs(angle))
        slip = world.noise * sigma_way * rng.standard_normal() / step_s
        twist = world.noise * sigma_turn * rng.standard_normal() / step_s
        logged.append((scale * (speed + slip), turn + twist + yaw_bias))
    times = step_s * np.arange(count + 1)
    rows = [
        f"{t:.3f},{float(v)!r},{float(w)!r}" for t, (v, w) in zip(times[:-1], logged, strict=True)
    ]
    _table(
        place / "odometry.csv", "t_s,forward_m_s,yaw_rate_rad_s", [*rows, f"{times[-1]:.3f},0,0"]
    )
    poses = zip(times, np.array(path).tolist(), strict=True)
    rows = [f"{t:.3f},{x!r},{y!r},{a!r}" for t, (x, y, a) in poses]
    _table(place / "truth.csv", "t_s,x_m,y_m,theta_rad", rows)
    if world.starts:
        x, y, a = start.tolist()
        _table(place / "start.csv", "x_m,y_m,theta_rad", [f"{x!r},{y!r},{a!r}"])
    _scans(world, name, points, path, place, rng)


def _arc(pose: np.ndarray, speed: float, turn: float, seconds: float) -> np.ndarray:
    """The pose after an exact arc."""
    angle = turn * seconds
    chord = speed * seconds * np.sinc(angle / 2 / pi)
    heading = pose[2] + angle / 2
    end = pose + np.array([chord * np.cos(heading), chord * np.sin(heading), angle])
    end[2] = (end[2] + pi) % (2 * pi) - pi
    return end


def _scans(
    world: StressWorld,
    name: str,
    points: np.ndarray,
    path: list[np.ndarray],
    place: Path,
    rng: np.random.Generator,
) -> None:
    late = world.late.get(name, 0.0)
    sign = -1.0 if name in world.mirrored else 1.0
    alias = {b: a for a, b in world.same_id}
    bursts = [each for each in world.bursts if each.robot == name]
    rows, labels = [], []
    every, drawn = world.scan_every, _errors(world, rng)
    for k in range(every, len(path) - every - math.ceil(max(late, 0.0) / world.step_s), every):
        stamp, pose = k * world.step_s + late, path[k]
        wild = [each for each in bursts if each.from_s <= k * world.step_s < each.to_s]
        further = world.range_offset.get(name, 0.0) + sum(each.metres for each in wild)
        aside = world.bearing_offset.get(name, 0.0) + sum(each.radians for each in wild)
        next(drawn)
        now = points.copy()
        for each in world.moved:
            if k * world.step_s >= each.from_s:
                now[each.landmark - 1] += each.shift
        away = now - pose[:2]
        ranges = np.hypot(*away.T)
        bearings = np.arctan2(away[:, 1], away[:, 0]) - pose[2]
        for i in np.flatnonzero(ranges < world.reach_m).tolist():
            sigma = np.hypot(0.05, 0.02 * ranges[i])
            along, across = drawn.send(True)
            z = ranges[i] + world.noise * sigma * along + further
            b = bearings[i] + world.noise * 0.02 * across
            b = sign * (b + aside)
            if rng.random() < world.outlier_share:
                z, b = rng.uniform(0.5, world.reach_m), rng.uniform(-pi, pi)
            b, z = (b + pi) % (2 * pi) - pi, max(z, 0.01)
            numbers = f"{float(z)!r},{float(b)!r}"
            own = alias.get(i + 1, i + 1)
            labels.append(f"{own}")
            rows.append(
                f"{stamp:.3f},{numbers}" if world.hidden else f"{stamp:.3f},{own},{numbers}"
            )
        for _ in range(world.clutter):
            z, b = rng.uniform(0.5, world.reach_m), rng.uniform(-pi, pi)
            labels.append("-1")
            rows.append(f"{stamp:.3f},{z!r},{b!r}")
    if world.hidden:
        _table(place / "detections.csv", "t_s,range_m,bearing_rad", rows)
        _table(place / "labels.csv", "landmark", labels)
    else:
        _table(place / "observations.csv", "t_s,landmark,range_m,bearing_rad", rows)


def _errors(
    world: StressWorld, rng: np.random.Generator
) -> Generator[np.ndarray, bool | None, None]:
    """Errors of range and bearing in standard deviations, one for each True that is sent.

    None marks the next scan. Of correlated errors, half of the variance is an Ornstein-Uhlenbeck
    process of the scans.
    """
    kept = rng.standard_normal(2) if world.correlated_s else np.zeros(2)
    fade = np.exp(-SCAN_S / world.correlated_s) if world.correlated_s else 0.0
    drawn = np.zeros(2)
    while True:
        if (yield drawn) is None:
            if world.correlated_s:
                kept = fade * kept + np.sqrt(1.0 - fade * fade) * rng.standard_normal(2)
            continue
        fresh = rng.standard_t(world.tails, 2) if world.tails else rng.standard_normal(2)
        drawn = (kept + fresh) / np.sqrt(2.0) if world.correlated_s else fresh


def _table(path: Path, head: str, rows: list[str]) -> None:
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
