import random

import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.desk.ledger import ledger
from teamslam.central.desk.verification.recorded import index_log
from teamslam.central.desk.verification.verification import verify
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.robot.ledger import IN_SIGHTING
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import encoded
from tests.scenarios import with_front_ends, with_robots
from tests.sim.reruns import messages, team_samples, thesis, written
from tests.teams import Team, driven, of, published

CENTRE = CentralConfig(tick_s=8.0, broadcast_s=8.0)


SCENARIO = with_robots(
    with_front_ends(thesis(60), node_s=5.0, sighting_s=1.0, particles=30), pose_s=1e6
)
STREAMS = streams_of(SCENARIO)


def team(seed):
    found = Team(STREAMS, SCENARIO.robots, random.Random(seed), CENTRE)
    found.run()
    return found


@pytest.fixture(scope="module")
def first():
    return team(0)


@pytest.fixture(scope="module")
def samples():
    return team_samples(SCENARIO)


def test_the_final_map_is_the_same_bytes_for_another_interleaving_of_submaps_and_sightings(first):
    assert first.sent[ch.SIGHTING_FACTOR.key(SCENARIO.robots[0].id)]
    assert encoded(team(1).final) == encoded(first.final)


def test_a_robot_that_dies_and_comes_back_changes_no_bit_of_it(first):
    again = Team(STREAMS, SCENARIO.robots, random.Random(3), CENTRE)
    victim = SCENARIO.robots[0]
    while len(again.sent[ch.SUBMAP.key(victim.id)]) < 3:
        again.step()
    again.kill(victim.id)
    for _ in range(20):
        again.step()
    again.resume(victim)
    again.run()
    assert encoded(again.final) == encoded(first.final)


def test_a_submap_enters_the_map_when_its_last_sighting_has_come(first):
    robot = SCENARIO.robots[0].id
    submaps, sightings = (first.sent[c.key(robot)] for c in (ch.SUBMAP, ch.SIGHTING_FACTOR))
    whole = next(x for x in submaps if x.sightings)
    mine = [x for x in sightings if x.sequence == whole.sequence]
    assert len(mine) == whole.sightings
    centre = Team(STREAMS, SCENARIO.robots, random.Random(4), CENTRE).centre
    centre.handle(first.sent[ch.START.key(robot)][0])
    for submap in submaps[: whole.sequence]:
        centre.handle(submap)
    for each in (whole, *mine[:-1]):
        centre.handle(each)
    before = centre.store.processed((robot, whole.incarnation))
    out = centre.handle(mine[-1])
    assert before == whole.sequence
    assert [x.submaps for x in of(out, ch.CENTRAL_PROGRESS)] == [whole.sequence + 1]
    assert of(centre.handle(mine[-1]), ch.CENTRAL_PROGRESS) == []


def test_a_run_with_sightings_is_computed_again_to_the_last_bit(samples, tmp_path):
    found = verify(written(tmp_path / "log.mcap", samples))
    counts = {c.channel: (c.messages, c.equal) for c in found.channels}
    assert found.first is None
    assert counts["sighting_factor"][0] == counts["sighting_factor"][1] > 0
    assert all(total == equal for total, equal in counts.values())


def test_each_measurement_of_a_run_with_sightings_has_one_disposition(samples, tmp_path):
    found = ledger(index_log(written(tmp_path / "log.mcap", samples)))
    assert found.offenders == ()
    used = {
        (x.robot, n)
        for robot in SCENARIO.robots
        for x in messages(samples, ch.SIGHTING_FACTOR, robot.id)
        for n in x.measurements
    }
    assert found.totals()[IN_SIGHTING] == len(used) > 0


def test_sightings_whose_node_never_comes_are_rejected_at_the_end():
    config = SCENARIO.robots[0]
    measurements = published(STREAMS.streams[0])
    wanted = next(
        k
        for k, r in enumerate(measurements)
        if isinstance(r, m.Sightings) and r.stamp_ns % 5_000_000_000 == 4_000_000_000
    )
    out = driven(RobotNode(config), measurements[: wanted + 2])
    (done,) = of(out, ch.ROBOT_DONE)
    told = {d.disposition: d.measurements for d in done.ledger}
    assert told["rejected: no pose node near it"] >= 1
    assert sum(told.values()) == done.measurements
    used = {n for x in of(out, ch.SIGHTING_FACTOR) for n in x.measurements}
    assert told.get(IN_SIGHTING, 0) == len(used)
