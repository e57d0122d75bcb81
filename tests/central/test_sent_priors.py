"""A prior is sent when it adds information for its robot, and at a fixed interval."""

import numpy as np

from teamslam.central import sent_priors as priors
from teamslam.central.sent_priors import EVERY, SentPriors
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.world.simulator import simulated
from teamslam.team.estimation.map_joining.marginals import LandmarkBlocks
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import opened
from tests.central.test_withdrawal import scenario

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


def test_an_inter_robot_measurement_is_told_once_to_those_that_it_is_of():
    sent_priors = SentPriors(30)
    said = [sent_priors.is_worth(ROBOT, HERE, blocks(), met) for met in (-1, -1, 5, 5, 3, 7)]
    assert said == [True, False, True, False, False, True]


def test_of_inter_robot_measurements_the_robots_are_told_that_they_are_of(monkeypatch):
    monkeypatch.setattr(priors, "NEEDED", 0)
    monkeypatch.setattr(priors, "EVERY", 1_000_000)
    of = scenario()
    met: dict[str, set[int]] = {each.id: set() for each in of.robots}
    told: dict[str, list[int]] = {each.id: [] for each in of.robots}
    for sample in run_team(of, simulated(of.world, of.robots, of.seed)):
        channel, robot, message = opened(sample)
        if channel is ch.SIGHTING_FACTOR:
            met[message.robot].add(message.stamp_ns)
            met[message.teammate].add(message.stamp_ns)
        elif channel is ch.PRIOR:
            told[robot].append(message.stamp_ns)
    until = max(max(each) for each in told.values())
    newest = {}
    for robot, stamps in told.items():
        newest[robot] = [max(each for each in met[robot] if each <= stamp) for stamp in stamps]
        assert len(set(newest[robot])) == len(stamps), "told again without a new measurement"
        assert newest[robot][-1] == max(each for each in met[robot] if each <= until)
    assert len(told["r1"]) > 3 > len(told["r3"])
