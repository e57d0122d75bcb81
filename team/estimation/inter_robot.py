"""A teammate observed from a pose node: a range-bearing factor between two robots' pose nodes.

A fix (GNSS) is one, too: the station, an exact pose far away, measures the antenna. The observer's
odometry T ∘ Exp(xi), xi ~ N(0, C), carries the point to the pose node: p' = T Exp(xi) p to an
earlier node, p' = (T Exp(xi))⁻¹ p to a later one; its covariance grows by J C Jᵀ with J = R [I |
(−p_y, p_x)ᵀ] and −[I | (−p'_y, p'_x)ᵀ].
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from teamslam.team import core
from teamslam.team.config import GNSS, Sensor
from teamslam.team.core import NEAREST_M
from teamslam.team.estimation import dense
from teamslam.team.estimation.contribution import Stream, named
from teamslam.team.estimation.gaussian import information
from teamslam.team.estimation.models import Increment, noise
from teamslam.team.estimation.se2 import Pose, inverse, rotation, transformed, wrapped
from teamslam.team.shapes import Float

STATION_POSE = np.array([0.0, -1e5, 0.0])
"""Pose of the station in the survey's frame, so far away that (range, bearing) is linear."""
BASE = np.zeros(2)
SightingKey: TypeAlias = tuple[int, str, int, str]
"""(stamp, robot, incarnation, teammate): place in the canonical order."""


@dataclass(frozen=True, eq=False)
class InterRobotFactor:
    """An inter-robot measurement from the pose node at stamp_ns of submap `sequence`.

    measurement: (range [m], bearing [rad]) of the teammate's node at the same stamp. covariance:
    [m², m·rad, rad²]. A fix, from the station, has the teammate GNSS; point: the antenna in the
    frame of the robot's node [m].
    """

    robot: str
    incarnation: int
    sequence: int
    stamp_ns: int
    teammate: str
    measurement: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    point: Float[np.ndarray, "2"] = field(default_factory=lambda: BASE)

    @property
    def is_fix(self) -> bool:
        """Whether the station measures the robot."""
        return self.teammate == GNSS

    @property
    def stream(self) -> Stream:
        """(robot, incarnation) of the observer, or of a fix's robot."""
        return (self.robot, self.incarnation)

    @property
    def key(self) -> SightingKey:
        """Place in the canonical order."""
        return (self.stamp_ns, self.robot, self.incarnation, self.teammate)

    @cached_property
    def information(self) -> Float[np.ndarray, "2 2"]:
        """Inverse covariance. Raises NotACovarianceError that names the measurement."""
        what = f"a sighting of {self.teammate} by {named(self.stream)}"
        return information(self.covariance, what)


def from_station(
    position: Float[np.ndarray, "2"], covariance: Float[np.ndarray, "2 2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """Convert a position [m] in the survey's frame to the station's (range, bearing), J C Jᵀ."""
    x, y = position - STATION_POSE[:2]
    distance = core.hypot(x, y)
    J = np.array([[x, y], [-y / distance, x / distance]]) / distance
    spread = dense.congruent(J, covariance)
    return np.array([distance, core.atan2(y, x)]), 0.5 * (spread + spread.T)


class CarriedPoint(NamedTuple):
    """A point in the observer's frame [m] with its covariance [m²]."""

    point: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]


def point_seen(sensor: Sensor, distance: float, bearing: float, drift: float) -> CarriedPoint:
    """Locate a teammate at (range [m], bearing [rad]) that moves by about `drift` [m] until the
    node.

    The covariance sums those of sensor, marker (marker_sigma) and drift.
    """
    range_variance, bearing_variance = noise(sensor, distance)
    own = core.squared(sensor.marker_sigma) + drift * drift
    turn = rotation(bearing)
    spread = np.diag([range_variance + own, bearing_variance * core.squared(distance) + own])
    return CarriedPoint(distance * turn[:, 0], dense.congruent(turn, spread))


def of_base(seen: CarriedPoint, mount: Pose) -> CarriedPoint:
    """Transform a point from the sensor's frame to that of the base."""
    turn = rotation(float(mount[2]))
    return CarriedPoint(transformed(mount, seen.point), dense.congruent(turn, seen.covariance))


def carry_back(seen: CarriedPoint, node_from_here: Increment) -> CarriedPoint:
    """Carry the point back to an earlier node."""
    T = node_from_here.mean
    turn = rotation(float(T[2]))
    J = dense.product(turn, np.array([[1.0, 0.0, -seen.point[1]], [0.0, 1.0, seen.point[0]]]))
    spread = dense.congruent(turn, seen.covariance) + dense.congruent(J, node_from_here.covariance)
    return CarriedPoint(transformed(T, seen.point), spread)


def carry_on(seen: CarriedPoint, here_from_node: Increment) -> CarriedPoint:
    """Carry the point on to a later node."""
    T = inverse(here_from_node.mean)
    point = transformed(T, seen.point)
    turn = rotation(float(T[2]))
    J = np.array([[1.0, 0.0, -point[1]], [0.0, 1.0, point[0]]])
    spread = dense.congruent(turn, seen.covariance) + dense.congruent(J, here_from_node.covariance)
    return CarriedPoint(point, spread)


def reduced(
    carried: Sequence[CarriedPoint],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """Reduce several measurements from one node to their median (range, bearing).

    The covariance is the mean, since a camera repeats its error.
    """
    ranges = [max(core.hypot(*each.point), NEAREST_M) for each in carried]
    bearings = [core.atan2(each.point[1], each.point[0]) for each in carried]
    offsets = [wrapped(bearing - bearings[0]) for bearing in bearings]
    total = np.zeros((2, 2))
    for each, distance in zip(carried, ranges, strict=True):
        x, y = each.point / distance
        polar = np.array([[x, y], [-y / distance, x / distance]])
        total += dense.congruent(polar, each.covariance)
    bearing = wrapped(bearings[0] + float(np.median(offsets)))
    mean = total / len(carried)
    return np.array([float(np.median(ranges)), bearing]), 0.5 * (mean + mean.T)
