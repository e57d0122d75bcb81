import json
import signal
import socket

import zenoh

from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch
from tests.system.scenarios import map_in_memory, short


async def test_a_world_that_waits_for_a_robot_with_other_options_says_so_and_goes_on_without_them(
    team,
):
    scenario = short(team.folder, steps=20)
    there = ["--connect", await team.router()]
    world = await team.start("world", scenario, *there, "--speed", "max")
    record = await team.start("record", scenario, *there, "--output", "a.mcap")
    centre = await team.start("central", scenario, *there)
    r1 = await team.start("robot", scenario, "r1", *there, name="r1")
    wrong = await team.start("robot", scenario, "r2", *there, "--seed", "5", name="wrong")
    await world.says(
        "robot/r2 differs from the world's scenario: seed is 5 there and 1 here: start"
    )
    second = await team.start("robot", scenario, "r1", *there, name="second")
    assert await second.ended() == 2, second.said()
    assert "error: another process is robot/r1 in this team already: stop" in second.said()
    assert r1.exit is None, "the first one goes on"
    wrong.signal(signal.SIGTERM)
    await wrong.ended()
    r2 = await team.start("robot", scenario, "r2", *there, name="r2")
    for process, last in (
        (world, "world: published "),
        (r1, "robot-r1: 2 submaps from "),
        (r2, "robot-r2: 2 submaps from "),
        (centre, "central: final map of "),
        (record, "recorder: wrote a.mcap, "),
    ):
        assert await process.ended() == 0, process.said()
        assert "connected to team short at tcp/127.0.0.1:" in process.said()
        assert process.said().splitlines()[-1].startswith(last), process.said()


async def test_a_robot_behind_a_router_of_its_own_linked_to_the_teams_makes_the_same_map(team):
    """As with rmw_zenohd on each robot, docs/ros2_recipes.md: any Zenoh router is enough."""
    scenario = short(team.folder, steps=20)
    site = await team.router()
    own = f"tcp/127.0.0.1:{free_port()}"
    with zenoh.open(router_config(listen=own, connect=site)):
        far, near = ["--connect", own], ["--connect", site]
        processes = [
            await team.start("record", scenario, *near, "--output", "a.mcap"),
            await team.start("central", scenario, *near),
            await team.start("robot", scenario, "r1", *far, name="r1"),
            await team.start("robot", scenario, "r2", *near, name="r2"),
            await team.start("world", scenario, *far, "--speed", "max"),
        ]
        for process in processes:
            assert await process.ended() == 0, process.said()
    (final,) = open_log(team.folder / "a.mcap").samples((ch.FINAL_MAP,))
    assert final.payload == map_in_memory(scenario)


def router_config(listen: str, connect: str) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in (
        ("mode", "router"),
        ("listen/endpoints", [listen]),
        ("connect/endpoints", [connect]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    return config


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
