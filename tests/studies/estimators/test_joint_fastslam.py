import numpy as np
import pytest

from teamslam.sim.studies.estimators import joint_fastslam, plain_fastslam
from teamslam.team import core
from tests.estimation.team_rounds import STARTS, team_run

PROPOSALS = ["fastslam1", "fastslam2"]


def filtered(rounds, state, random):
    for turns in rounds:
        state = joint_fastslam.filter_step(state, turns, random)
    return state


def bytes_of(state):
    each = state.newest
    arrays = (state.poses, each.log_weights, each.ids, each.means, each.covariances)
    return [array.tobytes() for array in arrays]


@pytest.mark.parametrize("proposal", PROPOSALS)
@pytest.mark.parametrize("resample_below", [0.5, 1.0])
def test_a_team_of_one_is_plain_fastslam_bit_for_bit(proposal, resample_below):
    start = {"r1": STARTS["r1"]}
    rounds, _ = team_run(1, start, steps=15)
    joint = joint_fastslam.initial_state(start, 50, proposal, resample_below)
    joint = filtered(rounds, joint, np.random.default_rng(0))
    plain, random = (
        plain_fastslam.initial_state(start["r1"], 50, proposal, resample_below),
        np.random.default_rng(0),
    )
    for (turn,) in rounds:
        plain = plain_fastslam.filter_step(plain, turn, random)
    for name in ("poses", "log_weights", "ids", "means", "covariances"):
        ours = getattr(joint.newest, name)
        assert ours.tobytes() == getattr(plain.particles, name).tobytes()
    for ours, theirs in zip(
        (joint_fastslam.pose_gaussian(joint, "r1"), joint_fastslam.landmark_gaussian(joint)),
        (plain_fastslam.pose_gaussian(plain), plain_fastslam.landmark_gaussian(plain)),
        strict=True,
    ):
        assert [part.tobytes() for part in ours] == [part.tobytes() for part in theirs]
    never = joint_fastslam.initial_state(start, 50, proposal, 0.0)
    assert bytes_of(filtered(rounds, never, np.random.default_rng(0))) != bytes_of(joint)


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_robots_that_share_no_landmark_multiply_their_weights(proposal):
    seen = {"r1": np.array([0, 1]), "r2": np.array([2, 3])}
    rounds, _ = team_run(2, seen=seen, steps=3)
    random = np.random.default_rng(1)
    joint = filtered(rounds, joint_fastslam.initial_state(STARTS, 40, proposal, 0.0), random)
    random = np.random.default_rng(1)
    alone = {
        robot: plain_fastslam.initial_state(pose, 40, proposal, 0.0)
        for robot, pose in STARTS.items()
    }
    for turns in rounds:
        for turn in turns:
            alone[turn.robot] = plain_fastslam.filter_step(alone[turn.robot], turn, random)
    product = sum(state.particles.log_weights for state in alone.values())
    newest = joint.newest.log_weights
    np.testing.assert_allclose(newest, core.normalise(product)[0], atol=1e-9)
    for index, state in enumerate(alone.values()):
        np.testing.assert_array_equal(joint.poses[index], state.particles.poses)
