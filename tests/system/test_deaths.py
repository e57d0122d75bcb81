import json
import os
import signal
from pathlib import Path

from teamslam.sim.launch.supervision import FRUITLESS
from teamslam.team.recording.reader import LogError, open_log
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import opened
from tests.system.observer import Observer, endpoint_of
from tests.system.processes import Process, Processes, until
from tests.system.scenarios import final_map, map_in_memory, short

PACE = "5"
"""Ten seconds are left after r1's first submap: what is to be met alive still runs by then."""


async def launched(team: Processes, speed: str = PACE, *options: str) -> tuple[Process, Path]:
    folder = team.folder / "run"
    launch = await team.start(
        *("launch", short(team.folder), "--speed", speed, "--no-report", *options),
        *("--output", folder, "--json", "result.json"),
    )
    with Observer(await endpoint_of(folder), [ch.SUBMAP]) as seen:
        await seen.sees(1, ch.SUBMAP, "r1")
    return launch, folder


def submaps_in(log: Path) -> int:
    try:
        return len(list(open_log(log).samples([ch.SUBMAP])))
    except LogError:
        return 0


async def test_whoever_is_killed_is_started_again_and_the_map_is_the_same(team):
    launch, _ = await launched(team, "4")
    killed = []
    for name, *words in (
        ("robot-r1", "robot", "r1"), ("central", "central"), ("recorder", "record"),
        ("world", "world"), ("router", "router"),
    ):  # fmt: skip
        pid = await team.pid(*words)
        assert standing(pid) == (launch.pid, pid, pid), "its parent, its group, its session"
        assert Path(f"/proc/{pid}/fd/0").readlink() == Path(os.devnull)
        os.kill(pid, signal.SIGKILL)
        killed.append(f"{name} (pid {pid}) was ended by SIGKILL: it is started again")
        await until(lambda text=killed[-1]: text in launch.said(), killed[-1])
    assert await launch.ended() == 0, launch.said()
    await team.none_left(0.0)
    assert "Traceback" not in launch.said()
    result = json.loads((team.folder / "result.json").read_text())
    assert result["failures"] == []
    assert set(result["restarts"].values()) == {1}
    assert len(result["restarts"]) == len(killed)
    assert_map_is_undisturbed(team)


def assert_map_is_undisturbed(team: Processes) -> None:
    samples = open_log(team.folder / "run" / "log.mcap").samples([ch.FINAL_MAP])
    found = final_map([(each.key, each.payload) for each in samples])
    assert found == map_in_memory(team.folder / "short.toml")


def standing(pid: int) -> tuple[int, int, int]:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[1]), int(fields[2]), int(fields[3])


def other(team: Processes, words: tuple[str, ...]) -> int | None:
    found = [pid for pid, line in team.alive().items() if {"teamslam", *words} <= set(line)]
    return found[0] if found else None


async def test_a_robot_that_dies_again_and_again_is_given_up_by_name_and_the_map_is_provisional(
    team,
):
    folder = team.folder / "run"
    launch = await team.start(
        *("launch", short(team.folder), "--no-report", "--output", folder),
        *("--json", "result.json"),
    )
    await endpoint_of(folder)
    pids, killed = set[int](), set[int]()
    for life in range(1, FRUITLESS + 1):

        def starts(life: int = life) -> bool:
            pid = other(team, ("robot", "r1"))
            if pid is not None:
                pids.add(pid)
            return len(pids) == life

        await until(starts, "r1")
        (pid,) = {*pids} - killed
        killed.add(pid)
        os.kill(pid, signal.SIGKILL)
    assert await launch.ended() == 1
    await team.none_left(0.0)
    result = json.loads((team.folder / "result.json").read_text())
    assert result["given_up"] == ["robot-r1"]
    assert result["restarts"] == {"robot-r1": FRUITLESS - 1}, launch.said()
    texts = "\n".join(result["failures"])
    assert "it died 5 times without progress, and is given up" in texts
    assert "the final map is provisional: r1 lost, and not wholly in it" in texts
    exits = {name: process["exit"] for name, process in result["processes"].items()}
    assert exits == {
        "router": 0, "recorder": 1, "central": 1, "robot-r1": -9, "robot-r2": 1, "viewer": 1,
        "world": 1,
    }  # fmt: skip
    (final,) = [opened(s)[2] for s in open_log(folder / "log.mcap").samples([ch.FINAL_MAP])]
    assert isinstance(final, m.FusedMap)
    assert (final.lost, final.provisional) == (("r1",), True)
    assert {member.robot for member in final.members} == {"r2"}


async def test_a_stopped_process_is_named_and_is_ended_and_started_again_if_that_is_wished(team):
    launch, _ = await launched(team, PACE, "--end-silent", "11")
    pid = await team.pid("world")
    os.kill(pid, signal.SIGSTOP)
    assert await launch.ended() == 0, launch.said()
    await team.none_left(0.0)
    assert f"world (pid {pid}) is stopped (SIGSTOP?) and has sent no message for" in launch.said()
    assert json.loads((team.folder / "result.json").read_text())["restarts"] == {"world": 1}
    assert_map_is_undisturbed(team)


async def test_an_interrupt_ends_every_process_and_completes_the_log(team):
    launch, folder = await launched(team)
    launch.signal(signal.SIGTERM)
    assert await launch.ended() == 1
    await team.none_left(0.0)
    assert "interrupted: every process of the team was ended" in launch.said()
    assert f"{folder / 'log.mcap'} holds what was recorded" in launch.said()
    assert "Traceback" not in launch.said()
    assert open_log(folder / "log.mcap").complete
    assert submaps_in(folder / "log.mcap") > 0


async def test_no_process_outlives_a_launch_that_is_killed(team):
    launch, folder = await launched(team)
    assert len(team.alive()) == 8, "the launch and its seven processes"
    launch.signal(signal.SIGKILL)
    assert await launch.ended() == -signal.SIGKILL
    await team.none_left()
    assert list(open_log(folder / "log.mcap").samples())
