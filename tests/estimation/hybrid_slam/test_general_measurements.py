"""Submaps of all forms of measurements are consistent; `tests/trials/general_measurements.py` has
the tight bounds over hundreds of runs, these are a few seeds of it.
"""

import pytest

from tests.trials.general_measurements import CASES, mean_nees

SEEDS = 8
LOUD = {
    "increments": "less lateral",
    "points": "turned by a right angle",
    "mount": "another mount",
    "car": "no shares",
}


@pytest.mark.parametrize("name", CASES)
def test_submaps_are_consistent_whatever_their_measurements_are(name: str) -> None:
    value, low, high = mean_nees(CASES[name], SEEDS)
    assert low <= value <= high


@pytest.mark.parametrize(("name", "mutant"), LOUD.items())
def test_what_is_told_wrongly_is_seen_in_them(name: str, mutant: str) -> None:
    value, _, high = mean_nees(CASES[name], SEEDS, mutant)
    assert value > high
