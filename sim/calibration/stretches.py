"""How much motion a calibration needs, and how much there is."""

from collections.abc import Iterable

import numpy as np

from sim.world.streams import RobotStream

SPAN_S = 10.0
"""Length [s] of the stretches over which errors are taken: errors of one command are correlated for
seconds.
"""
LEAST_SPANS = 30
"""Least number of stretches with motion, of all robots together."""
LEAST_WAY_M = 0.05
"""A stretch with a shorter logged path [m] has no motion."""


def moving_stretches(streams: Iterable[RobotStream]) -> int:
    """The number of whole stretches of SPAN_S in which the odometry of a robot moves.

    A calibration has at most so many: it leaves out those where the path of reference is not known.
    """
    return sum(map(_moving, streams))


def _moving(stream: RobotStream) -> int:
    driven = stream.intervals
    if not len(driven.end_ns):
        return 0
    begin_ns = int(driven.end_ns[0] - driven.duration_ns[0])
    ways = np.abs(driven.forward) * driven.duration_ns * 1e-9
    if driven.increments is not None:
        lengths = np.hypot(driven.increments[:, 0], driven.increments[:, 1])
        ways = np.where(driven.as_motions, lengths, ways)
    seconds = np.append(0.0, (driven.end_ns - begin_ns) * 1e-9)
    edges = SPAN_S * np.arange(int(seconds[-1] / SPAN_S) + 1)
    logged = np.diff(np.interp(edges, seconds, np.append(0.0, np.cumsum(ways))))
    return int(np.count_nonzero(logged > LEAST_WAY_M))
