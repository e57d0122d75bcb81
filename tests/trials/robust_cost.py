"""Cost of the robust default on clean data: errors and NEES of the final map, in pairs.

    python -m tests.trials.robust_cost [--profiles NAME …] [--seeds FIRST-LAST] [--dataset ZIP …]

The team runs in memory with and without the windows' gate; its submaps are joined with parts of
the default left out:

    default   the robust loss, the shared errors as states, the gate
    squares   least squares in place of the loss
    no gate   and windows that accept every measurement
    no states and no shared errors

A line gives the ratio of the default's RMSE to each (geometric mean over the seeds, with standard
error; aligned for data sets) and the mean NEES per degree of freedom. Exit status 1 if the default
is more than 2 % worse than `no gate`, or its NEES is outside [0.95, 1.05], by two standard errors.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from teamslam.central.desk.evaluation.errors import map_errors
from teamslam.central.desk.evaluation.log import collect_log
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.experiments.downs_joined import final_maps_only
from teamslam.sim.studies.experiments.true_minimum import final_fold
from teamslam.sim.world.config import SimulatedWorld
from teamslam.team.estimation.hybrid_slam import pipeline
from teamslam.team.estimation.map_joining.marginals import landmark_map
from teamslam.team.wire.bus import Sample

PROFILES = ("thesis", "thesis-b", "random-5")
NO_OUTLIERS = 1e-300  # share of outliers with which a window accepts every measurement
MOST_RATIO = 1.02
NEES = (0.95, 1.05)


class Figures(NamedTuple):
    rmse_m: float
    nees: float


def log_of(scenario: Scenario) -> list[Sample]:
    of = final_maps_only(scenario)
    return list(run_team(of, streams_of(of)))


def joined(
    samples: Sequence[Sample], *, is_robust: bool, has_biases: bool, is_aligned: bool
) -> Figures:
    fold = final_fold(samples, is_robust=is_robust, has_biases=has_biases)
    ids, means, covariance = landmark_map(fold)
    truth = collect_log(samples).true_landmarks
    places = dict(zip(truth.ids.tolist(), truth.positions, strict=True))
    found = map_errors(means, covariance, np.array([places[each] for each in ids.tolist()]))
    rmse = found.aligned_rmse_m if is_aligned else found.rmse_m
    assert rmse is not None
    return Figures(rmse, found.nees_per_dof)


def variants(scenario: Scenario, *, is_aligned: bool) -> Iterator[tuple[str, Figures]]:
    of = partial(joined, is_aligned=is_aligned)
    samples = log_of(scenario)
    yield "default", of(samples, is_robust=True, has_biases=True)
    yield "squares", of(samples, is_robust=False, has_biases=True)
    with mock.patch.object(pipeline, "OUTLIER_SHARE", NO_OUTLIERS):
        samples = log_of(scenario)
    yield "no gate", of(samples, is_robust=False, has_biases=True)
    yield "no states", of(samples, is_robust=False, has_biases=False)


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def report(profile: str, found: Mapping[str, Sequence[Figures]]) -> bool:
    right = True
    for name, figures in found.items():
        pairs = zip(found["default"], figures, strict=True)
        ratio, error = mean_and_error([np.log(a.rmse_m / b.rmse_m) for a, b in pairs])
        nees, of_nees = mean_and_error([each.nees for each in figures])
        print(
            f"{profile:12} {name:10} RMSE {np.median([each.rmse_m for each in figures]):.4f} m, "
            f"default/this {np.exp(ratio):.4f} ± {error:.4f}, NEES {nees:.3f} ± {of_nees:.3f}",
            flush=True,
        )
        if name == "no gate":
            right &= ratio - 2.0 * error < np.log(MOST_RATIO)
        if name == "default":
            right &= NEES[0] - 2.0 * of_nees < nees < NEES[1] + 2.0 * of_nees
    return right


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profiles", nargs="*", default=[*PROFILES])
    parser.add_argument("--seeds", default="2000-2049", help="FIRST-LAST, both in it")
    parser.add_argument("--dataset", nargs="*", type=Path, default=[])
    given = parser.parse_args(arguments)
    first, _, last = given.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    runs = [(name, load(name)) for name in given.profiles]
    runs += [(path.stem[-12:], with_options(load("utias"), dataset=path)) for path in given.dataset]
    right = True
    for name, scenario in runs:
        found: dict[str, list[Figures]] = {}
        is_aligned = not isinstance(scenario.world, SimulatedWorld)
        for seed in seeds:
            of = with_options(scenario, seed=seed)
            for variant, figures in variants(of, is_aligned=is_aligned):
                found.setdefault(variant, []).append(figures)
        right &= report(name, found) or is_aligned
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
