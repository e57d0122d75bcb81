import signal
from dataclasses import dataclass
from pathlib import Path

from teamslam.sim.scenarios.scenario import load
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.codec import decoded
from tests.support import Link
from tests.system.observer import Observer
from tests.system.processes import Process, Processes
from tests.system.scenarios import STEPS, final_map, map_in_memory, short


@dataclass
class Team:
    scenario: Path
    endpoint: str
    robots: dict[str, Process]
    others: list[Process]
    log: Path

    async def ends_well(self, status: int = 0) -> None:
        """Check that every process ends with 0, listed robots included.

        status: 1 where the final map is without a robot.
        """
        for process in (*self.robots.values(), *self.others):
            assert await process.ended() == status, process.said()

    def final_map(self) -> bytes:
        log = open_log(self.log)
        assert log.complete
        return final_map([(sample.key, sample.payload) for sample in log.samples()])


async def assembled(team: Processes, speed: str, r1_connects: str = "") -> Team:
    """Recorder, centre, robots and world around a router; `r1_connects`: r1's own way to it."""
    scenario = short(team.folder)
    endpoint = await team.router()
    there = ["--connect", endpoint]
    log = team.folder / "log.mcap"
    others = [
        await team.start("record", scenario, *there, "--output", log, name="recorder"),
        await team.start("central", scenario, *there),
        await team.start("world", scenario, *there, "--speed", speed),
    ]
    robots = {"r2": await team.start("robot", scenario, "r2", *there, name="r2")}
    return Team(scenario, endpoint, robots, others, log)


async def robot(team: Processes, found: Team, endpoint: str, name: str) -> Process:
    return await team.start("robot", found.scenario, "r1", "--connect", endpoint, name=name)


async def test_measurements_that_a_cut_link_loses_are_asked_for_at_their_source(team):
    found = await assembled(team, "10")
    with Link(found.endpoint) as link, Observer(found.endpoint, [ch.ODOMETRY, ch.END]) as seen:
        found.robots["r1"] = await robot(team, found, link.endpoint, "r1")
        await seen.sees(STEPS // 4, ch.ODOMETRY, "r1")  # of the world, at any speed of r1
        link.cut()
        await seen.sees(1, ch.END)
        link.mend()
        await found.ends_well()
    assert "are missing: asked for" in found.robots["r1"].said()
    assert found.final_map() == map_in_memory(found.scenario)


async def test_an_order_and_an_earlier_life_s_submaps_outlive_the_centre_that_received_them(team):
    found = await assembled(team, "4")  # all of this comes before the end
    first = await robot(team, found, found.endpoint, "r1")
    there = ["--connect", found.endpoint]
    with Observer(found.endpoint, [ch.SUBMAP]) as seen:
        await seen.sees(1, ch.SUBMAP, "r1")
        first.signal(signal.SIGKILL)
        await first.ended()
        found.robots["r1"] = await robot(team, found, found.endpoint, "r1-again")
        await seen.sees(1, ch.SUBMAP, "r2")
        order = await team.start(
            "withdraw", "r2", "--team", load(found.scenario).team, *there, name="order"
        )
        assert await order.ended() == 0, order.said()
        assert "r2 is withdrawn; the map of" in order.said()
        await seen.sees(2, ch.SUBMAP, "r1")
        centre = found.others.pop(1)
        centre.signal(signal.SIGKILL)
        await centre.ended()
    again = await team.start("central", found.scenario, *there)
    found.others.append(again)
    await found.ends_well(status=1)
    assert "resumed after submap" in found.robots["r1"].said()
    assert "the final map is without r2: withdrawn" in again.said()
    fused = decoded(found.final_map(), m.FusedMap)
    assert (fused.withdrawn, fused.missing) == (("r2",), ())
    assert {member.robot for member in fused.members} == {"r1"}
    verified = await team.start("rerun", found.log, "--verify", name="verified")
    assert await verified.ended() == 0, verified.said()
