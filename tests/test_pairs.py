import subprocess
import sys
from typing import get_args

import pytest

from teamslam.team.config import Estimator, FusionRule
from teamslam.team.pairs import ESTIMATORS, PAIRS, RULES
from teamslam.team.registry import is_installed
from tests.support import ROOT


def test_the_names_of_the_rows_are_what_a_user_may_write():
    assert get_args(Estimator) == tuple(ESTIMATORS)
    assert get_args(FusionRule) == tuple(RULES)


@pytest.mark.parametrize("row", [*ESTIMATORS.values(), *RULES.values()], ids=str)
def test_what_a_row_names_is_there(row):
    assert is_installed(row.made_by)


def test_each_method_is_in_a_pair_and_pairs_name_rows_only():
    assert {estimator for estimator, _ in PAIRS} == set(ESTIMATORS)
    assert {rule for _, rule in PAIRS} == set(RULES)
    named = {e for row in RULES.values() for e in row.takes}
    fed = {rule for row in ESTIMATORS.values() for rule in row.feeds}
    assert named <= set(ESTIMATORS)
    assert fed <= set(RULES)


def test_a_rule_and_an_estimator_are_a_file_and_a_row_each_and_their_runs_verify(tmp_path):
    command = [sys.executable, "-m", "tests.recipes.walk", str(tmp_path)]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300.0)
    assert said.returncode == 0, said.stderr[-2000:]
    first, second = said.stdout.splitlines()
    assert first.startswith("first-submaps"), first
    assert "'submap'" in first
    assert "'final_map': (1, 1)" in first
    assert second.startswith("alone 0 True"), second
    assert "'own_pose'" in second
