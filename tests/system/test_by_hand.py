import signal

from tests.system.scenarios import short


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
