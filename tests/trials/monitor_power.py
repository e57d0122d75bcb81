"""Power of the consistency monitor against a factor of two, profile by profile.

    python -m tests.trials.monitor_power [--seeds FIRST-LAST] [--dataset ZIP …] [--profiles NAME …]

A team runs in memory; its final map is solved again with all submaps' covariances as they are, and
as a team would have them that claims half and twice: the monitor is to be silent of the first and
to tell of both others. Profiles: the built-in worlds with plain squares; `thesis-b` with one
measurement in ten an outlier, under a robust loss; the UTIAS profile on each data set that is given
(a minute and more of a processor). Exit status 1 if one is not as it should be.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import msgspec

from teamslam.central.monitor import Finding, finding
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments.true_minimum import final_fold
from teamslam.team.estimation.map_joining.gauss_newton import solve_island
from teamslam.team.estimation.map_joining.joining import Fold
from teamslam.team.estimation.map_joining.marginals import joint_cost

SIMULATED = ("thesis", "thesis-b", "waypoints", "random-3")
ROBUST = "robust"
OUTLIERS = 0.1
CLAIMED = (1.0, 0.5, 2.0)
"""Factors of all covariances; all but 1 are to be reported of the team."""


def robust() -> Scenario:
    """`thesis-b` with outliers."""
    scenario = load("thesis-b")
    world = msgspec.structs.replace(scenario.world, outlier_share=OUTLIERS)
    central = msgspec.structs.replace(scenario.central, landmark_submaps=2)
    return msgspec.structs.replace(scenario, world=world, central=central)


def found_at(fold: Fold, claimed: float, normal: float) -> Finding:
    """Finding of the monitor for the map with all covariances times `claimed`."""
    key = fold.main_key
    settings = replace(
        fold.main.settings, covariance_factor=claimed * fold.main.settings.covariance_factor
    )
    island, _, _ = solve_island(replace(fold.main, settings=settings))
    return finding(joint_cost(replace(fold, islands={**fold.islands, key: island})), normal)


def seen(name: str, scenario: Scenario) -> bool:
    """Print one run's line; whether the monitor said what it owes."""
    fold = final_fold(run_team(scenario, streams_of(scenario)))
    line, right = [], True
    for claimed in CLAIMED:
        found = found_at(fold, claimed, scenario.central.normal_scale)
        right &= [each.robot for each in found.misscaled] == ([] if claimed == 1.0 else [""])
        line.append(f"{found.figures['covariance_scale']:.2f}")
    figures = ", ".join(
        f"claimed {claimed:g}: {scale}" for claimed, scale in zip(CLAIMED, line, strict=True)
    )
    print(f"{name:24} {figures}  {'seen' if right else 'NOT SEEN'}", flush=True)
    return right


def main() -> int:
    """One line for each run."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profiles", nargs="*", default=[*SIMULATED, ROBUST])
    parser.add_argument("--seeds", default="1000-1001", help="FIRST-LAST, both in it")
    parser.add_argument("--dataset", nargs="*", type=Path, default=[])
    asked = parser.parse_args()
    first, _, last = asked.seeds.partition("-")
    right = True
    for name in asked.profiles:
        scenario = robust() if name == ROBUST else load(name)
        for seed in range(int(first), int(last or first) + 1):
            right &= seen(f"{name} {seed}", with_options(scenario, seed=seed))
    for path in asked.dataset:
        right &= seen(path.name, with_options(load("utias"), dataset=path))
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
