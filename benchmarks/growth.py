"""How the centre's cost grows with the length of a run: time, memory and bytes per broadcast.

    python -m benchmarks.growth [--robots 5] [--landmarks 50] [--at 250,500,1000,2500] [--json FILE]

Synthetic submaps, drawn about a known truth, go through the rule `join` without a network: all
robots end a window in each tick, then comes a broadcast. At each size: CPU per tick with its
broadcast (the median of the last WINDOW), resident memory, bytes of the map and of all priors, and
how far the map is from the truth. `ratio_*` compare the ends of one run, so they hold on any
machine; growth.json has the baseline with direction and tolerance. Exit status 1 if a figure is
worse than that allows.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baseline import worse
from central.config import CentralConfig
from central.intake import Instant
from central.join_rule import JoinRule
from central.scheduler import Scheduler
from team import translate
from team.estimation.submap import LocalMap
from team.wire import messages as m
from team.wire.arrays import floats, from_floats, ids
from team.wire.bus import Outgoing
from team.wire.codec import encoded

TICK_S = 10.0
WINDOW = 25
"""Ticks of which the median is told."""
SEEN = 8
"""Landmarks that a robot sees in a window on average."""
SPACING_M = 10.0
"""Between neighbouring landmarks."""
SIGMAS = (0.1, 0.02, 0.2)
"""Of a submap: end position [m], end heading [rad], landmark [m]."""


class World:
    """Landmarks in a square, and robots that wander in it; submaps tick by tick."""

    def __init__(self, robots: int, landmarks: int, seed: int = 1) -> None:
        self._rng = np.random.default_rng(seed)
        self.size = SPACING_M * np.sqrt(landmarks)
        self._reach = SPACING_M * np.sqrt(SEEN / np.pi)
        self.landmarks = self._rng.uniform(0.0, self.size, (landmarks, 2))
        where = self._rng.uniform(0.2 * self.size, 0.8 * self.size, (robots, 2))
        self._poses = np.column_stack([where, self._rng.uniform(-3.0, 3.0, robots)])
        self._ticks = 0

    def starts(self) -> Iterator[m.InitialPose]:
        """Where the robots begin, exactly."""
        for r, pose in enumerate(self._poses):
            yield m.InitialPose(
                stamp_ns=0,
                robot=f"r{r}",
                incarnation=1,
                number=0,
                pose=from_floats(pose),
                covariance=b"",
            )

    def tick(self) -> list[m.Submap]:
        """One submap of each robot."""
        made = [self._submap(r) for r in range(len(self._poses))]
        self._ticks += 1
        return made

    def _submap(self, r: int) -> m.Submap:
        rng, pose = self._rng, self._poses[r]
        middle = 0.5 * self.size - pose[:2]
        outside = np.hypot(*middle) / (0.5 * self.size)
        aside = np.sin(np.arctan2(middle[1], middle[0]) - pose[2])
        turn = 0.8 * min(outside, 1.5) ** 2 * aside + 0.4 * rng.normal()
        step = 0.6 * SPACING_M
        local_end = np.array([step * np.cos(turn / 2), step * np.sin(turn / 2), turn])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turned = np.array([[c, -s], [s, c]])
        offsets = self.landmarks - pose[:2]
        seen = np.flatnonzero(np.hypot(*offsets.T) < self._reach)
        truth = np.concatenate([local_end, (offsets[seen] @ turned).ravel()])
        sigmas = np.array([SIGMAS[0], SIGMAS[0], SIGMAS[1], *[SIGMAS[2]] * (2 * len(seen))])
        n = len(sigmas)
        root = (np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n)) * sigmas[:, None]
        covariance = root @ root.T
        mean = truth + root @ rng.normal(size=n)
        self._poses[r] = [*(pose[:2] + turned @ local_end[:2]), pose[2] + turn]
        k = self._ticks
        ends = (round(k * TICK_S * 1e9), round((k + 1) * TICK_S * 1e9))
        local = LocalMap(seen.astype(np.uint32), mean, 0.5 * (covariance + covariance.T))
        counters = (1 + 100 * k, 100 * (k + 1))
        return translate.submap_message(f"r{r}", 1, k, counters, ends, bytes(8), local)


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measured(robots: int, landmarks: int, at: list[int]) -> list[dict[str, float]]:
    """A row of figures at each number of submaps."""
    world = World(robots, landmarks)
    names = [f"r{r}" for r in range(robots)]
    config = CentralConfig(tick_s=TICK_S, broadcast_s=TICK_S)
    scheduler = Scheduler(JoinRule(config, bytes(8), names))
    intake = scheduler.intake
    for start in world.starts():
        intake.take(start, 0)
    rows: list[dict[str, float]] = []
    cpu_ms, sent = list[float](), list[tuple[int, int]]()
    for k in range(max(at) // robots):
        submaps = world.tick()
        now_ns = submaps[-1].stamp_ns
        before = time.process_time()
        for submap in submaps:
            intake.take(submap, now_ns)
        out = scheduler.at(Instant(now_ns, intake.inputs(now_ns, now_ns)))
        cpu_ms.append(1e3 * (time.process_time() - before))
        sent.append(_bytes(out))
        if (k + 1) * robots in at:
            row = {
                "submaps": float((k + 1) * robots),
                "tick_ms": float(np.median(cpu_ms[-WINDOW:])),
                "tick_ms_worst": float(max(cpu_ms[-WINDOW:])),
                "cpu_s": sum(cpu_ms) * 1e-3,
                "resident_mb": resident_mb(),
                "map_bytes": float(np.mean([each[0] for each in sent[-WINDOW:]])),
                "prior_bytes": float(np.mean([each[1] for each in sent[-WINDOW:]])),
                "rmse_m": _rmse(out, world),
            }
            rows.append(row)
            print("  ".join(f"{key} {value:.5g}" for key, value in row.items()), flush=True)
    return rows


def _bytes(out: list[Outgoing]) -> tuple[int, int]:
    """Of the maps and of the priors that went out."""
    maps = sum(len(encoded(o.message)) for o in out if isinstance(o.message, m.FusedMap))
    return maps, sum(len(encoded(o.message)) for o in out if isinstance(o.message, m.Prior))


def _rmse(out: list[Outgoing], world: World) -> float:
    """Of the newest map's landmarks."""
    fused = next((o.message for o in out if isinstance(o.message, m.FusedMap)), None)
    if fused is None:
        return float("nan")
    error = floats(fused.means, "means").reshape(-1, 2) - world.landmarks[ids(fused.ids, "ids")]
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def figures(rows: list[dict[str, float]]) -> dict[str, float]:
    """What the baseline is about: the largest size, and its ratio to 500 submaps or the least.

    kb_per_submap: between the last two sizes.
    """
    last = rows[-1]
    base = next((row for row in rows if row["submaps"] >= 500), rows[0])
    before = rows[-2] if len(rows) > 1 else rows[0]
    further = max(last["submaps"] - before["submaps"], 1.0)
    return {
        "tick_ms": last["tick_ms"],
        "ratio_tick": last["tick_ms"] / base["tick_ms"],
        "kb_per_submap": 1e3 * (last["resident_mb"] - before["resident_mb"]) / further,
        "bytes_per_broadcast": last["map_bytes"] + last["prior_bytes"],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--landmarks", type=int, default=50)
    parser.add_argument("--at", default="250,500,1000,2500")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    at = sorted(int(each) for each in told.at.split(","))
    rows = measured(told.robots, told.landmarks, at)
    found: dict[str, Any] = {"rows": rows, "figures": figures(rows)}
    print(json.dumps(found["figures"], indent=1))
    if told.json:
        told.json.write_text(json.dumps(found, indent=1) + "\n")
    standard = (told.robots, told.landmarks, at[-1]) == (5, 50, 2500)
    problems = worse(found["figures"], "growth") if standard else []
    print("\n".join(problems), file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
