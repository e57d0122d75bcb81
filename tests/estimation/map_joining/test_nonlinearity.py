import numpy as np
import pytest

from teamslam.central.desk.evaluation.errors import Path, pose_errors
from teamslam.team.estimation.contribution import Contribution, InitialPoseFactor
from teamslam.team.estimation.map_joining import nonlinearity
from teamslam.team.estimation.map_joining.gauss_newton import JoinSettings, joint_marginal
from teamslam.team.estimation.map_joining.joining import (
    EMPTY_FOLD,
    add_start,
    fold_submaps,
    solve_fold,
)
from teamslam.team.estimation.map_joining.nonlinearity import understated_uncertainty
from teamslam.team.estimation.submap import LocalMap
from tests.estimation.submap_world import drawn, local_truth

OPTIONS = JoinSettings()
LANDMARKS = np.array([[0.0, 0.0], [8.0, 0.0], [3.0, 7.0]])


def latecomer(blind, seed=0, turn=0.09):
    """r0 sees three landmarks from a known start; r1 first drives `blind` submaps of 10 m.

    turn: of each submap's end [rad].
    """
    rng = np.random.default_rng(seed)
    fold = add_start(EMPTY_FOLD, InitialPoseFactor("r0", 0, np.zeros(3)))
    submaps = [seeing("r0", 0, np.zeros(3), rng)]
    for k in range(blind):
        truth = np.array([10.0, 0.0, 0.0])
        covariance = np.diag([0.1, 0.3, turn]) ** 2
        local = LocalMap(np.zeros(0, np.uint32), drawn(truth, covariance, rng), covariance)
        submaps.append(Contribution("r1", 0, k, 1000 * (k + 1), local))
    submaps.append(seeing("r1", blind, np.array([-3.0, 2.0, 0.3]), rng))
    ordered = sorted(submaps, key=lambda each: each.key)
    return solve_fold(fold_submaps(fold, ordered, OPTIONS), OPTIONS)


def seeing(robot, sequence, pose, rng):
    truth = local_truth(pose, pose + np.array([1.0, 0.0, 0.0]), LANDMARKS)
    covariance = np.diag([0.1, 0.1, 0.02, *[0.1] * 6]) ** 2
    local = LocalMap(np.arange(3, dtype=np.uint32), drawn(truth, covariance, rng), covariance)
    return Contribution(robot, 0, sequence, 1000 * (sequence + 1), local)


def start_node(fold):
    return fold.main.graph.streams["r1", 0][0]


@pytest.mark.parametrize("seed", range(3))
def test_the_start_of_a_robot_that_drove_long_without_a_landmark_is_said(seed):
    fold = latecomer(blind=14, seed=seed)
    found = understated_uncertainty(fold.main, start_node(fold))
    assert found.ratio > nonlinearity.BENT
    assert found.rise < nonlinearity.UNLIKELY
    assert any("r1 (incarnation 0) may have started farther off" in text for text in fold.warnings)


@pytest.mark.parametrize(("blind", "least", "most"), [(14, 4, 24), (1, 0, 0)])
def test_a_bent_ellipse_is_exceeded_and_another_one_is_not(blind, least, most):
    """Number of 24 worlds whose true start exceeds the 99.9 % bound of the motion's χ²."""
    ahead = 10.0 * blind * np.exp(0.3j)
    truth = np.array([[-3.0 - ahead.real, 2.0 - ahead.imag, 0.3]])
    beyond = 0
    for seed in range(24):
        fold = latecomer(blind, seed)
        mean, covariance = joint_marginal(fold.main, [start_node(fold)])
        stamp = np.zeros(1, np.int64)
        error = pose_errors(Path(stamp, mean[None]), covariance[None], Path(stamp, truth))
        beyond += error.motion_nees[0] > 16.27
    assert least <= beyond <= most


def test_a_robot_that_sees_landmarks_soon_is_not_said(monkeypatch):
    fold = latecomer(blind=1)
    assert fold.warnings == ()
    monkeypatch.setattr(nonlinearity, "STRAIGHT_RAD", 0.0)
    assert understated_uncertainty(fold.main, start_node(fold)) is None, "nor is it bent"


def test_a_robot_whose_initial_pose_is_given_costs_no_profile(monkeypatch):
    """Profiles of known starts would take most of a large team's final map."""
    fold, asked = latecomer(blind=10), []

    def noted(island, node):
        asked.append(node)
        return understated_uncertainty(island, node)

    monkeypatch.setattr(nonlinearity, "understated_uncertainty", noted)
    (said,) = nonlinearity.nonlinearity_warnings(fold.main)
    assert said.startswith("r1 (incarnation 0) may have started farther off")
    streams = fold.main.graph.streams
    assert set(asked) == {streams["r1", 0][0], streams["r1", 0][-1]}
