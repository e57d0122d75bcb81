"""Amount of motion that a calibration needs and has."""

from collections.abc import Iterable

import numpy as np

from teamslam.sim.world.streams import RobotStream

SPAN_S = 10.0
"""Stretch length [s] for errors: errors of one command are correlated for seconds."""
LEAST_SPANS = 30
"""Least number of moving stretches of all robots together."""
LEAST_WAY_M = 0.05
"""Least logged path [m] of a moving stretch."""


def too_short(stretches: int) -> str:
    """Error for data with this number of moving stretches, and the remedy."""
    return (
        f"calibrate needs {LEAST_SPANS} stretches of {SPAN_S:.0f} s with motion, of all robots "
        f"together, and these data have {stretches}: give several data sets at once, record "
        f"{SPAN_S * (LEAST_SPANS - stretches) / 60.0:.1f} minutes more, or write known figures "
        "into a scenario (docs/your_data.md, Noise)."
    )


def moving_stretches(streams: Iterable[RobotStream]) -> int:
    """Number of whole stretches of SPAN_S in which a robot's odometry moves.

    An upper bound: a calibration omits stretches with an unknown reference path.
    """
    return sum(map(_count_moving, streams))


def _count_moving(stream: RobotStream) -> int:
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
