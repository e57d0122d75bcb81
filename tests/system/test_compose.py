"""The services of docker-compose.yml, each in a network namespace of its own.

No container runtime is needed: what a container has of a network is a namespace, an address and
names for the others. All of it hangs on a bridge in one more namespace: nothing of this machine's
network is touched, and nothing that is sent can leave.
"""

import os
import secrets
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from team.recording.reader import open_log
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import opened
from tests.support import ROOT
from tests.system.processes import PROGRAM, Process, Processes
from tests.system.scenarios import short

NAMES = Path("/etc/netns")
"""`ip netns exec` lays the files of NAMES/NAMESPACE over those in /etc."""
BRIDGE = "bridge"


class Network:
    """A bridge, and a namespace on it for each service, where the services' names resolve."""

    def __init__(self, services: list[str]) -> None:
        token = secrets.token_hex(3)
        self._hub = f"teamslam-{token}"
        self._spaces = {service: f"teamslam-{token}-{service}" for service in services}
        self._made_names = not NAMES.exists()

    def lay(self) -> None:
        """Make all of it; subprocess.CalledProcessError where that is not permitted."""
        _ip("netns", "add", self._hub)
        _ip("-n", self._hub, "link", "add", BRIDGE, "type", "bridge")
        _ip("-n", self._hub, "link", "set", BRIDGE, "up")
        hosts = "127.0.0.1 localhost\n" + "".join(
            f"10.77.0.{i} {service}\n" for i, service in enumerate(self._spaces, 1)
        )
        for i, space in enumerate(self._spaces.values(), 1):
            _ip("netns", "add", space)
            port = f"port{i}"
            _ip(
                *("-n", self._hub, "link", "add", port, "type", "veth"),
                *("peer", "name", "eth0", "netns", space),
            )
            _ip("-n", self._hub, "link", "set", port, "master", BRIDGE, "up")
            _ip("-n", space, "addr", "add", f"10.77.0.{i}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                _ip("-n", space, "link", "set", device, "up")
            (NAMES / space).mkdir(parents=True)
            (NAMES / space / "hosts").write_text(hosts)

    def remove(self) -> None:
        """Take away whatever was made."""
        there = _ip("netns", "list").split()
        for space in (*self._spaces.values(), self._hub):
            if space in there:
                _ip("netns", "delete", space)
            shutil.rmtree(NAMES / space, ignore_errors=True)
        if self._made_names and NAMES.exists() and not any(NAMES.iterdir()):
            NAMES.rmdir()

    def inside(self, service: str) -> list[str]:
        """What goes before a command so that it runs in the service's namespace."""
        return ["ip", "netns", "exec", self._spaces[service]]


def _ip(*arguments: str) -> str:
    done = subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
    return done.stdout


@pytest.fixture(scope="module")
def services() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    return found


@pytest.fixture
def network(services: dict[str, Any]) -> Iterator[Network]:
    """The services' network; skips where this machine does not permit it."""
    if shutil.which("ip") is None:
        pytest.skip("no iproute2: `ip` is missing")
    if os.geteuid() != 0:
        pytest.skip("network namespaces need root here")
    made = Network(list(services))
    try:
        try:
            made.lay()
        except (subprocess.CalledProcessError, OSError) as error:
            told = getattr(error, "stderr", None) or str(error)
            pytest.skip(f"network namespaces are not permitted: {told.strip()}")
        yield made
    finally:
        made.remove()


async def test_the_services_on_a_network_of_their_own_bring_the_fused_map_to_every_robot(
    services: dict[str, Any], network: Network, team: Processes
) -> None:
    """The commands as they stand, but for a short world at 20 × real time and the log's folder."""
    scenario = short(team.folder, "waypoints", 80)

    async def started(service: str) -> Process:
        replaced = {"waypoints": str(scenario), "/logs/team.mcap": "team.mcap"}
        command = [replaced.get(word, word) for word in services[service]["command"]]
        command += ["--speed", "20"] if service == "world" else []
        return await team.run(service, [*network.inside(service), *PROGRAM, *command])

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


async def test_the_router_s_health_check_passes_once_it_listens(
    services: dict[str, Any], network: Network, team: Processes
) -> None:
    kind, program, *arguments = services["router"]["healthcheck"]["test"]
    assert (kind, program) == ("CMD", "python")
    check = [*network.inside("router"), PROGRAM[0], *arguments]
    before = await team.run("before", check)
    assert await before.ended() == 1
    command = services["router"]["command"]
    router = await team.run("router", [*network.inside("router"), *PROGRAM, *command])
    await router.says("listening at tcp/")
    after = await team.run("after", check)
    assert await after.ended() == 0, after.said()
