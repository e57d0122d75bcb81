"""Maps with 30 % outliers beside maps of the same inliers.

An outlier has a uniform range and bearing, or another identity.
"""

import msgspec

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.studies.experiments.experiment import (
    Goal,
    Options,
    Outcome,
    Results,
    Task,
    seed_count,
)
from teamslam.sim.studies.experiments.team_runs import (
    Figures,
    Shown,
    over_seeds,
    table_of,
    team_task,
    with_world,
)
from teamslam.sim.world.config import OutlierKind

WORLDS = ("thesis", "thesis-b")
SHARE = 0.3
LANDMARK_SUBMAPS = 2  # least number of submaps of a landmark
KINDS: tuple[OutlierKind, ...] = ("drop", "measurement", "identity")
NAMES = {"drop": "clean", "measurement": "random measurements", "identity": "random identities"}
MOST_SEEDS = 30
MOST_RATIO = 1.2
SHOWN: Shown = (
    ("rmse_aligned", "aligned [m]", "{:.3f}"),
    ("ratio_clean", "÷ clean", "{:.2f}"),
    ("rmse", "RMSE [m]", "{:.3f}"),
    ("nees", "NEES/dof", "{:.3g}"),
    ("in_band", "in band", "{:.0%}"),
    ("not_joined", "not joined", "{:.0f}"),
    ("withdrawn", "withdrawn", "{:.0f}"),
)


def outcome(options: Options, results: Results) -> Outcome:
    """Figures by kind of outlier."""
    figures: dict[str, dict[str, Figures]] = {}
    goals = []
    for world in WORLDS:
        of_world = {}
        for kind in KINDS:
            runs = results.of_all(_tasks(world, kind, options))
            of_kind = over_seeds(runs)
            for name in ("not_joined", "withdrawn"):
                of_kind[name] = sum(bool(run[name]) for run in runs)
            of_world[NAMES[kind]] = of_kind
        clean = of_world[NAMES["drop"]].get("rmse_aligned")
        for kind in KINDS[1:]:
            of_kind = of_world[NAMES[kind]]
            aligned = of_kind.get("rmse_aligned")
            of_kind["ratio_clean"] = aligned / clean if aligned and clean else None
            name = f"{world}, 30 % {NAMES[kind]}: ratio_clean"
            goals.append(Goal(name, of_kind["ratio_clean"], 0.0, MOST_RATIO))
            withdrawn = float(of_kind["withdrawn"]) if of_kind["seeds"] else None
            goals.append(Goal(f"{world}, 30 % {NAMES[kind]}: withdrawn", withdrawn, 0.0, 0.0))
        figures[world] = of_world
    rows = {f"{w}, {kind}": row for w, of in figures.items() for kind, row in of.items()}
    table = table_of(
        f"30 % outliers, {seed_count(len(options.seeds[:MOST_SEEDS]))}",
        "world",
        rows,
        SHOWN,
        "not joined, withdrawn: runs in which a robot, all of them good, is not in the final map",
    )
    return Outcome("outliers", {"outliers": figures}, (table,), goals=tuple(goals))


def _tasks(world: str, kind: OutlierKind, options: Options) -> list[Task]:
    return [
        team_task(_add_outliers(with_options(load(world), seed=seed), kind), note=NAMES[kind])
        for seed in options.seeds[:MOST_SEEDS]
    ]


def _add_outliers(scenario: Scenario, kind: OutlierKind) -> Scenario:
    central = msgspec.structs.replace(scenario.central, landmark_submaps=LANDMARK_SUBMAPS)
    spoilt = with_world(scenario, outlier_share=SHARE, outlier_kind=kind)
    return msgspec.structs.replace(spoilt, central=central)
