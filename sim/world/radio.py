"""Radio reach between robots: by true distance, or in time windows."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from teamslam.sim.world.config import Radio
from teamslam.sim.world.streams import RobotStream
from teamslam.team import core
from teamslam.team.shapes import Bool, Float, Int64

PERIOD_NS = 1_000_000_000
"""Team time [ns] of constant reach."""


@dataclass(frozen=True)
class Reach:
    """Reach between robots: row t holds for one period from first_ns + t · PERIOD_NS.

    pairs: T × P, pairs of robots in order. ends_ns: end of each robot's stream.
    """

    robots: tuple[str, ...]
    first_ns: int
    pairs: Bool[np.ndarray, "T P"]
    ends_ns: dict[str, int]

    def between(self, one: str, other: str, now_ns: int) -> bool:
        """Whether two robots reach each other; the last row extends."""
        if one == other or one not in self.ends_ns or other not in self.ends_ns:
            return True
        if now_ns >= max(self.ends_ns[one], self.ends_ns[other]):
            return True
        row = min(max((now_ns - self.first_ns) // PERIOD_NS, 0), len(self.pairs) - 1)
        i, j = sorted((self.robots.index(one), self.robots.index(other)))
        n = len(self.robots)
        return bool(self.pairs[row, i * n - i * (i + 1) // 2 + j - i - 1])


def reach_of(radio: Radio, streams: Sequence[RobotStream]) -> Reach:
    """Reach between the robots of a world; raises ValueError if a range needs missing truth."""
    robots = tuple(stream.robot for stream in streams)
    first_ns = min((int(s.stamps_ns[0]) for s in streams if len(s)), default=0)
    ends_ns = {s.robot: int(s.stamps_ns[-1]) if len(s) else first_ns for s in streams}
    rows = (max(ends_ns.values(), default=first_ns) - first_ns) // PERIOD_NS + 1
    times = first_ns + PERIOD_NS * np.arange(rows, dtype=np.int64)
    couples = list(combinations(range(len(streams)), 2))
    pairs = np.ones((rows, len(couples)), dtype=np.bool_)
    if radio.comm_range_m is not None:
        at = [_positions(stream, times) for stream in streams]
        for k, (i, j) in enumerate(couples):
            pairs[:, k] = core.hypot(*(at[i] - at[j]).T) <= radio.comm_range_m
    if radio.windows:
        seconds = (times - first_ns) * 1e-9
        opened = np.zeros_like(pairs)
        for window in radio.windows:
            then = (window.from_s <= seconds) & (seconds < window.to_s)
            for k, (i, j) in enumerate(couples):
                opened[:, k] |= then & ({robots[i], robots[j]} <= set(window.robots))
        pairs &= opened
    return Reach(robots, first_ns, pairs, ends_ns)


def _positions(stream: RobotStream, times: Int64[np.ndarray, " T"]) -> Float[np.ndarray, "T 2"]:
    if stream.truth is None or stream.truth_ns is None or not len(stream.truth):
        raise ValueError(f"radio.comm_range_m needs the truth of {stream.robot}: there is none")
    x, y = (np.interp(times, stream.truth_ns, stream.truth[:, axis]) for axis in (0, 1))
    return np.column_stack([x, y])
