"""How right the robots' running poses in the team's map are, over many runs in memory.

    python -m tests.trials.online_poses [SCENARIO …] [--seeds FIRST-LAST] [--json FILE]

For each scenario: the mean NEES per degree of freedom of the online poses, median and worst RMSE
of a robot in a run beside that of the bound (`online_bound.py`), and silent robots: more than a
window of poses in a row with a NEES of probability below 10⁻⁹, without a warning. Stored seeds are
not run again; seeds 5000 to 5999 are for headline figures (decision 21). Exit status 1 if a goal of
GOALS is missed.
"""

import argparse
import json
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import opened
from tests.trials.online_bound import FAR, bounds, longest_s

SCENARIOS = ("thesis", "thesis-b")
GOALS = {"nees_per_dof": 1.15, "worst_over_median": 3.0, "over_bound": 1.25, "silent": 0.0}


def run(scenario_name: str, seed: int) -> list[dict[str, Any]]:
    scenario = with_options(load(scenario_name), seed=seed)
    window_ns = round(max(r.front_end.window_s for r in scenario.robots) * 1e9)
    nodes: dict[str, RobotNode] = {}

    def robot(config: RobotConfig, exchange: Exchange) -> RobotNode:
        nodes[config.id] = RobotNode(config, exchange)
        return nodes[config.id]

    samples, warned = [], dict[tuple[str, int], bool]()
    streams = streams_of(scenario)
    bound = bounds(scenario, streams)
    for sample in run_team(scenario, streams, robot):
        samples.append(sample)
        found = ch.channel_of(sample.key)
        if found is not None and found[0] is ch.TEAM_POSE:
            _, name, message = opened(sample)
            assert isinstance(message, m.PoseEstimate)
            # The node publishes in bursts; the warnings hold at the end of each.
            warned[name, message.stamp_ns] = bool(nodes[name].status().warnings)
    found = []
    for name, judged in evaluate(samples).robots.items():
        online = judged.online
        if online is None:
            continue
        stamps = online.stamps_ns
        heard = np.array([warned.get((name, stamp), False) for stamp in stamps.tolist()])
        silent_s = longest_s(stamps, (online.nees > FAR) & ~heard)
        by_chance_s = longest_s(bound[name].stamps_ns, bound[name].nees_on_arcs() > FAR)
        found.append(
            {
                "seed": seed,
                "robot": name,
                "nees_per_dof": online.nees_per_dof,
                "rmse_m": online.position_rmse_m,
                "sigma_m": float(np.sqrt(np.mean(np.sum(online.sigmas[:, :2] ** 2, axis=1)))),
                "bound_rmse_m": bound[name].rmse_m(online.stamps_ns),
                "bound_sigma_m": bound[name].sigma_m(online.stamps_ns),
                "bound_nees_per_dof": bound[name].nees_per_dof(online.stamps_ns),
                "silent_s": silent_s,
                "silent": silent_s * 1e9 > window_ns,
                "bound_silent": by_chance_s * 1e9 > window_ns,
            }
        )
    return found


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Figures over all runs and robots. over_bound: RMSE over the bound's."""
    errors, bound = (np.array([row[name] for row in rows]) for name in ("rmse_m", "bound_rmse_m"))
    return {
        "seeds": float(len({row["seed"] for row in rows})),
        "nees_per_dof": fmean(row["nees_per_dof"] for row in rows),
        "bound_nees_per_dof": fmean(row["bound_nees_per_dof"] for row in rows),
        "worst_nees_per_dof": max(row["nees_per_dof"] for row in rows),
        "median_rmse_m": float(np.median(errors)),
        "worst_rmse_m": float(errors.max()),
        "worst_over_median": float(errors.max() / np.median(errors)),
        "bound_worst_over_median": float(bound.max() / np.median(bound)),
        "over_bound": float(np.sqrt(np.sum(errors**2) / np.sum(bound**2))),
        "median_over_bound": float(np.median(errors / bound)),
        "worst_over_bound": float((errors / bound).max()),
        "silent": float(sum(row["silent"] for row in rows)),
        "bound_silent": float(sum(row["bound_silent"] for row in rows)),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--seeds", default="1000-1019", help="FIRST-LAST, both in it")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    first, _, last = told.seeds.partition("-")
    missed, results = False, dict[str, Any]()
    if told.json and told.json.exists():
        results = json.loads(told.json.read_text())
    for name in told.scenarios:
        rows = results.get(name, {"runs": []})["runs"]
        figures = summary(rows) if rows else {}
        done = {row["seed"] for row in rows}
        for seed in sorted({*range(int(first), int(last or first) + 1)} - done):
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
