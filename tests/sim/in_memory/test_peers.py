import msgspec
import pytest

from teamslam.central.peers.robot import PeerRobot
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.peers.members import Member, about
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import decoded, encoded
from tests.air import Air, Meeting, meetings
from tests.peer_team import PeerTeam, peer_world
from tests.scenarios import with_world

SECOND = 1_000_000_000


def scenario():
    scenario = with_options(load("thesis"), robots=3)
    return with_world(scenario, steps=32)


@pytest.fixture(scope="module")
def central():
    return list(run_team(scenario(), streams_of(scenario())))


def peers(air, steps=None):
    team = PeerTeam(scenario(), air)
    samples = list(team.run(peer_world(scenario(), streams_of(scenario())), steps))
    return team, samples


def chain(one: str, other: str, now_ns: int) -> bool:
    return abs(int(one[1:]) - int(other[1:])) == 1


def test_every_peers_final_map_is_the_central_runs_though_it_meets_one_teammate_only(central):
    team, samples = peers(Air(reach=chain, loss=0.2, duplicates=0.1, delay_ns=(0, 2 * SECOND)))
    expected = encoded(final_map(central))
    for robot, seat in team.seats.items():
        assert seat.node.final is not None, robot
        assert encoded(seat.node.final) == expected
    own = [s.payload for s in samples if s.key == ch.SUBMAP.key("r1")]
    assert own == [s.payload for s in central if s.key == ch.SUBMAP.key("r1")]
    over = team.seats["r3"].node.peer.carried
    assert over["robot/r1"] == 0
    assert over["robot/r2"] > len(own)
    poses = [decoded(s.payload, m.PoseEstimate) for s in samples if s.key == ch.TEAM_POSE.key("r3")]
    priors = {
        decoded(s.payload, m.Prior).digest for s in samples if s.key == ch.TEAM_PRIOR.key("r3")
    }
    assert poses
    assert {pose.map_digest for pose in poses} <= priors


def test_after_meetings_deaths_and_a_torn_disk_the_maps_are_the_central_runs(central):
    """Pairs meet, r2 carries; it dies, once after the end, and has lost its disk.

    A centre is there for a while, meets r1 only, dies, and restarts from its disk.
    """
    windows = meetings(
        [
            Meeting(frozenset({"r1", "r2"}), 10 * SECOND, 14 * SECOND),
            Meeting(frozenset({"r2", "r3"}), 22 * SECOND, 25 * SECOND),
            Meeting(frozenset({"r1", "central"}), 8 * SECOND, 20 * SECOND),
            Meeting(frozenset({"r1", "r2", "r3", "central"}), 60 * SECOND, 10**6 * SECOND),
        ]
    )
    deaths = iter([16, 27, 40])
    due = next(deaths)

    disk: list[Member] = []

    def die(team: PeerTeam) -> None:
        nonlocal due
        at_s = team.now_ns // SECOND
        if "central" not in team.seats and (at_s < 18 or at_s > 50):
            team.seat_centre(disk)
        elif "central" in team.seats and 18 < at_s < 50:
            disk.extend(team.leave("central"))
        if team.now_ns >= due * SECOND:
            due = next(deaths, 10**9)
            kept = list(team.seats["r2"].node.peer.replica.members())
            own = [each for each in kept if getattr(each.message, "robot", "") == "r2"]
            team.restart(team.scenario.robots[1], own[:-1] if due > 100 else kept[:-3])

    team, _ = peers(Air(reach=windows), die)
    expected = encoded(final_map(central))
    assert all(encoded(seat.node.final) == expected for seat in team.seats.values())
    assert min(team.complete_ns.values()) >= 60 * SECOND
    assert any(about(each.message) == "r1" for each in disk)
    assert sorted(team.seats) == ["central", "r1", "r2", "r3"]


def test_the_fold_of_a_set_that_changed_or_grew_is_the_fold_of_what_it_is_now(central):
    team, _ = peers(Air())
    seat = team.seats["r1"]
    before = seat.node.final
    small = PeerRobot(scenario().robots[0], scenario().central, ["r1", "r2", "r3"], when="request")
    small.keep(seat.node.peer.replica.members())
    assert not small.fold.refresh(), "it folds when it is asked to"
    (reply,) = small.answer_fold(encoded(m.FoldRequest(stamp_ns=0)))
    assert decoded(reply, m.FusedMap).members == before.members
    assert ch.TEAM_MAP in {each.channel for each in small.tick(0.0)}
    first = next(s for s in central if s.key == ch.SUBMAP.key("r2"))
    submap = decoded(first.payload, m.Submap)
    changed = (
        Sample(first.key, encoded(msgspec.structs.replace(submap, gated=gated)), 0, 0, 0)
        for gated in range(1, 100)
    )
    for sample in changed:
        seat.boundary.take(seat.node, sample)
        if seat.node.peer.replica.replacements:
            break
    assert seat.node.peer.replica.replacements == 1
    assert seat.node.final.digest != before.digest
    assert (seat.node.final.ids, seat.node.final.means) == (before.ids, before.means)
