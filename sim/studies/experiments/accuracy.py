"""Accuracy and consistency of the team in every kind of world."""

from teamslam.sim.studies.experiments import (
    accuracy_few,
    accuracy_outliers,
    accuracy_starts,
    accuracy_utias,
    accuracy_worlds,
)
from teamslam.sim.studies.experiments.experiment import (
    Experiment,
    Options,
    Outcome,
    Results,
    combine_outcomes,
)

PARTS: tuple[Experiment, ...] = (
    accuracy_worlds,
    accuracy_starts,
    accuracy_few,
    accuracy_outliers,
    accuracy_utias,
)

ENOUGH_SEEDS = 30
_CHANCE = (
    "With so few seeds a mean NEES or a share of runs scatters by more than its goal allows: what "
    "is missed here may be missed by chance. `teamslam experiment accuracy` has 50."
)


def outcome(options: Options, results: Results) -> Outcome:
    """Figures, tables and goals of all parts."""
    parts = [part.outcome(options, results) for part in PARTS]
    few = len(options.seeds) < ENOUGH_SEEDS
    title = "accuracy and consistency of the fused map"
    return combine_outcomes(title, [Outcome(title, {}, remarks=(_CHANCE,) if few else ()), *parts])
