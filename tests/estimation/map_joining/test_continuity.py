"""The evidence of a seam: which landmarks of one side are in the view of the other one."""

from unittest.mock import Mock

import numpy as np
import pytest

from teamslam.team.estimation.map_joining import continuity
from teamslam.team.estimation.map_joining.continuity import EVIDENCE
from teamslam.team.estimation.map_joining.gauss_newton import Island

ROUND = [0.0, 1.0, 2.0, 3.1, 4.2, 5.2]
"""Directions [rad] of landmarks that surround the robot."""
AHEAD = [-1.2, -0.8, -0.3, 0.2, 0.7, 1.2]
BESIDE = [2.0, 2.9]
"""Directions of the only two landmarks behind the place."""


@pytest.mark.parametrize(("before", "is_seam"), [(ROUND, True), (AHEAD, False)])
def test_few_landmarks_behind_a_place_do_not_narrow_the_view_of_a_sensor_that_looks_around(
    monkeypatch, before, is_seam
):
    directions = np.array([*before, *BESIDE])
    points = 6.0 * np.column_stack([np.cos(directions), np.sin(directions)])
    possible = np.zeros((len(before), len(BESIDE)), np.bool_)
    monkeypatch.setattr(continuity, "_mark_possible", lambda *_: (points, possible))
    one, two = np.arange(len(before)), np.arange(len(before), len(points))
    sides = continuity._Side(one, one), continuity._Side(two, two)
    evidence = continuity._compare_sides(Mock(spec=Island), *sides, np.zeros(2))
    assert (evidence >= EVIDENCE) == is_seam
