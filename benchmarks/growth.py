"""Measure how the centre's time, memory and bytes per broadcast grow with a run's length.

    python -m benchmarks.growth [--robots 5] [--landmarks 50] [--at 250,500,1000,2500] [--json FILE]
                              [--identities hidden]

Synthetic submaps go through the rule `join` without a network: in each tick all robots end a
window, then comes a broadcast. Each size reports CPU per tick (median of the last WINDOW), resident
memory, bytes of the map and of all priors, and map error. `ratio_*` compare the ends of one run.
Without identities the error is to the nearest true landmark, and `window_ms` is a robot's cost to
associate one window of WINDOW scans. Exit status 1 if a figure is worse than growth.json allows.
"""

import os
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from benchmarks.baseline import conclude, parser_of
from teamslam.central.config import CentralConfig
from teamslam.central.map_publisher import MapPublisher
from teamslam.central.submap_fold import SubmapFold
from teamslam.team import translate
from teamslam.team.association import profile_for
from teamslam.team.config import UNNAMED, AssociationSettings, Sensor
from teamslam.team.estimation.association.clustering import associate_window
from teamslam.team.estimation.association.scans import UNASSIGNED, Scans
from teamslam.team.estimation.submap import LocalMap, Unnamed
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from tests import build

TICK_S = 10.0
WINDOW = 25  # ticks per median
SEEN = 8  # mean number of landmarks detected in a window
SPACING_M = 10.0  # spacing of neighbouring landmarks
SIGMAS = (0.1, 0.02, 0.2)
"""Standard deviations of a submap: end position [m], end heading [rad], landmark [m]."""

BASELINES: Mapping[tuple[int, int, int, str | None], str] = {
    (5, 50, 2500, None): "growth",
    (10, 1000, 2000, None): "growth-large",
    (5, 50, 2000, "hidden"): "growth-hidden",
}


class World:
    """Landmarks in a square, and robots on random paths, which yield submaps tick by tick."""

    def __init__(self, robots: int, landmarks: int, seed: int = 1, hidden: bool = False) -> None:
        self.hidden = hidden
        self._rng = np.random.default_rng(seed)
        self.size = SPACING_M * np.sqrt(landmarks)
        self._reach = SPACING_M * np.sqrt(SEEN / np.pi)
        self.landmarks = self._rng.uniform(0.0, self.size, (landmarks, 2))
        where = self._rng.uniform(0.2 * self.size, 0.8 * self.size, (robots, 2))
        self._poses = np.column_stack([where, self._rng.uniform(-3.0, 3.0, robots)])
        self._ticks = 0

    def starts(self) -> Iterator[m.InitialPose]:
        for r, pose in enumerate(self._poses):
            yield build.initial_pose(robot=f"r{r}", pose=pose)

    def tick(self) -> list[m.Submap]:
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
        symmetric = 0.5 * (covariance + covariance.T)
        local = LocalMap(seen.astype(np.uint32), mean, symmetric)
        if self.hidden:
            numbers = (UNNAMED + np.arange(len(seen))).astype(np.uint32)
            together = Unnamed(np.full(len(seen), 5, np.uint32), np.ones((len(seen), 1), np.bool_))
            local = LocalMap(numbers, mean, symmetric, unnamed=together)
        counters = (1 + 100 * k, 100 * (k + 1))
        return translate.submap_message(f"r{r}", 1, k, counters, ends, bytes(8), local)

    def window(self) -> Scans:
        """Draw one robot's detections in a window of WINDOW scans."""
        rng, pose = self._rng, self._poses[0]
        offsets = self.landmarks - pose[:2]
        seen = offsets[np.hypot(*offsets.T) < self._reach]
        step = 0.6 * SPACING_M / WINDOW
        truth = [seen - step * (k + 1) * np.array([1.0, 0.0]) for k in range(WINDOW)]
        points = np.concatenate(truth)
        n = len(points)
        return Scans(
            np.tile([step, 0.0, 0.0], (WINDOW, 1)),
            np.tile(np.diag([0.02, 0.02, 0.004]) ** 2, (WINDOW, 1, 1)),
            np.repeat(np.arange(WINDOW), len(seen)),
            points + SIGMAS[2] * rng.normal(size=(n, 2)),
            np.tile(SIGMAS[2] ** 2 * np.eye(2), (n, 1, 1)),
            np.full(n, UNASSIGNED),
        )


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def window_ms(world: World) -> float:
    """Measure the CPU time of a window's association, the median of five windows."""
    spent = []
    for _ in range(5):
        scans = world.window()
        before = time.process_time()
        associate_window(scans, AssociationSettings())
        spent.append(1e3 * (time.process_time() - before))
    return float(np.median(spent))


def measure_growth(
    robots: int, landmarks: int, at: list[int], hidden: bool = False
) -> list[dict[str, float]]:
    world = World(robots, landmarks, hidden=hidden)
    lengths = profile_for(Sensor(range_sigma=SIGMAS[2], bearing_sigma=1e-6), 1.0)
    config = CentralConfig(tick_s=TICK_S, broadcast_s=TICK_S, association=lengths)
    publisher = MapPublisher(SubmapFold(config, bytes(8)))
    for start in world.starts():
        publisher.store.add(start)
    rows: list[dict[str, float]] = []
    cpu_ms, sent = list[float](), list[tuple[int, int]]()
    for k in range(max(at) // robots):
        submaps = world.tick()
        now_ns = submaps[-1].stamp_ns
        before = time.process_time()
        for submap in submaps:
            publisher.store.add(submap)
        out = publisher.publish_due(now_ns, now_ns)
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
            if hidden:
                row |= {"landmarks": float(_count_landmarks(out)), "window_ms": window_ms(world)}
            rows.append(row)
            print("  ".join(f"{key} {value:.5g}" for key, value in row.items()), flush=True)
    return rows


def _bytes(out: list[Outgoing]) -> tuple[int, int]:
    maps = sum(len(encoded(o.message)) for o in out if isinstance(o.message, m.FusedMap))
    return maps, sum(len(encoded(o.message)) for o in out if isinstance(o.message, m.Prior))


def _rmse(out: list[Outgoing], world: World) -> float:
    fused = next((o.message for o in out if isinstance(o.message, m.FusedMap)), None)
    if fused is None:
        return float("nan")
    means = floats(fused.means, "means").reshape(-1, 2)
    if world.hidden:
        away = np.linalg.norm(means[:, None] - world.landmarks[None], axis=2)
        return float(np.sqrt((away.min(axis=1) ** 2).mean()))
    error = means - world.landmarks[ids(fused.ids, "ids")]
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _count_landmarks(out: list[Outgoing]) -> int:
    return max(len(ids(o.message.ids, "ids")) for o in out if isinstance(o.message, m.FusedMap))


def figures(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the figures of the largest size, and their ratios to 500 submaps or the least."""
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
    parser = parser_of(__doc__)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--landmarks", type=int, default=50)
    parser.add_argument("--at", default="250,500,1000,2500")
    parser.add_argument("--identities", choices=["hidden"])
    told = parser.parse_args()
    at = sorted(int(each) for each in told.at.split(","))
    rows = measure_growth(told.robots, told.landmarks, at, told.identities == "hidden")
    case = told.robots, told.landmarks, at[-1], told.identities
    return conclude({"rows": rows, "figures": figures(rows)}, BASELINES.get(case), told.json)


if __name__ == "__main__":
    sys.exit(main())
