"""The robot's team map: a submap is in it once, whether the prior or the robot brings it."""

from team import translate
from team.estimation.conditioning import followed
from team.robot.team_map import TeamMap
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids
from tests.estimation.submap_world import team
from tests.support import packed, spd

LOCALS = [each.local for each in team(1, robots=1, submaps=6).submaps]


def prior(sequence: int) -> m.Prior:
    return m.Prior(
        0, "r0", 0, sequence, b"", from_ids((1, 2)), from_floats([0.0] * 7), packed(spd(7))
    )


def test_the_map_that_is_kept_is_the_one_that_is_made_anew() -> None:
    kept, told = TeamMap(), prior(1)
    for known in range(2, 7):
        again = TeamMap().given(told, LOCALS[:known])
        assert kept.given(told, LOCALS[:known]).whole.mean.tobytes() == again.whole.mean.tobytes()


def test_a_robot_that_has_come_back_does_not_count_what_the_prior_has_already() -> None:
    """The prior has submaps 0 to 4; the robot, started again, has sent three of them so far."""
    kept, told = TeamMap(), prior(4)
    alone = translate.prior_of(told).whole
    for known in (3, 4, 5):
        assert kept.given(told, LOCALS[:known]).whole.mean.tobytes() == alone.mean.tobytes()
    expected = followed(alone, LOCALS[5:]).whole
    assert kept.given(told, LOCALS).whole.mean.tobytes() == expected.mean.tobytes()
