import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from teamslam.sim.cli.options import is_loopback
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import KeysError, load_roster, nodes_of
from teamslam.team.wire import channels as ch
from teamslam.team.wire.zenoh.access import list_owned_keys
from tests import commands
from tests.keys.certificates import TEAM, Folders


def test_each_file_is_for_its_owner_alone_and_the_team_is_in_the_roster(keys):
    modes = {stat.S_IMODE(path.stat().st_mode) for path in keys.own.iterdir()}
    assert modes == {0o600}
    roster = load_roster(keys.own)
    assert (roster.team, roster.robots) == (TEAM, ["r1", "r2"])
    assert sorted(roster.nodes) == sorted(nodes_of(["r1", "r2"]))
    assert {roster.common_name(node) for node in roster.nodes} == set(roster.nodes)


def test_a_nodes_files_are_enough_for_it(keys, tmp_path):
    for name in ("ca.pem", "robot-r1.pem", "robot-r1.key"):
        shutil.copy(keys.own / name, tmp_path)
    found = credentials_of(tmp_path, "robot-r1", TEAM)
    assert (found.node, found.team, found.warnings()) == ("robot-r1", TEAM, [])
    (tmp_path / "robot-r1.key").chmod(0o644)
    assert credentials_of(tmp_path, "robot-r1").warnings() == [
        f"{tmp_path}/robot-r1.key can be read by others: chmod 600 {tmp_path}/robot-r1.key"
    ]


def mixed(keys: Folders, tmp_path: Path, **files: Path) -> Path:
    for name in ("ca.pem", "robot-r1.pem", "robot-r1.key"):
        source = files.get(name.replace(".", "_").replace("-", "_"), keys.own / name)
        shutil.copy(source, tmp_path / name)
    return tmp_path


def test_what_is_wrong_with_a_nodes_files_is_named_before_it_connects(keys, tmp_path):
    def told(folder: Path, node: str = "robot-r1", **more: object) -> str:
        with pytest.raises(KeysError) as caught:
            credentials_of(folder, node, **more)
        return str(caught.value)

    assert "robot-r9.pem: not found; robot-r9 needs ca.pem" in told(keys.own, "robot-r9")
    assert "of the team 'mixed', not of 'other'" in told(keys.own, team="other")
    other = mixed(keys, tmp_path, robot_r1_key=keys.own / "robot-r2.key")
    assert "robot-r1.key is not the key of" in told(other)
    other = mixed(keys, tmp_path, ca_pem=keys.strange / "ca.pem")
    assert "is not of the authority in" in told(other)
    pair = {"robot_r1_pem": keys.own / "robot-r2.pem", "robot_r1_key": keys.own / "robot-r2.key"}
    other = mixed(keys, tmp_path, **pair)
    assert "a certificate of 'robot-r2', not of robot-r1" in told(other)
    (tmp_path / "robot-r1.pem").write_text("nothing")
    assert "robot-r1.pem: no certificate in PEM" in told(tmp_path)
    now = datetime.now(UTC)
    assert "robot-r1.pem: expired at " in told(keys.own, now=now + timedelta(days=91))
    assert "not valid before " in told(keys.own, now=now - timedelta(days=2))


def test_a_certificate_that_ends_soon_is_spoken_of(keys):
    (warning,) = credentials_of(keys.own, "central").warnings(
        datetime.now(UTC) + timedelta(days=85)
    )
    assert "renew it by `teamslam keys mixed --renew central`" in warning


def test_a_robot_is_added_and_what_there_is_stays(tmp_path):
    make_keys(tmp_path, TEAM, nodes_of(["r1"]))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    made = make_keys(tmp_path, TEAM, nodes_of(["r1", "r2"]))
    assert made.made == ("robot-r2", "source-r2")
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert {n: b for n, b in after.items() if n in before and n != "roster.json"} == {
        n: b for n, b in before.items() if n != "roster.json"
    }
    credentials_of(tmp_path, "robot-r2", TEAM)
    with pytest.raises(KeysError, match="holds the keys of the team 'mixed', not of 'other'"):
        make_keys(tmp_path, "other", [])
    (tmp_path / "ca.key").unlink()
    with pytest.raises(KeysError, match="certificates are made where the authority is"):
        make_keys(tmp_path, TEAM, nodes_of(["r3"]))


def test_who_is_renewed_keeps_its_name_and_who_was_revoked_gets_another(tmp_path):
    make_keys(tmp_path, TEAM, nodes_of(["r1", "r2"]))
    old = (tmp_path / "robot-r1.pem").read_bytes()
    assert make_keys(tmp_path, TEAM, [], renew=["robot-r1"]).made == ("robot-r1",)
    assert (tmp_path / "robot-r1.pem").read_bytes() != old
    assert load_roster(tmp_path).common_name("robot-r1") == "robot-r1"
    assert make_keys(tmp_path, TEAM, [], revoke=["robot-r1"]).revoked == ("robot-r1",)
    assert "robot-r1" not in load_roster(tmp_path).nodes
    assert not (tmp_path / "robot-r1.key").exists()
    make_keys(tmp_path, TEAM, nodes_of(["r1", "r2"]))
    assert load_roster(tmp_path).common_name("robot-r1") == "robot-r1.2"
    credentials_of(tmp_path, "robot-r1", TEAM)
    with pytest.raises(KeysError, match="no certificate of 'robot-r7'; there are: central"):
        make_keys(tmp_path, TEAM, [], renew=["robot-r7"])


def test_every_channel_has_one_owner_and_the_world_alone_shares_the_sensors():
    nodes = nodes_of(["r1", "r2"])

    def owners(key: str) -> list[str]:
        def owns(node: str) -> bool:
            of_team = zenoh.KeyExpr(key)
            return any(zenoh.KeyExpr(each).includes(of_team) for each in list_owned_keys(node))

        return [node for node in nodes if owns(node)]

    for channel in ch.CHANNELS:
        name = "robot/r1" if "{node}" in channel.template else "r1"
        found = owners(channel.key(name))
        sensors = channel in (*ch.SENSORS, ch.MEASUREMENTS, ch.HEAD)
        assert len(found) == (2 if sensors else 1), (channel.template, found)
    assert owners(ch.ODOMETRY.key("r1")) == ["world", "source-r1"]
    assert owners(ch.ORDER.key("r1")) == ["operator"]
    assert owners(ch.WITHDRAWALS_HEARD.key("r2")) == ["robot-r2"]
    for key in ("robot/r1/x1/status", "robot/r1/x1", "world/x/status", "view/a/b/c", "truth/r1/x"):
        assert owners(key) == [], "a key of no channel is nobody's, and dies at the router"


@pytest.mark.parametrize(
    ("listen", "local"),
    [
        ("tcp/127.0.0.1:7447", True), ("tcp/localhost:0", True), ("tls/[::1]:7447", True),
        ("tcp/0.0.0.0:7447", False), ("tcp/[::]:7447", False), ("tcp/10.0.0.7:7447", False),
        ("tcp/lab.example:7447", False), ("unixsock-stream/run/zenoh", True), ("tcp/:7447", False),
    ],
)  # fmt: skip
def test_an_open_router_for_others_needs_a_word(listen, local):
    assert is_loopback(listen) is local
    if not local:
        for command in (["router"], ["replay", "nothing.mcap"]):
            refused = commands.output_of(*command, "--listen", listen, status=2)
            assert "give --keys DIR" in refused
            assert "--insecure" in refused


def test_the_command_makes_keys_for_a_scenario_and_says_what_it_did(tmp_path):
    def run(*words: str) -> str:
        return commands.output_of("keys", "mapping", "-o", tmp_path / "k", *words)

    first = run("--scenario", "waypoints", "--router", "lab.example")
    assert "made     central, operator, recorder, robot-r1" in first
    assert "waypoints is of the team 'waypoints', these keys of 'mapping'" in first
    assert "copy to each computer ca.pem and NODE.pem, NODE.key" in first
    assert "made     robot-r9, source-r9\nkept     central" in run("--robot", "r9")
    assert "revoked  robot-r9" in run("--revoke", "robot-r9")
    for words, said in (
        (["keys", "a team", "-o", "k"], "no team's name"),
        (["keys", "t", "-o", "k", "--days", "0"], "positive"),
        (["keys", "t", "-o", "k", "--robot", "R"], "no robot's name"),
    ):
        refused = commands.run(*words)
        assert (refused.exit_code, said in refused.output) == (2, True)
