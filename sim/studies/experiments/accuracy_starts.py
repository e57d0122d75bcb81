"""Unknown initial poses: all robots but the first must be placed.

A merge is wrong if a first pose lies outside its own 99.9 % ellipsoid.
"""

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.studies.experiments.experiment import Goal, Options, Outcome, Results, Task
from teamslam.sim.studies.experiments.team_runs import (
    Figures,
    Shown,
    over_seeds,
    table_of,
    team_task,
    with_world,
)
from teamslam.team.estimation.consistency import chi2_limit

WORLDS = ("thesis", "thesis-b")
SHOWN: Shown = (
    ("rmse_aligned", "aligned [m]", "{:.3f}"),
    ("ratio_known", "÷ known", "{:.3f}"),
    ("rmse", "RMSE [m]", "{:.3f}"),
    ("nees", "NEES/dof", "{:.3g}"),
    ("shape_nees", "shape NEES", "{:.3g}"),
    ("joined", "joined", "{:.0%}"),
    ("wrong_merges", "wrong merges", "{:.0f}"),
)


def is_wrong(chi2: float) -> bool:
    """Whether χ² exceeds the 99.9 % quantile."""
    return chi2 > chi2_limit(3, 0.001)


def outcome(options: Options, results: Results) -> Outcome:
    """Maps with and without known initial poses."""
    figures: dict[str, dict[str, Figures]] = {}
    rows: dict[str, Figures] = {}
    goals = []
    for world in WORLDS:
        pairs = [
            (before, after)
            for pair in _pairs(world, options)
            for before, after in ((results.of(task) for task in pair),)
            if before and after
        ]
        known = over_seeds([before for before, _ in pairs])
        unknown = over_seeds([after for _, after in pairs]) | _merges([after for _, after in pairs])
        if pairs and known["rmse_aligned"] and unknown["rmse_aligned"]:
            unknown["ratio_known"] = unknown["rmse_aligned"] / known["rmse_aligned"]
        figures[world] = {"known": known, "unknown": unknown}
        rows |= {f"{world}, {name}": of_runs for name, of_runs in figures[world].items()}
        goals += [
            Goal(f"{world}, unknown starts: ratio_known", unknown.get("ratio_known"), 0.0, 1.05),
            Goal(f"{world}, unknown starts: wrong_merges", unknown.get("wrong_merges"), 0.0, 0.0),
        ]
    table = table_of(
        f"unknown start poses, {options.seed_count}",
        "starts",
        rows,
        SHOWN,
        "ratio: of the aligned maps, to the same seeds with known starts",
    )
    return Outcome("unknown starts", {"starts": figures}, (table,), goals=tuple(goals))


def _pairs(world: str, options: Options) -> list[tuple[Task, Task]]:
    found = []
    for seed in options.seeds:
        scenario = with_options(load(world), seed=seed)
        found.append(
            (
                team_task(scenario, batch=True),
                team_task(unknown_starts(scenario), note="unknown starts"),
            )
        )
    return found


def unknown_starts(scenario: Scenario) -> Scenario:
    """Keep the first robot's initial pose only."""
    return with_world(scenario, unknown_starts=tuple(robot.id for robot in scenario.robots[1:]))


def _merges(runs: list[Figures]) -> Figures:
    chi2 = [
        figures["first_pose_chi2"]
        for run in runs
        for name, figures in run["robots"].items()
        if name != min(run["robots"])
    ]
    if not chi2:
        return {}
    joined = [value for value in chi2 if value is not None]
    return {
        "joined": len(joined) / len(chi2),
        "wrong_merges": sum(map(is_wrong, joined)),
    }
