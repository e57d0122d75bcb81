import os
import shutil
import subprocess
from contextlib import ExitStack
from typing import Any

import pytest
import yaml

from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import opened
from tests.namespaces import network
from tests.support import ROOT
from tests.system.processes import PROGRAM, Process
from tests.system.scenarios import short


@pytest.fixture(scope="module")
def services():
    found: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    return found


@pytest.fixture
def names(services):
    """The services' namespaces; skips where they are not permitted."""
    if shutil.which("ip") is None or os.geteuid():
        pytest.skip("network namespaces need iproute2 and root")
    with ExitStack() as stack:
        try:
            made = stack.enter_context(network([each for each in services if each != "router"]))
        except (subprocess.CalledProcessError, OSError) as error:
            pytest.skip(f"network namespaces are not permitted: {error}")
        yield made


async def test_the_services_on_a_network_of_their_own_bring_the_fused_map_to_every_robot(
    services, names, team
):
    """The commands as they stand, but for a short world at 20 × real time and the log's folder."""
    scenario = short(team.folder, "waypoints", 80)

    async def started(service: str) -> Process:
        replaced = {"waypoints": str(scenario), "/logs/team.mcap": "team.mcap"}
        command = [replaced.get(word, word) for word in services[service]["command"]]
        command += ["--speed", "20"] if service == "world" else []
        return await team.run(service, ["ip", "netns", "exec", names[service], *PROGRAM, *command])

    router = await started("router")
    await router.says("listening at tcp/")
    running = {name: await started(name) for name in services if name != "router"}
    for process in running.values():
        assert await process.ended() == 0, process.said()
    assert router.exit is None

    log = open_log(team.folder / "team.mcap")
    assert log.complete
    (final,) = [opened(sample)[2] for sample in log.samples([ch.FINAL_MAP])]
    assert isinstance(final, m.FusedMap)
    robots = {"r1", "r2", "r3"}
    assert {member.robot for member in final.members} == robots
    given: dict[str, set[bytes]] = {robot: set() for robot in robots}
    broadcast = set()
    for sample in log.samples([ch.FUSED_MAP, ch.TEAM_POSE]):
        match opened(sample):
            case _, _, m.FusedMap() as fused:
                broadcast.add(fused.digest)
            case _, robot, m.PoseEstimate() as pose if pose.in_team_frame:
                given[robot].add(pose.map_digest)
    for robot, digests in given.items():
        assert digests, f"{robot} gave no pose in the team's map"
        assert digests <= broadcast, "each names a map that was broadcast"


async def test_the_router_s_health_check_passes_once_it_listens(services, names, team):
    kind, program, *arguments = services["router"]["healthcheck"]["test"]
    assert (kind, program) == ("CMD", "python")
    check = ["ip", "netns", "exec", names["router"], PROGRAM[0], *arguments]
    before = await team.run("before", check)
    assert await before.ended() == 1
    command = services["router"]["command"]
    router = await team.run("router", ["ip", "netns", "exec", names["router"], *PROGRAM, *command])
    await router.says("listening at tcp/")
    after = await team.run("after", check)
    assert await after.ended() == 0, after.said()
