"""Sweeping weighs a group's landmarks together: one pair of them that fits turns no robot."""

import numpy as np
import pytest

from team.config import UNNAMED
from team.estimation.map_joining.associating import IslandView
from team.estimation.map_joining.auditing import fold_tick
from team.estimation.map_joining.joining import EMPTY_FOLD, Contribution, JoinSettings, Tick
from team.estimation.submap import LocalMap, Unnamed

KNOWN = np.array([[0.0, 0.0], [0.0, 0.3], [0.0, 0.52]])
"""Three landmarks of the map; a robot sees the first two again."""
AWAY = np.array([20.0, 0.0])
LOCAL_SD, SHIFT_SD = 0.01, 0.06


def view_of_a_group_shifted_by(shift: float) -> IslandView:
    """A map of three landmarks and a group of two, whose place has a common error."""
    places = np.concatenate([KNOWN, KNOWN[:2] + AWAY])
    count = len(places)
    local = LocalMap(
        (UNNAMED + np.arange(count)).astype(np.uint32),
        np.concatenate([np.zeros(3), places.ravel()]),
        np.diag(np.full(3 + 2 * count, LOCAL_SD**2)),
        unnamed=Unnamed(np.full(count, 5, np.uint32), np.zeros((count, 0), np.bool_)),
    )
    fold = fold_tick(EMPTY_FOLD, Tick([Contribution("r1", 1, 0, 10**10, local)]), JoinSettings())
    view = IslandView(fold.main, fold.landmarks)
    order = np.argsort(view.joint.mean[:, 0] * 10.0 + view.joint.mean[:, 1])
    mean = view.joint.mean.copy()
    mean[order[3:]] += [0.0, shift] - AWAY
    covariance = LOCAL_SD**2 * np.eye(2 * count)
    group = np.array([2 * k + axis for k in order[3:].tolist() for axis in (0, 1)])
    covariance[np.ix_(group, group)] += SHIFT_SD**2 * np.kron(np.ones((2, 2)), np.eye(2))
    view.joint = view.joint._replace(
        mean=mean,
        covariance=covariance,
        apart=np.zeros((count, count), np.bool_),
        apart_in_window=None,
        crowd=None,
    )
    return view


@pytest.mark.parametrize(("shift", "merged"), [(0.0, 2), (0.22, 0)])
def test_a_group_that_fits_at_two_places_waits(shift: float, merged: int) -> None:
    view = view_of_a_group_shifted_by(shift)
    view.sweep()
    assert len(view.ties) == merged
