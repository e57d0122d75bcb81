import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.central.config import CentralConfig
from teamslam.sim.studies.rules.map_rules import RULES, RoundsCentre
from teamslam.team import translate
from teamslam.team.wire import channels as ch
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.support import packed, spd
from tests.teams import of

ROBOTS = ["r1", "r2", "r3"]


def centre(name="kalman", robots=ROBOTS):
    return RoundsCentre(CentralConfig(fusion=name), robots)


def give_up(found, robot):
    order = build.given_up(node=f"robot/{robot}", reason="lost")
    return found.handle(order)


def estimate(robot, number, at=0.0):
    means = from_floats([at, 1.0, 2.0, 3.0])
    return build.map_estimate(
        stamp_ns=1000 * number,
        robot=robot,
        sequence=number,
        exchange=number,
        ids=[1, 2],
        means=means,
        covariance=packed(spd(4)),
    )


@settings(deadline=None, max_examples=40)
@given(st.permutations(ROBOTS * 3))
def test_each_round_is_fused_once_in_its_turn_when_nobody_is_missing(order):
    found, out, sent = centre(), [], set()
    for i, robot in enumerate(order):
        number = order[: i + 1].count(robot)
        sent.add((robot, number))
        new = of(found.handle(estimate(robot, number, at=float(robot[1:]))), ch.FUSED_MAP)
        for fused in new:
            assert all((r, fused.exchange) in sent for r in ROBOTS)
        out += new
    assert [fused.exchange for fused in out] == [1, 2, 3]
    assert [encoded(fused) for fused in out] == _in_order()


def _in_order():
    found, out = centre(), []
    for number in (1, 2, 3):
        for robot in ROBOTS:
            out += found.handle(estimate(robot, number, at=float(robot[1:])))
    return [encoded(fused) for fused in of(out, ch.FUSED_MAP)]


def test_who_takes_no_part_is_not_waited_for():
    found = centre()
    assert found.handle(estimate("r1", 1)) == []
    assert give_up(found, "r2") == []
    (fused,) = of(give_up(found, "r3"), ch.FUSED_MAP)
    assert [member.robot for member in fused.members] == ["r1"]


def test_a_centre_that_was_started_again_goes_on_where_the_robots_are():
    found = centre()
    assert found.handle(estimate("r1", 7)) == []
    assert found.handle(estimate("r2", 7)) == []
    (fused,) = of(found.handle(estimate("r3", 7)), ch.FUSED_MAP)
    assert fused.exchange == 7


def test_the_last_map_of_one_who_ended_is_still_fused():
    found = centre(robots=["r1", "r2"])
    found.handle(estimate("r1", 1, at=8.0))
    give_up(found, "r1")
    (fused,) = of(found.handle(estimate("r2", 1)), ch.FUSED_MAP)
    assert [member.robot for member in fused.members] == ["r1", "r2"]
    assert translate.landmarks_of(fused)[1][0, 0] > 0.0


@pytest.mark.parametrize("name", sorted(RULES))
def test_the_final_map_is_the_last_rounds(name):
    found, out = centre(name), []
    for number in (1, 2):
        for robot in ROBOTS:
            out += found.handle(estimate(robot, number, at=float(number)))
    last = of(out, ch.FUSED_MAP)[-1]
    (final,) = of(found.publish_final(), ch.FINAL_MAP)
    assert final.final
    assert (final.exchange, final.digest) == (2, last.digest)
    assert (final.means, final.covariance) == (last.means, last.covariance)
    assert ("more than once" in "".join(final.reasons)) == (name != "covariance-intersection")
    assert decoded(encoded(final)) == final
    assert np.isfinite(translate.landmarks_of(final)[1]).all()


@pytest.mark.parametrize("name", sorted(RULES))
def test_without_any_map_the_final_one_is_empty(name):
    (final,) = of(centre(name).publish_final(), ch.FINAL_MAP)
    assert (final.final, final.ids, final.members) == (True, b"", ())
    assert decoded(encoded(final)) == final
