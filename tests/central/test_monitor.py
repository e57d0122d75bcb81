"""The consistency monitor: quiet where covariances are true, and it names who claims too much."""

from dataclasses import replace

from central.monitor import finding
from team.estimation import marginals
from team.estimation.joining import (
    EMPTY_FOLD,
    Contribution,
    JoinSettings,
    converged,
    folded,
    started,
)
from tests.estimation.submap_world import team

SETTINGS = JoinSettings()


def watched(seed, claim=None):
    """The finding of a joined team; `claim` changes a contribution before it is joined."""
    world = team(seed, robots=3, submaps=30, landmarks=8)
    fold = EMPTY_FOLD
    for start in world.starts:
        fold = started(fold, start)
    submaps = [claim(s) if claim else s for s in world.submaps]
    return finding(marginals.joint_cost(converged(folded(fold, submaps, SETTINGS), SETTINGS)))


def with_covariance_times(factor, of):
    def claim(contribution):
        if not of(contribution):
            return contribution
        local = replace(contribution.local, covariance=factor * contribution.local.covariance)
        c = contribution
        return Contribution(c.robot, c.epoch, c.sequence, c.end_ns, local)

    return claim


def test_a_team_with_true_covariances_is_near_one_and_warned_of_in_no_seed_of_ten():
    for seed in range(10):
        found = watched(seed)
        assert 0.8 < found.figures["joint_cost_per_dof"] < 1.2
        assert found.warnings == ()


def test_a_robot_that_halves_its_sigmas_is_named_in_every_seed_of_ten():
    overconfident = with_covariance_times(0.25, lambda c: c.robot == "r1")
    for seed in range(10):
        found = watched(seed, overconfident)
        named = [w for w in found.warnings if "above 1.3" in w]
        assert named
        assert all(w.startswith("r1: ") for w in found.warnings)
        assert found.figures["joint_cost_per_dof.r1"] > 2.0 > found.figures["joint_cost_per_dof.r2"]


def test_one_submap_that_the_rest_contradicts_is_named():
    def shifted(c):
        if (c.robot, c.sequence) != ("r2", 12):
            return c
        mean = c.local.mean.copy()
        mean[3:] += 3.0
        return Contribution(c.robot, c.epoch, c.sequence, c.end_ns, replace(c.local, mean=mean))

    named = [w for w in watched(3, shifted).warnings if "disagrees" in w]
    assert named[0].startswith("r2: submap 12 disagrees")
