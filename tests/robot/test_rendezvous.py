import random

import msgspec
import pytest

from teamslam.central.desk.verification.verification import verify
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import encoded
from tests import build
from tests.sim.reruns import written
from tests.teams import Team, driven, of, published
from tests.test_sighted_team import CENTRE, SCENARIO, STREAMS

CONFIG = SCENARIO.robots[0]
MEASUREMENTS = published(STREAMS.streams[0])
FIRST = next(k for k, r in enumerate(MEASUREMENTS) if isinstance(r, m.Sightings))


def at_rendezvous(scenario: Scenario) -> Scenario:
    return msgspec.structs.replace(scenario, exchange="rendezvous")


def met(seed: int, exchange: str = "rendezvous") -> Team:
    team = Team(STREAMS, SCENARIO.robots, random.Random(seed), CENTRE, exchange=exchange)
    team.run()
    return team


@pytest.fixture(scope="module")
def continuous():
    return met(0, "continuous")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_final_map_is_that_of_a_continuous_exchange_to_the_last_bit(continuous, seed):
    team = met(seed)
    assert encoded(team.final) == encoded(continuous.final)
    assert all(node.finished for node in team.nodes.values())


def test_a_robot_that_keeps_what_it_holds_is_found_out(continuous, monkeypatch):
    """Mutant: the comparison detects a submap that was never sent."""
    monkeypatch.setattr(RobotNode, "_release", lambda *_: [])
    assert encoded(met(1).final) != encoded(continuous.final)


def sent_by(measurements: list[m.Message], exchange: str = "rendezvous", end: bool = True) -> list:
    return driven(RobotNode(CONFIG, exchange), measurements, end=end)


def test_nothing_is_sent_until_a_teammate_is_seen_and_then_all_of_it():
    before = sent_by(MEASUREMENTS[:FIRST], end=False)
    there = sent_by(MEASUREMENTS[: FIRST + 1], end=False)
    held = of(sent_by(MEASUREMENTS[:FIRST], "continuous", end=False), ch.SUBMAP)
    assert held
    assert of(before, ch.SUBMAP) == of(before, ch.RENDEZVOUS) == []
    assert of(there, ch.SUBMAP) == held
    (told,) = of(there, ch.RENDEZVOUS)
    assert told.teammates == MEASUREMENTS[FIRST].teammates
    assert told.submaps == len(held)
    assert told.waited_s == pytest.approx(1e-9 * (MEASUREMENTS[FIRST].stamp_ns - held[0].stamp_ns))


def test_who_is_told_that_it_was_seen_sends_too_and_nobody_else():
    for teammates, count in (((CONFIG.id,), 1), (("r9",), 0)):
        node = RobotNode(CONFIG, "rendezvous")
        driven(node, MEASUREMENTS[:FIRST], end=False)
        named = {"stamp_ns": MEASUREMENTS[FIRST].stamp_ns, "robot": "r2", "teammates": teammates}
        out = node.handle(build.built(m.Rendezvous, waited_s=0.0, **named))
        assert (len(of(out, ch.SUBMAP)) > 0) == (len(of(out, ch.RENDEZVOUS)) == 1) == bool(count)
        if count:
            assert of(out, ch.RENDEZVOUS)[0].teammates == ()


def test_a_held_submap_holds_back_the_team_time_that_its_robot_has_passed():
    reports = of(sent_by(MEASUREMENTS[:FIRST], end=False), ch.ROBOT_PROGRESS)
    assert {report.submaps for report in reports} == {0}
    assert max(report.stamp_ns for report in reports) <= MEASUREMENTS[0].stamp_ns


def test_at_the_end_of_the_stream_everything_is_sent():
    alone = [r for r in MEASUREMENTS if not isinstance(r, m.Sightings)]
    alone = [msgspec.structs.replace(r, number=k) for k, r in enumerate(alone)]
    out, usual = sent_by(alone), sent_by(alone, "continuous")
    assert of(out, ch.SUBMAP) == of(usual, ch.SUBMAP)
    assert len(of(out, ch.RENDEZVOUS)) == 1
    assert of(out, ch.ROBOT_DONE) == of(usual, ch.ROBOT_DONE)


def test_a_recorded_rendezvous_is_computed_again_to_the_last_bit(tmp_path):
    samples = list(run_team(at_rendezvous(SCENARIO), STREAMS))
    usual = list(run_team(SCENARIO, STREAMS))
    assert encoded(final_map(samples)) == encoded(final_map(usual))
    told = [x for c, _, x in map(opened, samples) if c is ch.RENDEZVOUS]
    assert sum(x.submaps for x in told) == sum(x.key.endswith("/submap") for x in samples)
    found = verify(written(tmp_path / "log.mcap", samples))
    assert found.first is None
