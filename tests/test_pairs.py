"""A row of the table of estimators or of rules is all that a method needs beside its file."""

from typing import get_args

import pytest

from teamslam.team.config import Estimator, FusionRule
from teamslam.team.pairs import ESTIMATORS, PAIRS, RULES
from teamslam.team.registry import is_installed


def test_the_names_of_the_rows_are_what_a_user_may_write() -> None:
    assert get_args(Estimator) == tuple(ESTIMATORS)
    assert get_args(FusionRule) == tuple(RULES)


@pytest.mark.parametrize("row", [*ESTIMATORS.values(), *RULES.values()], ids=str)
def test_what_a_row_names_is_there(row) -> None:
    assert is_installed(row.made_by)


def test_each_method_is_in_a_pair_and_pairs_name_rows_only() -> None:
    assert {estimator for estimator, _ in PAIRS} == set(ESTIMATORS)
    assert {rule for _, rule in PAIRS} == set(RULES)
    named = {e for row in RULES.values() for e in row.takes}
    fed = {rule for row in ESTIMATORS.values() for rule in row.feeds}
    assert named <= set(ESTIMATORS)
    assert fed <= set(RULES)
