"""A row of the table of estimators or of rules is all that a method needs beside its file."""

from typing import get_args

import pytest

from team.config import Estimator, FusionRule
from team.pairs import ESTIMATORS, PAIRS, RULES
from team.registry import is_installed
from team.sources import sources_of


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


def test_no_kernel_hangs_on_the_methods_that_the_table_names() -> None:
    """Else every edit of an estimator would compile every kernel anew."""
    kernel = "team.estimation.hybrid_slam.consensus_kernel"
    reached = sources_of(kernel, ("team",), places=False)
    assert "team.estimation.models" in reached
    assert not any(name.startswith(("team.robot", "team.wire")) for name in reached)
