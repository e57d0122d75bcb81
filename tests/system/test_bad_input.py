"""Wrong input that a process detects: one clear message, exit status 2, no process left.

For single commands see `tests/sim/cli/test_wrong_use.py`.
"""

import asyncio
import socket
from pathlib import Path

import pytest

from teamslam.sim.datasets.utias_writer import write_utias
from teamslam.sim.scenarios.scenario import load
from teamslam.sim.scenarios.source import streams_of
from tests.sim.cli.test_wrong_use import message_in
from tests.support import nobody_listens
from tests.system.processes import Process, Processes
from tests.system.scenarios import short


def told(process: Process) -> str:
    return message_in(process.said(), process.exit)


async def refused(team: Processes, *arguments: str | Path) -> str:
    process = await team.start(*arguments)
    await process.ended()
    await team.none_left(0.0)
    return told(process)


@pytest.fixture
def dataset(team):
    folder = team.folder / "MRCLAM_Dataset0"
    write_utias(streams_of(load(short(team.folder, "waypoints", 40))), folder)
    return folder


async def test_a_file_that_is_no_zip_is_told(team):
    (team.folder / "set.zip").write_bytes(b"PK\3\4 and no more")
    message = await refused(team, "launch", "--dataset", "set.zip")
    assert "set.zip: not a zip, or a damaged one" in message


async def test_a_damaged_line_of_a_data_set_is_told_with_file_and_line(dataset, team):
    path = dataset / "Robot2_Odometry.dat"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:9], "1.0  fast  0.0", *lines[10:]]))
    message = await refused(team, "launch", "--dataset", dataset, "--robots", "3")
    assert "Robot2_Odometry.dat, line 10: " in message
    assert "'fast' is not a number" in message


async def test_a_port_that_is_taken_is_told(team):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        for command in (["router"], ["launch", "thesis", "--output", "run"]):
            message = await refused(team, *command, "--listen", endpoint)
            assert f"can not listen at {endpoint}: the port is taken" in message


async def test_a_router_that_is_not_there_is_told(team):
    commands = (["robot", "thesis", "r1"], ["record", "thesis", "--output", "log.mcap"])
    with nobody_listens() as endpoint:
        processes = [await team.start(*command, "--connect", endpoint) for command in commands]
        await asyncio.gather(*(process.ended() for process in processes))
    for process in processes:
        assert f"no router answers at {endpoint}" in told(process)
