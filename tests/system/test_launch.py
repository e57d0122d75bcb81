import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest
import pytest_asyncio

from teamslam.central.desk.verification.verification import verify
from teamslam.central.main import StoredSet
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.roster import nodes_of
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch
from teamslam.team.wire.arrays import floats, from_floats
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.messages import Configuration, Submap
from tests.central.desk.test_evaluation import FIGURES, ROBOT_FIGURES
from tests.system.conftest import Launched
from tests.system.processes import Processes, Terminal
from tests.system.scenarios import STEPS, final_map, map_in_memory, sha256, short

COMMAND = Path(sys.executable).with_name("teamslam")


def test_a_launch_ends_by_itself_with_every_process_at_status_zero(launched):
    assert launched.exit == 0, launched.said
    processes = launched.result["processes"]
    assert {name: process["exit"] for name, process in processes.items()} == dict.fromkeys(
        ["router", "recorder", "central", "robot-r1", "robot-r2", "viewer", "world"], 0
    )
    assert len({process["pid"] for process in processes.values()}) == len(processes)
    assert launched.result["failures"] == []


def test_the_json_of_a_launch_has_every_figure(launched):
    result = launched.result
    assert {name for name in FIGURES if result.get(name) is None} == set()
    assert sorted(result["robots"]) == ["r1", "r2"]
    for robot in result["robots"].values():
        assert {name for name in ROBOT_FIGURES if robot.get(name) is None} == set()
        assert robot["steps"] == STEPS
    for key in ("source/r1/odometry", "robot/r2/submap", "central/final"):
        assert set(result["channels"][key]) == {"messages", "bytes"}
        assert result["channels"][key]["messages"] > 0


def test_every_published_measurement_is_consumed_once(launched):
    for name, robot in launched.result["robots"].items():
        assert robot["measurements_published"] == robot["measurements_consumed"] > 2 * STEPS
        assert robot["measurements_used_once"]
        sent = sum(
            launched.result["channels"].get(channel.key(name), {"messages": 0})["messages"]
            for channel in ch.SENSORS
        )
        assert sent == robot["measurements_published"], "the log has each measurement once"


def test_the_log_of_a_launch_is_complete_and_says_what_ran(launched):
    log = open_log(launched.log)
    assert log.complete
    assert log.metadata["seed"] == "1"
    announced = [opened(sample)[2] for sample in log.samples([ch.WORLD_CONFIG])]
    assert [type(message) for message in announced] == [Configuration]
    assert {key: count.messages for key, count in log.counts().items()} == {
        key: traffic["messages"] for key, traffic in launched.result["channels"].items()
    }


def test_a_launch_tells_its_result_and_where_log_report_and_pictures_are(launched):
    assert f"log   {launched.log}" in launched.said
    assert "landmark RMSE" in launched.said
    (page,) = re.findall(r"^wrote (.*/report\.html)$", launched.said, re.M)
    beside = re.search(r"^      beside it: ([^:]*?)\nlog ", launched.said, re.M)[1]
    written = [Path(page), *(Path(page).parent / name for name in re.split(r",\s+", beside))]
    assert {path.suffix for path in written} >= {".html", ".png"}
    assert all(path.stat().st_size > 0 for path in written)


def test_processes_and_a_team_in_memory_send_the_same_bytes_as_final_map(launched):
    samples = open_log(launched.log).samples()
    payload = final_map([(sample.key, sample.payload) for sample in samples])
    assert payload == map_in_memory(launched.scenario)
    assert launched.result["final_map_sha256"] == sha256(payload)


async def launch(team: Processes, scenario: Path, *options: str) -> dict[str, Any]:
    process = await team.start(
        *("launch", scenario, "--speed", "max", "--no-report", "--no-views", "--output", "run"),
        *("--json", "result.json", *options),
    )
    assert await process.ended() == 0, process.said()
    await team.none_left(0.0)
    result: dict[str, Any] = json.loads((team.folder / "result.json").read_text())
    return result


async def test_a_comparison_pair_ends_with_the_bytes_of_a_team_in_memory(team):
    """Robots wait for the answer of each exchange."""
    pair = ("hybrid-thesis", "kalman-per-axis")
    more = 'estimator = "{}"\nfusion = "{}"'.format(*pair)
    scenario = short(team.folder, more=more, steps=30)
    result = await launch(team, scenario, "--seed", "2")
    assert (result["estimator"], result["fusion"], result["seed"]) == (*pair, 2)
    assert result["final_map_sha256"] == sha256(map_in_memory(scenario, seed=2))


async def test_without_a_centre_every_robots_final_map_is_that_of_a_central_run(team):
    scenario = short(team.folder, steps=40)
    result = await launch(team, scenario, "--without-centre")
    assert "central" not in result["processes"]
    expected = sha256(map_in_memory(scenario))
    peers = result["peers"]
    hashes = {name: peer["final_map_sha256"] for name, peer in peers.items()}
    assert hashes == dict.fromkeys(["r1", "r2"], expected)
    assert result["final_map_sha256"] == expected
    assert all(peer["uplink_bytes"] and peer["downlink_bytes"] for peer in peers.values())
    log = verify(open_log(team.folder / "run" / "log.mcap"))
    assert log.first is None
    assert {"team_map", "team_final"} <= {channel.channel for channel in log.channels}


@dataclass(frozen=True)
class Watched:
    shown: str
    result: dict[str, Any]


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """The short world at 20 × real time, in a terminal, by the installed command.

    The folder has a user's own packages and modules with our names.
    """
    team = Processes(tmp_path_factory.mktemp("watched"))
    for package in ("team", "central", "sim", "teamslam"):
        (team.folder / package).mkdir()
        for path in (f"{package}/__init__.py", f"{package}.py"):
            (team.folder / path).write_text("raise RuntimeError('this is the user's own')\n")
    options = ["--speed", "20", "--no-report", "--output", "run", "--json", "result.json"]
    try:
        with Terminal() as terminal:
            command = [COMMAND, "launch", str(short(team.folder)), *options]
            process = await team.run("launch", command, errors=terminal.end)
            assert await process.ended() == 0, process.said()
    finally:
        await team.close()
    return Watched(terminal.shown, json.loads((team.folder / "result.json").read_text()))


def test_a_terminal_shows_a_live_table_of_the_robots(watched):
    for text in ("short, seed 1", "σ [m]", "mapping", "team map by join", "world ended"):
        assert text in watched.shown, watched.shown
    assert "Traceback" not in watched.shown


def test_a_second_launch_at_another_pace_beside_a_users_own_team_ends_with_the_same_bytes(
    launched, watched
):
    assert watched.result["failures"] == []
    assert watched.result["final_map_sha256"] == launched.result["final_map_sha256"]


def keep_another_runs_set(launched: Launched, file: Path) -> None:
    file.parent.mkdir()
    kept = StoredSet(file)
    for sample in open_log(launched.log).samples((ch.SUBMAP,)):
        submap = opened(sample)[2]
        assert isinstance(submap, Submap)
        other = from_floats(floats(submap.mean, "mean") + 1.0)
        payload = encoded(msgspec.structs.replace(submap, mean=other))
        kept.note([msgspec.structs.replace(sample, payload=payload)])
    kept.close()


async def test_a_launch_with_keys_in_another_runs_folder_sends_the_same_bytes_as_final_map(
    team, launched
):
    keep_another_runs_set(launched, team.folder / "run" / "central.set")
    make_keys(team.folder / "keys", "short", nodes_of(["r1", "r2"]))
    result = await launch(team, launched.scenario, "--keys", "keys")
    assert result["final_map_sha256"] == launched.result["final_map_sha256"]
    said = (team.folder / "run" / "router.log").read_text()
    assert "listening at tls/127.0.0.1:" in said
    assert (team.folder / "run" / "central.set.1").exists()
