"""Time grid of the team, at which every robot has a pose node, and inter-robot measurements.

All robots place nodes at the multiples of node_s, observed or not. The observer's odometry carries
an inter-robot measurement to the nearest grid time within sighting_s in the open window; several of
one teammate at one node are reduced to one, of fixes the nearest in time is used. The antenna of a
fix delayed by d is at T⁻¹ a from the robot at the fix's stamp, with the motion T over d.
"""

from bisect import insort
from dataclasses import dataclass, field, replace

import numpy as np

from teamslam.team import core
from teamslam.team.config import GNSS, FrontEnd, Gnss, MotionModel, Sensor
from teamslam.team.estimation.inter_robot import (
    BASE,
    CarriedPoint,
    carry_back,
    carry_on,
    from_station,
    of_base,
    point_seen,
    reduced,
)
from teamslam.team.estimation.models import Increment, model_of, scanned
from teamslam.team.rejection import Rejection
from teamslam.team.shapes import Float

NO_GNSS, NO_MOTION = Gnss(), MotionModel()
NEVER_NS = 2**62  # after every stamp
TeammateScan = tuple[tuple[str, ...], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Teammates, ranges [m] and bearings [rad] of one message."""


@dataclass(frozen=True, eq=False)
class NodeSighting:
    """One teammate observed from one pose node: range [m], bearing [rad], covariance.

    measurements: counters of the sensor's messages, ascending.
    """

    stamp_ns: int
    teammate: str
    measurement: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    measurements: tuple[int, ...]
    point: Float[np.ndarray, "2"] = field(default_factory=lambda: BASE)


@dataclass(frozen=True, eq=False)
class _Look:
    """A teammate observed in message `counter`, or the antenna with its fix."""

    stamp_ns: int
    counter: int
    teammate: str
    seen: CarriedPoint
    node_ns: int
    fix: CarriedPoint | None = None


class PoseGrid:
    """Grid times and inter-robot measurements of the open window; the segmenter stops at them."""

    def __init__(
        self,
        segmenter: core.Segmenter,
        sensor: Sensor,
        front_end: FrontEnd,
        gnss: Gnss = NO_GNSS,
        motion: MotionModel = NO_MOTION,
    ) -> None:
        self._segmenter = segmenter
        segmenter.stop_at(-NEVER_NS)  # at the stream's begin
        self._sensor = sensor
        self._motion = motion
        self._delay_ns = round(gnss.delay_s * 1e9)
        self._antenna = CarriedPoint(np.array(gnss.antenna), np.zeros((2, 2)))
        self._fixes: dict[int, tuple[_Look, CarriedPoint]] = {}
        self._grid_ns = round(front_end.node_s * 1e9)
        self._near_ns = round(front_end.sighting_s * 1e9)
        self._window_ns = round(front_end.window_s * 1e9)
        self._teammate_speed = front_end.teammate_speed
        self._node_ns = self._last_ns = 0
        self._begin_ns, self._has_begun = 0, False
        self._next_ns = NEVER_NS
        self._uncovered: list[_Look] = []
        self._ahead: list[_Look] = []
        self._at_node: dict[tuple[int, str], list[tuple[int, CarriedPoint]]] = {}

    def begin(self, stamp_ns: int) -> None:
        """Begin a window; its nodes are the grid times within window_s."""
        self._begin_ns, self._has_begun = stamp_ns, True
        self._node_ns = (stamp_ns // self._grid_ns + 1) * self._grid_ns
        self._last_ns = stamp_ns + self._window_ns
        self._uncovered, self._ahead, self._at_node, self._fixes = [], [], {}, {}
        self._find_next()

    def go_on(self, stamp_ns: int) -> None:
        """Extend a window to the next grid time after its planned end."""
        if stamp_ns >= self._begin_ns + self._window_ns:
            self._last_ns = (stamp_ns // self._grid_ns + 1) * self._grid_ns
            self._find_next()

    def observe(self, stamp_ns: int, counter: int, looks: TeammateScan) -> Rejection | None:
        """Store inter-robot measurements until odometry covers their time, or return the reason to
        reject all.
        """
        teammates, ranges, bearings = looks
        node_ns = self._node_near(stamp_ns)
        if node_ns is None:
            return Rejection.NO_NODE
        away_ns = abs(stamp_ns - node_ns)
        mask, distances, directions = scanned(self._sensor, ranges, bearings)
        distances = distances - self._sensor.marker_range_offset
        mask &= distances > 0.0
        for k in np.flatnonzero(mask):
            drift = self._teammate_speed * away_ns * 1e-9
            seen = point_seen(self._sensor, float(distances[k]), float(directions[k]), drift)
            if self._sensor.is_mounted:
                seen = of_base(seen, np.array(self._sensor.mount))
            look = _Look(stamp_ns, counter, teammates[k], seen, node_ns)
            insort(self._uncovered, look, key=_stamp_of)
        self._find_next()
        return None if mask.any() else Rejection.SENSOR_LIMITS

    def fix(self, stamp_ns: int, counter: int, position: CarriedPoint) -> Rejection | None:
        """Store a fix until odometry covers its time, or return the reason to reject it."""
        node_ns = self._node_near(stamp_ns)
        if node_ns is None:
            return Rejection.NO_NODE
        look = _Look(stamp_ns, counter, GNSS, self._antenna, node_ns, position)
        insort(self._uncovered, look, key=_stamp_of)
        self._find_next()
        return None

    def _node_near(self, stamp_ns: int) -> int | None:
        node_ns = (2 * stamp_ns + self._grid_ns) // (2 * self._grid_ns) * self._grid_ns
        is_near = abs(stamp_ns - node_ns) <= self._near_ns
        return node_ns if is_near and self._begin_ns < node_ns <= self._last_ns else None

    def _find_next(self) -> None:
        look_ns = self._uncovered[0].stamp_ns if self._uncovered else NEVER_NS
        self._next_ns = min(look_ns, self._node_ns if self._node_ns <= self._last_ns else NEVER_NS)
        self._segmenter.stop_at(self._next_ns)

    def pass_stops(self) -> None:
        """Pass the nodes and inter-robot measurements of the segmenter's interval."""
        while self._segmenter.is_stopped:
            if not self._has_begun:
                assert self._segmenter.start_ns is not None
                self.begin(self._segmenter.start_ns)
            else:
                self._reach()
            self._segmenter.go_on()

    def _reach(self) -> None:
        """Process the node or the measurement at the stop; a node precedes measurements."""
        segmenter = self._segmenter
        if self._next_ns == self._node_ns <= self._last_ns:
            for look, since in zip(self._ahead, segmenter.reach_node(), strict=True):
                self._keep(look, carry_on(look.seen, Increment(*since)))
            self._ahead = []
            self._node_ns += self._grid_ns
        else:
            look = self._uncovered.pop(0)
            if look.fix is not None and self._delay_ns:
                look = replace(look, seen=self._delayed_antenna())
            if look.stamp_ns < look.node_ns:
                self._ahead.append(look)
                segmenter.mark_sighting()
            else:
                since_node = Increment(*segmenter.since_node())
                self._keep(look, carry_back(look.seen, since_node))
        self._find_next()

    def _delayed_antenna(self) -> CarriedPoint:
        over, lasting_ns = self._segmenter.interval, abs(self._delay_ns)
        moved = over.gone_on(over.end_ns, lasting_ns).part(model_of(self._motion), lasting_ns, 0)
        carry = carry_on if self._delay_ns > 0 else carry_back
        return carry(self._antenna, Increment(*moved))

    def sightings(self) -> tuple[NodeSighting, ...]:
        """List the window's inter-robot measurements and fixes that reached a node."""
        fixes = tuple(_fix_at(*self._fixes[node_ns]) for node_ns in sorted(self._fixes))
        return fixes + tuple(
            NodeSighting(
                node_ns,
                teammate,
                *reduced([seen for _, seen in looks]),
                tuple(sorted({counter for counter, _ in looks})),
            )
            for (node_ns, teammate), looks in sorted(self._at_node.items())
        )

    def _keep(self, look: _Look, at_node: CarriedPoint) -> None:
        if look.fix is not None:
            kept = self._fixes.get(look.node_ns)
            away_ns = abs(look.stamp_ns - look.node_ns)
            if kept is None or away_ns < abs(kept[0].stamp_ns - look.node_ns):
                self._fixes[look.node_ns] = look, at_node
            return
        key = (look.node_ns, look.teammate)
        self._at_node.setdefault(key, []).append((look.counter, at_node))


def _stamp_of(look: _Look) -> int:
    return look.stamp_ns


def _fix_at(look: _Look, antenna: CarriedPoint) -> NodeSighting:
    """Make a node's fix, with the antenna's total variance in every direction."""
    assert look.fix is not None
    spread = look.fix.covariance + np.trace(antenna.covariance) * np.eye(2)
    measured = from_station(look.fix.point, spread)
    return NodeSighting(look.node_ns, GNSS, *measured, (look.counter,), antenna.point)
