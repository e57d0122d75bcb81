"""How right the robots' running poses in the team's map are, over many runs in memory.

    python benchmarks/online_poses.py [SCENARIO …] [--seeds FIRST-LAST] [--json FILE]

For each scenario: the mean NEES per degree of freedom of the online poses (1 is right), the median
and the worst RMSE of a robot, and who is silent: more than a window of poses in a row with a NEES
beyond once in 10⁹ while the robot warns of nothing. Seeds 5000 to 5999 are for headline figures
(decision 0031): tune with others. Exit status 1 if a goal of GOALS is missed.
"""

import argparse
import json
import sys
from itertools import groupby
from pathlib import Path
from statistics import fmean, median
from typing import Any

from scipy.stats import chi2

from central.desk.evaluation.evaluation import evaluate
from sim.in_memory.team import run_team
from sim.scenarios.scenario import load, with_options
from sim.scenarios.source import streams_of
from team.config import Exchange, RobotConfig
from team.robot.node import RobotNode
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import opened

SCENARIOS = ("thesis", "thesis-b")
FAR = float(chi2.isf(1e-9, 3))
"""NEES of a pose that lies far outside its own covariance."""
GOALS = {"nees_per_dof": 1.15, "worst_over_median": 3.0, "silent": 0.0}


def run(scenario_name: str, seed: int) -> list[dict[str, Any]]:
    """One run: of each robot its figures and the longest time that it was far off and silent."""
    scenario = with_options(load(scenario_name), seed=seed)
    window_ns = round(max(r.front_end.window_s for r in scenario.robots) * 1e9)
    nodes: dict[str, RobotNode] = {}

    def robot(config: RobotConfig, exchange: Exchange) -> RobotNode:
        nodes[config.id] = RobotNode(config, exchange)
        return nodes[config.id]

    samples, warned = [], dict[tuple[str, int], bool]()
    for sample in run_team(scenario, streams_of(scenario), robot):
        samples.append(sample)
        channel, name, message = opened(sample)
        if channel is ch.TEAM_POSE and isinstance(message, m.PoseEstimate):
            # The node speaks in bunches: of each bunch the warnings are those at its end.
            warned[name, message.stamp_ns] = bool(nodes[name].status().warnings)
    found = []
    for name, judged in evaluate(samples).robots.items():
        online = judged.online
        if online is None:
            continue
        silent_s = 0.0
        poses = [
            (stamp, far and not warned.get((name, stamp), False))
            for stamp, far in zip(online.stamps_ns.tolist(), online.nees > FAR, strict=True)
        ]
        for is_silent, group in groupby(poses, lambda pose: bool(pose[1])):
            stamps = [stamp for stamp, _ in group]
            if is_silent:
                silent_s = max(silent_s, (stamps[-1] - stamps[0]) * 1e-9)
        found.append(
            {
                "seed": seed,
                "robot": name,
                "nees_per_dof": online.nees_per_dof,
                "rmse_m": online.position_rmse_m,
                "silent_s": silent_s,
                "silent": silent_s * 1e9 > window_ns,
            }
        )
    return found


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Over all runs and robots."""
    errors = [row["rmse_m"] for row in rows]
    return {
        "seeds": float(len({row["seed"] for row in rows})),
        "nees_per_dof": fmean(row["nees_per_dof"] for row in rows),
        "worst_nees_per_dof": max(row["nees_per_dof"] for row in rows),
        "median_rmse_m": median(errors),
        "worst_rmse_m": max(errors),
        "worst_over_median": max(errors) / median(errors),
        "silent": float(sum(row["silent"] for row in rows)),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--seeds", default="1000-1019", help="FIRST-LAST, both in it")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    first, _, last = told.seeds.partition("-")
    missed, results = False, {}
    for name in told.scenarios:
        rows = []
        for seed in range(int(first), int(last or first) + 1):
            rows += run(name, seed)
            figures = summary(rows)
            results[name] = {"summary": figures, "runs": rows}
            if told.json:
                told.json.write_text(json.dumps(results, indent=1) + "\n")
        print(f"{name}, seeds {told.seeds}")
        for key, value in figures.items():
            goal = GOALS.get(key)
            print(f"  {key:20} {value:9.3f}{'' if goal is None else f'   goal: at most {goal:g}'}")
            missed |= goal is not None and value > goal
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
