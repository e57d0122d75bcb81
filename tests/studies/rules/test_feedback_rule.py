"""Rules with feedback: rounds in lockstep, whoever ends early or is lost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from central.attendance import TeamAttendance
from central.config import CentralConfig
from central.scheduler import Scheduler
from sim.studies.rules.feedback_rule import RULES, ExchangeRule
from team import translate
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids
from team.wire.codec import decoded, encoded
from tests.support import packed, spd
from tests.teams import of

ROBOTS = ["r1", "r2", "r3"]


def rule(name="kalman"):
    return Scheduler(ExchangeRule(CentralConfig(fusion=name), b"settings", ROBOTS))


def estimate(robot, number, at=0.0):
    means = from_floats([at, 1.0, 2.0, 3.0])
    return m.MapEstimate(
        stamp_ns=1000 * number,
        robot=robot,
        incarnation=1,
        sequence=number,
        exchange=number,
        joint=True,
        ids=from_ids([1, 2]),
        means=means,
        covariance=packed(spd(4)),
    )


def team(robots=ROBOTS, without=()):
    """The attendance of a team in which some have ended."""
    attendance = TeamAttendance.of(robots)
    for robot in without:
        attendance.robots[robot].given_up = True
    return attendance


@settings(deadline=None, max_examples=40)
@given(st.permutations(ROBOTS * 3))
def test_each_round_is_fused_once_in_its_turn_when_nobody_is_missing(order):
    """A robot's own maps keep their order."""
    found, out, sent = rule(), [], set()
    for i, robot in enumerate(order):
        number = order[: i + 1].count(robot)
        found.intake.take(estimate(robot, number, at=float(robot[1:])), 0)
        sent.add((robot, number))
        new = of(found.advance(team()), ch.FUSED_MAP)
        for fused in new:
            assert all((r, fused.exchange) in sent for r in ROBOTS)
        out += new
    assert [fused.exchange for fused in out] == [1, 2, 3]
    assert [encoded(fused) for fused in out] == _in_order()


def _in_order():
    found, out = rule(), []
    for number in (1, 2, 3):
        for robot in ROBOTS:
            found.intake.take(estimate(robot, number, at=float(robot[1:])), 0)
        out += of(found.advance(team()), ch.FUSED_MAP)
    return [encoded(fused) for fused in out]


def test_who_takes_no_part_is_not_waited_for():
    found = rule()
    found.intake.take(estimate("r1", 1), 0)
    assert found.advance(team()) == []
    (fused,) = of(found.advance(team(without=("r2", "r3"))), ch.FUSED_MAP)
    assert [member.robot for member in fused.members] == ["r1"]


def test_a_centre_that_was_started_again_goes_on_where_the_robots_are():
    found = rule()
    found.intake.take(estimate("r1", 7), 0)
    found.intake.take(estimate("r2", 7), 0)
    assert found.advance(team()) == []
    found.intake.take(estimate("r3", 7), 0)
    (fused,) = of(found.advance(team()), ch.FUSED_MAP)
    assert fused.exchange == 7


def test_the_last_map_of_one_who_ended_is_still_fused():
    found = rule()
    found.intake.take(estimate("r1", 1, at=8.0), 0)
    found.intake.take(estimate("r2", 1), 0)
    (fused,) = of(found.advance(team(["r1", "r2"], without=("r1",))), ch.FUSED_MAP)
    assert [member.robot for member in fused.members] == ["r1", "r2"]
    assert translate.landmarks_of(fused)[1][0, 0] > 0.0


def test_a_map_for_a_round_that_is_over_is_not_taken():
    found = rule()
    for robot in ROBOTS:
        found.intake.take(estimate(robot, 1), 0)
    found.advance(team())
    found.intake.take(estimate("r1", 1, at=99.0), 0)
    for robot in ROBOTS:
        found.intake.take(estimate(robot, 2), 0)
    (fused,) = of(found.advance(team()), ch.FUSED_MAP)
    assert fused.exchange == 2


@pytest.mark.parametrize("name", sorted(RULES))
def test_the_final_map_is_the_last_rounds(name):
    found = rule(name)
    for number in (1, 2):
        for robot in ROBOTS:
            found.intake.take(estimate(robot, number, at=float(number)), 0)
    last = of(found.advance(team()), ch.FUSED_MAP)[-1]
    (final,) = of(found.conclude(0), ch.FINAL_MAP)
    assert final.final
    assert (final.exchange, final.digest, final.means, final.covariance) == (
        2,
        last.digest,
        last.means,
        last.covariance,
    )
    assert ("more than once" in "".join(final.reasons)) == (name != "covariance-intersection")
    assert decoded(encoded(final)) == final
    assert np.isfinite(translate.landmarks_of(final)[1]).all()


@pytest.mark.parametrize("name", sorted(RULES))
def test_without_any_map_the_final_one_is_empty(name):
    (final,) = of(rule(name).conclude(7), ch.FINAL_MAP)
    assert (final.final, final.ids, final.members) == (True, b"", ())
    assert decoded(encoded(final)) == final


def test_the_digest_names_the_maps_and_every_round_before():
    digests = set()
    for first, second in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
        found = rule()
        for number, at in ((1, first), (2, second)):
            found.intake.take(estimate("r1", number, at), 0)
        digests.add(of(found.advance(team(["r1"])), ch.FUSED_MAP)[-1].digest)
    assert len(digests) == 3
