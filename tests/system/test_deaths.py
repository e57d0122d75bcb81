"""Processes that die: who it was is told, the rest goes on or ends, and nothing is left behind."""

import json
import os
import signal
from pathlib import Path

import pytest

from team.recording.reader import LogError, open_log
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import opened
from tests.system.observer import Observer, endpoint_of
from tests.system.processes import Process, Processes, until
from tests.system.scenarios import STEPS, short

SLOW = "3"
"""What is to be met alive is still running on a busy machine."""
SUBMAPS = STEPS // 12  # windows of 12 s, steps of 1 s


async def launched(team: Processes, speed: str = "5") -> tuple[Process, Path]:
    """A launch that has r1's second submap, seconds before its end; and its run's folder."""
    folder = team.folder / "run"
    launch = await team.start(
        *("launch", short(team.folder), "--speed", speed, "--no-report"),
        *("--output", folder, "--json", "result.json"),
    )
    with Observer(await endpoint_of(folder), [ch.SUBMAP]) as seen:
        await seen.sees(2, ch.SUBMAP, "r1")
    return launch, folder


def submaps_in(log: Path) -> int:
    """How many submaps a log holds by now."""
    try:
        return len(list(open_log(log).samples([ch.SUBMAP])))
    except LogError:
        return 0


def failures(team: Processes) -> list[str]:
    found = json.loads((team.folder / "result.json").read_text())["failures"]
    assert isinstance(found, list)
    return found


async def test_a_robot_that_is_killed_is_named_and_the_others_finish_the_map(
    team: Processes,
) -> None:
    launch, folder = await launched(team)
    pid = await team.pid("robot", "r1")
    os.kill(pid, signal.SIGKILL)
    assert await launch.ended() == 1
    await team.none_left(0.0)
    assert f"robot-r1 (pid {pid}) was ended by SIGKILL" in launch.said()
    assert "Traceback" not in launch.said()
    (failure,) = failures(team)
    assert f"start it again by: teamslam robot {folder}/scenario.json r1 --connect tcp/" in failure
    result = json.loads((team.folder / "result.json").read_text())
    assert {name: process["exit"] for name, process in result["processes"].items()} == {
        "router": 0, "recorder": 0, "central": 0, "robot-r1": -9, "robot-r2": 0, "viewer": 0,
        "world": 0,
    }  # fmt: skip
    log = open_log(folder / "log.mcap")
    assert log.complete
    (final,) = [opened(sample)[2] for sample in log.samples([ch.FINAL_MAP])]
    assert isinstance(final, m.FusedMap)
    assert final.final
    members = {member.robot: member.sequence for member in final.members}
    assert members["r2"] == SUBMAPS - 1, "all of r2's submaps are in the map"
    assert members["r1"] < SUBMAPS - 1, "what r1 did not live to see is not"


@pytest.mark.parametrize("name", ["central", "router"])
async def test_a_process_without_which_no_team_runs_ends_the_run_and_is_named(
    name: str, team: Processes
) -> None:
    launch, folder = await launched(team, SLOW)
    pid = await team.pid(name)
    os.kill(pid, signal.SIGKILL)
    assert await launch.ended() == 1
    await team.none_left(0.0)
    assert f"{name} (pid {pid}) was ended by SIGKILL" in launch.said()
    assert "the run ended without a final map" in launch.said()
    assert "Traceback" not in launch.said()
    assert open_log(folder / "log.mcap").complete, "the recorder ends last and in peace"


async def test_a_recorder_that_is_killed_leaves_a_log_that_reads_and_can_be_repaired(
    team: Processes,
) -> None:
    launch, folder = await launched(team, SLOW)
    path = folder / "log.mcap"
    await until(lambda: submaps_in(path) > 0, "the recorder flushes", 10.0)
    os.kill(await team.pid("record"), signal.SIGKILL)
    assert await launch.ended() == 1
    await team.none_left(0.0)
    assert "was ended by SIGKILL" in launch.said()
    cut = open_log(folder / "log.mcap")
    assert not cut.complete
    samples = list(cut.samples())
    assert submaps_in(path) > 0
    repair = await team.start("repair", cut.path, "--output", "whole.mcap")
    assert await repair.ended() == 0, repair.said()
    assert f"whole.mcap: {len(samples)} messages" in repair.said()
    whole = open_log(team.folder / "whole.mcap")
    assert whole.complete
    assert list(whole.samples()) == samples
    assert whole.metadata == cut.metadata


async def test_a_robot_that_dies_before_the_world_begins_ends_the_run(team: Processes) -> None:
    launch = await team.start(
        *("launch", short(team.folder), "--no-report", "--output", "run"),
        *("--json", "result.json"),
    )
    await endpoint_of(team.folder / "run")
    os.kill(await team.pid("robot", "r1"), signal.SIGKILL)
    assert await launch.ended(30.0) == 1
    await team.none_left(0.0)
    assert "robot-r1" in failures(team)[0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_an_interrupt_ends_every_process_and_completes_the_log(
    number: signal.Signals, team: Processes
) -> None:
    launch, folder = await launched(team, SLOW)
    launch.signal(number)
    assert await launch.ended(20.0) == 1
    await team.none_left(0.0)
    assert "interrupted: every process of the team was ended" in launch.said()
    assert f"{folder / 'log.mcap'} holds what was recorded" in launch.said()
    assert "Traceback" not in launch.said()
    assert open_log(folder / "log.mcap").complete
    assert submaps_in(folder / "log.mcap") > 0


async def test_no_process_outlives_a_launch_that_is_killed(team: Processes) -> None:
    launch, folder = await launched(team, SLOW)
    assert len(team.alive()) == 8
    launch.signal(signal.SIGKILL)
    assert await launch.ended() == -signal.SIGKILL
    await team.none_left(5.0)
    assert list(open_log(folder / "log.mcap").samples())
