"""Worlds with few landmarks and unknown initial poses, where wrong minima occur.

A map is wrong in another minimum than the truth's (`true_minimum`), silent without a warning, and
beyond its ellipsoid if its shape or a first pose is outside the 99.9 % region. An alarm is a
warning of a right map about more than a large or nonlinear covariance.
"""

from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.studies.experiments.accuracy_starts import is_wrong, unknown_starts
from teamslam.sim.studies.experiments.experiment import Goal, Options, Outcome, Results, Task
from teamslam.sim.studies.experiments.team_runs import (
    Figures,
    Shown,
    middle,
    over_seeds,
    table_of,
    team_task,
    with_robots,
    with_world,
)
from teamslam.team.estimation.consistency import chi2_interval

WORLDS = ("thesis", "thesis-b")
COUNTS = (3, 4, 5)
SEEN_EVERY_S = 5.0  # spacing [s] of the pose nodes for inter-robot measurements
WIDE = ("is placed weakly", "farther off than its covariance")
"""Parts of warnings about covariances, not minima."""
SHOWN: Shown = (
    ("rmse_aligned", "aligned [m]", "{:.3f}"),
    ("aligned_median", "median [m]", "{:.3f}"),
    ("shape_nees", "shape NEES", "{:.3g}"),
    ("joined", "joined", "{:.0%}"),
    ("warned", "warned", "{:.0f}"),
    ("wrong", "wrong", "{:.0f}"),
    ("silent", "silent", "{:.0f}"),
    ("excluded", "excluded", "{:.0f}"),
    ("beyond", "beyond", "{:.0f}"),
    ("beyond_silent", "unwarned", "{:.0f}"),
    ("alarms", "alarms", "{:.0f}"),
)


def outcome(options: Options, results: Results) -> Outcome:
    """Frequency of wrong maps, warned and silent."""
    figures: dict[str, Figures] = {}
    for name, case in _cases(options).items():
        figures[name] = _few_figures(results.of_all(case))
    judged = [of_case for of_case in figures.values() if "silent" in of_case]
    runs = sum(of_case["seeds"] for of_case in judged)
    table = table_of(
        f"few landmarks, one start known, {options.seed_count}",
        "world, landmarks",
        figures,
        SHOWN,
        "warned: maps with a warning; wrong: in another minimum than the truth; silent: wrong, and "
        "without a warning; excluded: the submaps exclude the truth (1 in 1000 by chance); beyond: "
        "the truth is outside the map's own 99.9 % ellipsoid, unwarned: and no warning; alarms: "
        "maps that are none of these, with a warning of more than a weakly placed robot or a "
        "nonlinear covariance",
    )
    goals = [
        Goal(
            f"few landmarks: {name}",
            float(sum(of_case[name] for of_case in judged)) if judged else None,
            0.0,
            most,
        )
        for name, most in (("silent", 0.0), ("excluded", float(max(1, round(0.01 * runs)))))
    ]
    return Outcome("few landmarks", {"few": figures}, (table,), goals=tuple(goals))


def _few_figures(runs: list[Figures]) -> Figures:
    figures = over_seeds(runs)
    if not runs:
        return figures
    minima = [run["minimum"] for run in runs]
    warned = [bool(run["reasons"]) for run in runs]
    wrong = [of_run["wrong"] for of_run in minima]
    excluded = [of_run["excluded"] for of_run in minima]
    beyond = [_is_beyond(run) for run in runs]
    bad = [any(each) for each in zip(wrong, excluded, beyond, strict=True)]
    alarmed = [
        any(not any(words in text for words in WIDE) for text in run["reasons"]) for run in runs
    ]
    return figures | {
        "aligned_median": middle(run["rmse_aligned"] for run in runs),
        "joined": sum(not run["not_joined"] for run in runs) / len(runs),
        "warned": sum(warned),
        "wrong": sum(wrong),
        "silent": _count_without(wrong, warned),
        "excluded": sum(excluded),
        "beyond": sum(beyond),
        "beyond_silent": _count_without(beyond, warned),
        "alarms": _count_without(alarmed, bad),
    }


def _count_without(marks: list[bool], others: list[bool]) -> int:
    return sum(mark and not other for mark, other in zip(marks, others, strict=True))


def _is_beyond(run: Figures) -> bool:
    """Whether shape or a first pose is outside its 99.9 % ellipsoid."""
    dof = 2 * round(run["landmarks"] or 0.0) - 3
    shape = run["shape_nees"]
    if shape is not None and dof > 0 and 0.5 * shape > chi2_interval(dof, 0.998, 1)[1]:
        return True
    robots = run["robots"]
    first = [each["first_pose_chi2"] for name, each in robots.items() if name != min(robots)]
    return any(chi2 is not None and is_wrong(chi2) for chi2 in first)


def _cases(options: Options) -> dict[str, list[Task]]:
    return {
        f"{world}, {count}, {'sightings' if seen else 'none seen'}": [
            team_task(
                _few(with_options(load(world), seed=seed), count, seen),
                minimum=True,
                note=f"{count} landmarks, one start known{', sightings' if seen else ''}",
            )
            for seed in options.seeds
        ]
        for world in WORLDS
        for count in COUNTS
        for seen in (False, True)
    }


def _few(scenario: Scenario, count: int, seen: bool) -> Scenario:
    few = with_world(unknown_starts(scenario), landmarks=(), landmark_count=count)
    return with_robots(few, "front_end", node_s=SEEN_EVERY_S if seen else 0.0)
