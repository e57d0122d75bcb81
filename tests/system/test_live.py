import asyncio
import json
import os
import signal
import sys
from pathlib import Path

from teamslam.sim.datasets.folder_writer import write_folder
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.recording.check import holes
from teamslam.team.recording.reader import open_log
from teamslam.team.wire.channels import FINAL_MAP
from tests.support import ROOT, Link
from tests.system.observer import endpoint_of
from tests.system.processes import until
from tests.system.scenarios import final_map, short

PAGE = (ROOT / "docs" / "your_robot.md").read_text("utf-8")
LIVE = PAGE.partition("```toml\n")[2].partition("```")[0]
PAUSE = "0.05"  # pause [s] of the example at each step: sixty of them take three seconds


def recorded(folder: Path) -> bytes:
    simulated = with_options(load(short(folder)), robots=2)
    write_folder(streams_of(simulated), folder / "data")
    for tables in (folder / "data").glob("r*"):
        (tables / "sightings.csv").unlink(missing_ok=True)  # the example omits them
    (folder / "lab.toml").write_text(LIVE)
    scenario = with_options(load(folder / "lab.toml"), dataset=folder / "data")
    samples = run_team(scenario, streams_of(scenario))
    return final_map([(sample.key, sample.payload) for sample in samples])


async def test_robots_join_live_and_deaths_and_cuts_change_no_bit_of_the_map(team):
    expected = recorded(team.folder)
    launch = await team.start(
        *("launch", "lab.toml", "--listen", "tcp/127.0.0.2:0", "--output", "run"),
        *("--no-report", "--no-views", "--json", "result.json"),
    )
    endpoint = await endpoint_of(team.folder / "run", "robot-r2")
    with Link(endpoint) as link:

        async def driver(robot: str, life: int):
            example = ROOT / "examples" / "robot.py"
            typed = f"python examples/robot.py {robot} data/{robot} lab tcp/127.0.0.1:7447"
            assert typed in PAGE
            words = (example, robot, f"data/{robot}", "lab", link.endpoint, PAUSE)
            return await team.run(f"driver-{robot}-{life}", [sys.executable, *map(str, words)])

        first, other = await driver("r1", 1), await driver("r2", 1)
        kept = team.folder / "r1.stream"
        await until(lambda: kept.exists() and kept.stat().st_size > 3000, "r1 measures")
        first.signal(signal.SIGKILL)
        await first.ended()
        link.cut()
        os.kill(await team.pid("robot", "r1"), signal.SIGKILL)
        again = await driver("r1", 2)
        await asyncio.sleep(0.5)  # the link stays cut so long
        assert again.exit is None, again.said()
        link.mend()
        assert await again.ended() == 0, again.said()
        assert await other.ended() == 0, other.said()
        assert await launch.ended() == 0, launch.said()
    log = open_log(team.folder / "run" / "log.mcap")
    (found,) = [sample.payload for sample in log.samples([FINAL_MAP])]
    assert found == expected
    killed = ("robot/r1/tally", "source/r1/tally")  # only their last messages are missing
    assert [each for each in holes(log) if each.where not in killed] == []
    result = json.loads((team.folder / "result.json").read_text())
    assert result["scenario"] == "lab"
    assert all(robot["measurements_used_once"] for robot in result["robots"].values())
