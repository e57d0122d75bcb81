"""The gain by communication: error of each robot's own map and pose, by the range of its radio.

    python -m tests.trials.comm_range [--steps N] [--picture docs/static/comm_range.png]

`random-10` without a centre, in memory, without alignment.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")
import matplotlib.pyplot as plt

from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import RobotStream
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, ids
from teamslam.team.wire.codec import decoded
from tests.air import air_of
from tests.peer_team import PeerTeam, peer_world
from tests.scenarios import with_world

EVERY_S = 5.0
Rows = dict[str, list[float]]


def measured(range_m: float | None, steps: int) -> Rows:
    scenario = with_options(load("random-10"), centre=False, comm_range_m=range_m)
    scenario = with_world(scenario, steps=steps)
    streams = streams_of(scenario)
    assert streams.landmarks is not None
    where = dict(zip(streams.landmark_ids.tolist(), streams.landmarks, strict=True))
    team = PeerTeam(scenario, air_of(scenario, streams))
    truth = {each.robot: each for each in streams.streams}
    poses: dict[str, list[tuple[float, float]]] = {robot: [] for robot in truth}
    maps: dict[str, list[tuple[float, float, float]]] = {robot: [] for robot in truth}
    located: set[str] = set()
    for sample in team.run(peer_world(scenario, streams)):
        channel, robot = ch.channel_of(sample.key) or (None, "")
        if channel is ch.TEAM_POSE or (channel is ch.OWN_POSE and robot not in located):
            if channel is ch.TEAM_POSE:
                located.add(robot)
            pose = decoded(sample.payload, m.PoseEstimate)
            at = floats(pose.pose, "pose")[:2]
            off = np.hypot(*(at - _true(truth[robot], pose.stamp_ns)))
            poses[robot].append((pose.stamp_ns * 1e-9, float(off)))
        elif channel is ch.TEAM_MAP:
            fused = decoded(sample.payload, m.FusedMap)
            means = floats(fused.means, "means").reshape(-1, 2)
            offs = [means[i] - where[k] for i, k in enumerate(ids(fused.ids, "ids").tolist())]
            if offs:
                square = float(np.mean(np.square(offs).sum(axis=1)))
                maps[robot].append((team.now_ns * 1e-9, square, float(len(offs))))
    end_s = max(int(each.stamps_ns[-1]) for each in streams.streams) * 1e-9
    times = np.arange(EVERY_S, end_s + EVERY_S, EVERY_S)
    at_pose = np.array([_held(times, poses[r], 1) for r in truth])
    at_map = np.array([_held(times, maps[r], 1) for r in truth])
    count = np.array([_held(times, maps[r], 2, 0.0) for r in truth])
    return {
        "time_s": times.tolist(),
        "pose_m": np.sqrt(np.nanmean(at_pose**2, axis=0)).tolist(),
        "map_m": _rms(at_map).tolist(),
        "landmarks": count.mean(axis=0).tolist(),
        "complete_s": [max(team.complete_ns.values()) * 1e-9],
        "said_bytes": [float(np.mean([seat.node.uplink for seat in team.seats.values()]))],
    }


def _rms(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    there = np.isfinite(squares).any(axis=0)
    out = np.full(squares.shape[1], np.nan)
    out[there] = np.sqrt(np.nanmean(squares[:, there], axis=0))
    return out


def _true(stream: RobotStream, stamp_ns: int) -> NDArray[np.float64]:
    assert stream.truth is not None
    assert stream.truth_ns is not None
    axes = (np.interp(stamp_ns, stream.truth_ns, stream.truth[:, k]) for k in (0, 1))
    return np.array(list(axes))


def _held(
    times: NDArray[np.float64], said: list[Any], column: int, before: float = np.nan
) -> NDArray[np.float64]:
    stamps = [each[0] for each in said]
    at = np.searchsorted(stamps, times, side="right") - 1
    values = np.array([each[column] for each in said] or [before])
    return np.where(at >= 0, values[np.maximum(at, 0)], before)


def drawn(found: dict[str, Rows], path: Path) -> None:
    figure, axes = plt.subplots(3, 1, figsize=(8.0, 8.5), sharex=True)
    rows = (("pose_m", "error of a robot's\nposition [m], RMS"),
            ("map_m", "error of its map's\nlandmarks [m], RMS"),
            ("landmarks", "landmarks in its map,\nmean"))  # fmt: skip
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(found)))
    for axis, (name, label) in zip(axes, rows, strict=True):
        for (reach, figures), colour in zip(found.items(), colours, strict=True):
            axis.plot(figures["time_s"], figures[name], label=reach, color=colour)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    axes[0].legend(title="reach of the radio", ncols=len(found), fontsize=8, title_fontsize=8)
    axes[-1].set_xlabel("team time [s]")
    axes[0].set_title("What communication buys: ten robots without a centre (random-10)")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--json", type=Path, help="kept, and taken up where it is there")
    parser.add_argument("--ranges", nargs="*", default=["5", "10", "20", "40", "everyone"])
    options = parser.parse_args()
    there = options.json is not None and options.json.exists()
    found: dict[str, Rows] = json.loads(options.json.read_text()) if there else {}
    sys.stdout.write("| reach | position [m] | its map [m] | landmarks | all agree at [s] |\n")
    for text in options.ranges:
        range_m = None if text == "everyone" else float(text)
        name = "everyone" if range_m is None else f"{range_m:g} m"
        found[name] = rows = measured(range_m, options.steps)
        means = [float(np.nanmean(rows[key])) for key in ("pose_m", "map_m", "landmarks")]
        row = f"| {name} | {means[0]:.2f} | {means[1]:.2f} | {means[2]:.1f} |"
        sys.stdout.write(f"{row} {rows['complete_s'][0]:.0f} |\n")
        sys.stdout.flush()
    if options.json is not None:
        options.json.write_text(json.dumps(found) + "\n")
    if options.picture is not None:
        drawn(found, options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
