from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from teamslam.central.monitor import Misscale, find_misscaled, monitor_figures
from teamslam.team.estimation.consistency import covariance_scale
from teamslam.team.estimation.map_joining import marginals
from teamslam.team.estimation.map_joining.joining import JoinSettings, solve_fold
from tests.estimation.sighting_world import joined_with
from tests.estimation.submap_world import team

SETTINGS = JoinSettings()


class Watched(NamedTuple):
    figures: dict[str, float]
    misscaled: tuple[Misscale, ...]


def watched(seed, claim=None, *, final=True):
    world = team(seed, robots=3, submaps=30, landmarks=8)
    submaps = [claim(s) if claim else s for s in world.submaps]
    fold = joined_with(submaps, world.starts, (), SETTINGS, len(submaps))
    solved = solve_fold(fold, SETTINGS)
    agreement = marginals.joint_cost(solved)
    if final:
        agreement = marginals.with_unbounded_costs(agreement, solved)
    misscaled = find_misscaled(agreement.submaps, 1.0, final=final)
    return Watched(monitor_figures(agreement, (), 1.0), misscaled)


def with_covariance_times(factor, of):
    def claim(contribution):
        local = contribution.local
        larger = replace(local, covariance=factor * local.covariance)
        return replace(contribution, local=larger) if of(contribution) else contribution

    return claim


def with_landmarks_moved(offset, of):
    def claim(contribution):
        mean = contribution.local.mean.copy()
        mean[3:] += offset
        moved = replace(contribution, local=replace(contribution.local, mean=mean))
        return moved if of(contribution) else contribution

    return claim


def test_a_team_with_true_covariances_is_near_one_and_warned_of_in_no_seed_of_ten():
    for seed in range(10):
        found = watched(seed)
        assert 0.8 < found.figures["joint_cost_per_dof"] < 1.2
        assert found.misscaled == ()


def test_a_robot_that_halves_its_sigmas_is_named_in_every_seed_of_ten():
    overconfident = with_covariance_times(0.25, lambda c: c.robot == "r1")
    for seed in range(10):
        found = watched(seed, overconfident)
        assert [each.robot for each in found.misscaled] == ["r1"]
        assert found.figures["joint_cost_per_dof.r1"] > 2.0 > found.figures["joint_cost_per_dof.r2"]


def test_a_factor_of_two_in_all_covariances_is_told_and_none_is_not():
    """25 bounds the factors that the bounded cost treats as nearly right."""
    for seed in range(4):
        for factor in (1.0, 0.5, 2.0):
            found = watched(seed, with_covariance_times(factor, lambda _: True))
            assert found.figures["covariance_scale"] == pytest.approx(1.0 / factor, rel=0.25)
            assert [each.robot for each in found.misscaled] == ([] if factor == 1.0 else [""])


def test_covariances_that_are_too_large_are_reported_of_the_final_map_only():
    for factor, told in ((0.5, 1), (2.0, 0)):
        found = watched(0, with_covariance_times(factor, lambda _: True), final=False)
        assert len(found.misscaled) == told
        assert "covariance_scale" in found.figures


def test_outliers_of_a_minority_do_not_move_the_covariance_scale():
    shifted = with_landmarks_moved(10.0, lambda c: c.sequence % 5 == 0)
    clean, spoilt = watched(3), watched(3, shifted)
    of = "covariance_scale"
    assert spoilt.figures[of] == pytest.approx(clean.figures[of], rel=0.35)
    assert not spoilt.misscaled


@pytest.mark.parametrize(("dof", "scale"), [(1.0, 3.0), (2.5, 0.1), (8.0, 1.0), (40.0, 25.0)])
def test_the_covariance_scale_of_drawn_terms_is_theirs(dof, scale):
    rng = np.random.default_rng(0)
    draws = scale * rng.chisquare(dof, (400, 60))
    found = [covariance_scale(terms, np.full(60, dof)) for terms in draws]
    logs = np.log([each.value for each in found])
    assert np.mean(logs) == pytest.approx(np.log(scale), abs=0.04)
    assert 0.7 < np.std(logs) / found[0].log_sigma < 1.3
