"""The robot's team map: it contains a submap once, from the prior or from the robot."""

import msgspec
import numpy as np
import pytest

from teamslam.team import translate
from teamslam.team.config import Bounds
from teamslam.team.estimation.gaussian import UNSOLVABLE, PoseGaussian, curved
from teamslam.team.estimation.map_joining.conditioning import join_pending
from teamslam.team.estimation.plausibility import prior_beyond
from teamslam.team.robot.maps import CONDENSED, TeamMap
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids
from tests import build
from tests.estimation.submap_world import team
from tests.support import packed, spd

LOCALS = [each.local for each in team(1, robots=1, submaps=6).submaps]


def prior(sequence: int) -> m.Prior:
    return build.prior(
        robot="r0",
        incarnation=0,
        sequence=sequence,
        digest=b"",
        ids=(1, 2),
        mean=[0.0] * 7,
        covariance=packed(spd(7)),
    )


def test_a_pose_costs_the_same_however_long_no_prior_comes(monkeypatch):
    """The oldest submaps are condensed by their order alone."""
    submaps = [each.local for each in team(1, robots=1, submaps=5 * CONDENSED).submaps]
    first = submaps[0]  # its frame is the team's
    told = msgspec.structs.replace(
        prior(0), ids=from_ids(first.ids), mean=from_floats(first.mean),
        covariance=packed(first.covariance),
    )  # fmt: skip
    whole = join_pending(translate.prior_of(told).whole, submaps[1:]).whole
    solved_at_once: list[int] = []

    def counted(whole, pending):
        solved_at_once.append(len(pending))
        return join_pending(whole, pending)

    monkeypatch.setattr("teamslam.team.robot.maps.join_pending", counted)
    often, seldom = TeamMap(), TeamMap()
    for known in range(1, len(submaps) + 1):
        last = often.join(told, submaps[:known]).whole
        if known in (3, 50, len(submaps)):
            assert seldom.join(told, submaps[:known]).whole.mean.tobytes() == last.mean.tobytes()
    assert max(solved_at_once) < 2 * CONDENSED
    off, covariance = last.mean - whole.mean, whole.covariance
    assert off @ np.linalg.solve(covariance, off) / len(off) < 1e-3
    np.testing.assert_allclose(np.diag(last.covariance), np.diag(covariance), rtol=0.01)


def test_a_pose_is_told_with_the_covariance_of_its_arc():
    told = prior(5)
    alone = translate.prior_of(told).whole
    expected = curved(PoseGaussian(alone.mean[:3], alone.covariance[:3, :3])).covariance
    posed = TeamMap().pose(told, LOCALS[:6], None).pose
    assert posed.covariance.tobytes() == expected.tobytes()
    assert (posed.covariance[0, 0], posed.covariance[1, 1]) > tuple(np.diag(alone.covariance)[:2])


def test_a_robot_that_has_come_back_does_not_count_what_the_prior_has_already():
    """The prior has submaps 0 to 4; the restarted robot has sent three of them so far."""
    kept, told = TeamMap(), prior(4)
    alone = translate.prior_of(told).whole
    for known in (3, 4, 5):
        assert kept.join(told, LOCALS[:known]).whole.mean.tobytes() == alone.mean.tobytes()
    expected = join_pending(alone, LOCALS[5:]).whole
    assert kept.join(told, LOCALS).whole.mean.tobytes() == expected.mean.tobytes()


def test_that_a_prior_has_no_solution_is_found_once_and_raised_at_every_pose(monkeypatch):
    tried: list[int] = []

    def unsolvable(whole, pending):
        tried.append(1)
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("teamslam.team.robot.maps.join_pending", unsolvable)
    kept, told = TeamMap(), prior(1)
    for each, tries in ((told, 1), (told, 1), (prior(2), 2)):
        with pytest.raises(UNSOLVABLE):
            kept.pose(each, LOCALS, None)
        assert len(tried) == tries


@pytest.mark.parametrize(
    ("at", "value", "sigma", "why"),
    [
        (0, 1e9, 0.1, "a coordinate of 1e+09 m"),
        (4, -1e9, 0.1, "a coordinate of 1e+09 m"),
        (3, 1.0, 1e9, "a sigma of 1e+09 m"),
        (3, 1.0, 0.0, None),
        (2, 1.0, 0.1, None),
    ],
)
def test_a_prior_beyond_the_bounds_is_refused(at, value, sigma, why):
    mean = np.zeros(7)
    mean[at] = value
    refused = prior_beyond(mean, sigma**2 * np.eye(7), Bounds())
    assert refused == why if why is None else refused is not None and refused.startswith(why)
