"""An attacker with a robot's valid certificate harms that robot alone, and one without keys ends
no process.

The map stays that of an undisturbed team, no process ends, and the logs stay small.
"""

import asyncio
import json
import os
import signal
import time
from collections.abc import Callable
from itertools import islice
from random import Random

import pytest

from teamslam.sim.scenarios.scenario import load
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import nodes_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample, opened
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests import build
from tests.hostile.drawing import OF_THE_RUN, mutated, payloads
from tests.support import example
from tests.system.observer import endpoint_of
from tests.system.processes import Processes, until
from tests.system.scenarios import map_in_memory, sha256, short

ESCAPES = "\x1b]0;owned\x07\x1b[31mEVIL\x1b[2J<script>alert(1)</script>\u202etxet\n[  1.0 s] line"
FLOOD = 3000
LOG_BYTES = 100_000
"""A log of a process stays below this size under a flood; one line per message has 300,000."""
STOP_S = 4.5  # longer than the patience of a handshake
Attack = Callable[[ZenohBus], None]


def forge_final_map(bus: ZenohBus) -> None:
    bus.publish(Outgoing(ch.TEAM_FINAL, "r2", example(m.FusedMap)))


def flood_unknown_keys(bus: ZenohBus) -> None:
    payload = encoded(build.status(node="robot/r2"))
    for count in range(FLOOD):
        bus.publish_raw(Sample(f"robot/r2/x{count}/status", payload, 0, time.time_ns(), count))


def flood_garbage(bus: ZenohBus) -> None:
    for count in range(FLOOD):
        bus.publish_raw(Sample("robot/r2/status", b"x", 0, time.time_ns(), count))


def speak_to_terminals(bus: ZenohBus) -> None:
    status = build.status(
        node="robot/r2", state=f"map{ESCAPES}", figures={ESCAPES: 1e300}, warnings=(ESCAPES,) * 3
    )
    for _ in range(20):
        bus.publish(Outgoing(ch.STATUS, "robot/r2", status))


ATTACKS: tuple[Attack, ...] = (
    forge_final_map, flood_unknown_keys, flood_garbage, speak_to_terminals,
)  # fmt: skip


@pytest.mark.parametrize("centre", [True, False], ids=["centre", "peers"])
async def test_a_captured_robot_changes_no_bit_of_the_map(team: Processes, *, centre: bool) -> None:
    """The router is stopped as well, for longer than a handshake waits."""
    scenario, folder = short(team.folder), team.folder / "run"
    keys = team.folder / "keys"
    make_keys(keys, "short", nodes_of(["r1", "r2"]))
    launch = await team.start(
        *("launch", scenario, "--speed", "5", "--no-report", "--keys", keys),
        *("--output", folder, "--json", "result.json"),
        *(() if centre else ("--without-centre",)),
    )
    endpoint = await endpoint_of(folder)
    with ZenohBus("short", endpoint, keys=credentials_of(keys, "robot-r2", "short")) as captured:
        captured.subscribe(ch.SUBMAP)
        await until(lambda: bool(captured.receive(0.05)), "a submap")
        for attack in ATTACKS:
            attack(captured)
        router = await team.pid("router")
        os.kill(router, signal.SIGSTOP)
        try:
            await asyncio.sleep(STOP_S)
        finally:
            os.kill(router, signal.SIGCONT)
    assert await launch.ended() == 0, launch.said()
    await team.none_left(0.0)
    result = json.loads((team.folder / "result.json").read_text())
    assert result["final_map_sha256"] == sha256(map_in_memory(scenario))
    assert (result["failures"], result["restarts"]) == ([], {})
    for raw in ("\x1b]0;", "\x1b[2J", "\u202e"):
        assert raw not in launch.said()
    sizes = {path.name: path.stat().st_size for path in folder.glob("*.log")}
    assert {name: size for name, size in sizes.items() if size > LOG_BYTES} == {}


MESSAGES = 500


async def test_what_no_honest_node_says_ends_no_process_and_is_no_fault(team):
    scenario = short(team.folder)
    endpoint = await team.router()
    there = ["--connect", endpoint]
    started = [
        await team.start("central", scenario, *there),
        await team.start("robot", scenario, "r1", *there),
    ]
    for process in started:
        await process.says("connected to team")
    rng = Random(11)
    unsaid = (*OF_THE_RUN, m.Fault, m.Status)  # only the last two are compared
    storm = (each for each in payloads(rng) if each[0].message not in unsaid)
    with ZenohBus(load(scenario).team, endpoint) as stranger:
        for count, (channel, name, payload) in enumerate(islice(storm, MESSAGES)):
            data = mutated(rng, payload) if count % 10 == 9 else payload
            key = channel.key(name)
            stranger.publish_raw(Sample(key, data, 0, time.time_ns(), count))
        stranger.subscribe(ch.STATUS)
        stranger.subscribe(ch.FAULT)
        after: dict[str, int] = {}
        faults: list[m.Message] = []

        def all_speak() -> bool:
            for sample in stranger.receive(0.1):
                _, name, message = opened(sample)
                if isinstance(message, m.Fault):
                    faults.append(message)
                after[name] = after.get(name, 0) + 1
            return all(after.get(name, 0) >= 3 for name in ("central", "robot/r1"))

        await until(all_speak, "every process says again how it is")
    assert faults == []
    assert [process.exit for process in started] == [None, None]
