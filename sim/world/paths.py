"""True motion of simulated robots: steps (distance [m], rotation [rad]) and poses (x, y, θ)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import pi
from typing import Literal

import numpy as np

from teamslam.team.core import atan2, cos, hypot, sin
from teamslam.team.shapes import Float

Kind = Literal["turn-then-drive", "velocity", "differential-drive", "ackermann"]
Pose = tuple[float, float, float]
Step = tuple[float, float]

ALIGNED_RAD = 0.02  # largest heading error at which a robot that turns first begins to drive


@dataclass(frozen=True)
class Drive:
    """K true steps and K + 1 true poses."""

    poses: Float[np.ndarray, "K_plus_1 3"]
    steps: Float[np.ndarray, "K 2"]


@dataclass(frozen=True)
class Limits:
    """Limits of a step, and the distance at which a way-point is reached.

    turn_first: a rotating step has no translation. radius: least turning radius [m]; 0: on the
    spot.
    """

    distance: float
    turn: float
    tolerance: float
    turn_first: bool = False
    radius: float = 0.0


def wrapped(angle: float) -> float:
    """Angle in (−π, π]."""
    turned = (angle + pi) % (2.0 * pi) - pi
    return pi if turned == -pi else turned


def follow_way_points(way_points: Float[np.ndarray, "W 2"], steps: int) -> Drive:
    """Follow a polyline in steps of equal arc length, chords at corners: rotate, then drive."""
    legs = hypot(*np.diff(way_points, axis=0).T)
    arc = np.concatenate(([0.0], np.cumsum(legs)))
    at = np.linspace(0.0, arc[-1], steps + 1)
    xy = np.column_stack([np.interp(at, arc, way_points[:, i]) for i in (0, 1)])
    chord = np.diff(xy, axis=0)
    heading = atan2(chord[:, 1], chord[:, 0])
    heading = np.concatenate((heading[:1], heading))
    turns = np.array([wrapped(turn) for turn in np.diff(heading)])
    return Drive(
        poses=np.column_stack([xy, heading]),
        steps=np.column_stack([hypot(chord[:, 0], chord[:, 1]), turns]),
    )


def steer_to_way_points(
    start: Pose,
    way_points: Iterator[tuple[float, float]],
    limits: Limits,
    kind: Kind,
    steps: int,
    slip: Callable[[int, Step], tuple[float, float]],
) -> Drive:
    """Steer to each way-point in turn; stand after the last.

    A step rotates towards the way-point up to the limit, and drives less, the further it lies to
    the side. slip(k, step): final rotation [rad] and left slip [m].
    """
    poses, taken = [start], []
    target = next(way_points, None)
    for k in range(steps):
        x, y, _ = poses[-1]
        while target and hypot(target[0] - x, target[1] - y) <= limits.tolerance:
            target = next(way_points, None)
        step = _towards(poses[-1], target, limits) if target else (0.0, 0.0)
        taken.append(step)
        poses.append(move_pose(poses[-1], step, kind, *slip(k, step)))
    return Drive(np.array(poses), np.array(taken))


def move_pose(
    pose: Pose, step: Step, kind: Kind, final_turn: float = 0.0, lateral: float = 0.0
) -> Pose:
    """Pose after a step, a left slip and a final rotation.

    turn-then-drive: rotation, then straight. Others: an arc of chord distance · sin(φ/2)/(φ/2) in
    direction θ + φ/2.
    """
    x, y, heading = pose
    distance, turn = step
    end = heading + turn
    if kind == "turn-then-drive":
        chord, direction = distance, end
    else:
        half = 0.5 * turn
        chord, direction = distance * (sin(half) / half if half else 1.0), heading + half
    return (
        x + chord * cos(direction) - lateral * sin(end),
        y + chord * sin(direction) + lateral * cos(end),
        wrapped(end + final_turn),
    )


def _towards(pose: Pose, target: tuple[float, float], limits: Limits) -> Step:
    dx, dy = target[0] - pose[0], target[1] - pose[1]
    aside = wrapped(atan2(dy, dx) - pose[2])
    turn = min(max(aside, -limits.turn), limits.turn)
    if limits.radius:
        distance = min(limits.distance, hypot(dx, dy))
        return distance, min(max(turn, -distance / limits.radius), distance / limits.radius)
    if limits.turn_first:
        if abs(aside) > ALIGNED_RAD:
            return 0.0, turn
        turn = 0.0
    distance = min(limits.distance, hypot(dx, dy)) * max(0.0, cos(aside - turn))
    return distance, turn
