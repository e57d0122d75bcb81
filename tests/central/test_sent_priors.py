"""A prior is sent when it says what its robot can not know, and now and then."""

import numpy as np

from central.sent_priors import EVERY, SentPriors
from team.estimation.map_joining.marginals import LandmarkBlocks

HERE = np.zeros(3)
ROBOT = ("r1", 1)


def blocks(shift=0.0, variance=0.01, count=40, sigmas=0.0):
    """Landmarks in a row, a metre apart; the third moved by so many metres, all by `sigmas`."""
    ids = np.arange(count, dtype=np.uint32)
    means = np.column_stack([np.arange(count) * 1.0, np.zeros(count)])
    means[2, 1] += shift
    means[:, 0] += sigmas * np.sqrt(variance)
    return LandmarkBlocks(ids, means, np.tile(variance * np.eye(2), (count, 1, 1)))


def test_the_first_prior_is_sent_and_then_one_of_every_so_many():
    sent_priors = SentPriors(30)
    said = [sent_priors.is_worth(ROBOT, HERE, blocks()) for _ in range(2 * EVERY + 1)]
    assert [k for k, sent in enumerate(said) if sent] == [0, EVERY, 2 * EVERY]
    assert sent_priors.is_worth(("r1", 2), HERE, blocks()), "another incarnation was told nothing"


def test_what_has_moved_or_become_surer_is_news_and_a_little_is_none():
    for changed, is_news in (
        (blocks(sigmas=0.12), True),
        (blocks(shift=0.1), True),
        (blocks(variance=0.007), True),
        (blocks(sigmas=0.05), False),
        (blocks(variance=0.009), False),
    ):
        sent_priors = SentPriors(30)
        sent_priors.is_worth(ROBOT, HERE, blocks())
        assert sent_priors.is_worth(ROBOT, HERE, changed) == is_news


def test_small_moves_add_up_to_news():
    sent_priors = SentPriors(30)
    said = [sent_priors.is_worth(ROBOT, HERE, blocks(sigmas=0.04 * k)) for k in range(7)]
    assert said == [True, False, False, True, False, False, True]


def test_a_robot_that_comes_to_landmarks_that_it_was_not_told_is_told():
    sent_priors = SentPriors(30)
    sent_priors.is_worth(ROBOT, HERE, blocks())
    assert not sent_priors.is_worth(ROBOT, np.array([20.0, 0.0, 0.0]), blocks())
    assert sent_priors.is_worth(ROBOT, np.array([30.0, 0.0, 0.0]), blocks())
