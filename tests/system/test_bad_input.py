"""Wrong input that a process detects: one clear message, exit status 2, no process left.

For single commands see `tests/sim/cli/test_help.py`.
"""

import asyncio
import socket
from pathlib import Path

from tests.sim.cli.test_help import message_in
from tests.support import nobody_listens
from tests.system.processes import Process, Processes


def told(process: Process) -> str:
    return message_in(process.said(), process.exit)


async def refused(team: Processes, *arguments: str | Path) -> str:
    process = await team.start(*arguments)
    await process.ended()
    await team.none_left(0.0)
    return told(process)


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
